"""Losses and all gradients of a whole training step against 3DGB's arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from toonifygb import render
from toonifygb.avatar import MouthVolume
from toonifygb.avatar.skinning import activate, blend_parameters, concatenate, pose_offsets, skin_splats
from toonifygb.config import TrainConfig
from toonifygb.errors import BackendError
from toonifygb.geometry.skinning import blend_transforms
from toonifygb.structures import Camera, GaussianParams, Rendering, Splats
from toonifygb.train.losses import LossWeights, image_loss, mouth_loss

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.golden
RADIUS, HALF_HEIGHT = 0.027279, 0.021632
"""Upstream's mouth cylinder, m."""
FIELDS = {"means": "xyz", "quats": "rot", "log_scales": "scale", "opacity_logits": "opacity", "sh": "sh"}


def load(golden_dir: Path, stem: str, suffix: str, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    path = golden_dir / "gaussian_blendshapes" / f"{stem}_{suffix}.npz"
    loaded = {name: torch.from_numpy(np.asarray(value)) for name, value in np.load(path).items()}
    return {n: t.to(dtype) if t.is_floating_point() else t for n, t in loaded.items()}


def stems(golden_dir: Path, suffix: str) -> list[str]:
    paths = sorted((golden_dir / "gaussian_blendshapes").glob(f"*_{suffix}.npz"))
    if not paths:
        pytest.skip(f"no *_{suffix}.npz in {golden_dir}")
    return [path.name.removesuffix(f"_{suffix}.npz") for path in paths]


def camera(a: dict[str, torch.Tensor], dtype: torch.dtype) -> Camera:
    K = torch.eye(3, dtype=dtype)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = a["cam_fx"], a["cam_fy"], a["cam_cx"], a["cam_cy"]
    view = torch.eye(4, dtype=dtype)
    view[:3, :3], view[:3, 3] = a["cam_R"], a["cam_t"]
    return Camera(K, view, int(a["cam_W"]), int(a["cam_H"]))


def leaves(a: dict[str, torch.Tensor], prefix: str) -> GaussianParams:
    """Parameters (or, for prefix ``g_d_``, deltas with their axis first) as leaves of the autograd graph."""
    parts = {}
    for ours, theirs in FIELDS.items():
        value = a[prefix + theirs]
        value = value.movedim(-1, 0) if prefix == "g_d_" else value
        parts[ours] = (value[..., 0] if ours == "opacity_logits" else value).clone().requires_grad_()
    return GaussianParams(**parts)


def gradients(params: GaussianParams, prefix: str) -> dict[str, torch.Tensor]:
    """Gradients under upstream's names and axes."""
    found = {}
    for ours, theirs in FIELDS.items():
        value = getattr(params, ours).grad
        value = value[..., None] if ours == "opacity_logits" else value
        found[prefix + theirs] = value.movedim(0, -1) if prefix.endswith("d_") else value
    return found


def step(
    a: dict[str, torch.Tensor], scene: dict[str, torch.Tensor], variant: str, backend: str
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """One forward and backward pass of the whole objective."""
    dtype = a["psi"].dtype
    neutral, deltas = leaves(a, "g_"), leaves(a, "g_d_")
    upper, lower = leaves(a, "up_"), leaves(a, "down_")
    scale = a["g_mask"].T
    effective = GaussianParams(
        means=deltas.means * scale[..., None] + a["g_init_xyz"].movedim(-1, 0),
        quats=deltas.quats * scale[..., None] + a["g_init_rot"].movedim(-1, 0),
        log_scales=deltas.log_scales * scale[..., None],
        opacity_logits=deltas.opacity_logits * scale,
        sh=deltas.sh * scale[..., None, None],
    )
    face = activate(blend_parameters(neutral, effective, a["psi"]))
    corrected = face.means + pose_offsets(a["pose_feature"], a["posedirs_g"])
    face = Splats(corrected, face.quats, face.scales, face.opacities, face.sh)
    parts = [
        skin_splats(face, blend_transforms(a["weights"], a["A"]), posed_offsets=a["eyelid_g"] @ a["eyelids"]),
        skin_splats(activate(upper), a["M_up"].expand(upper.n, 4, 4)),
        skin_splats(activate(lower), a["M_down"].expand(lower.n, 4, 4)),
    ]
    image = render.get(backend).render(concatenate(parts), camera(scene, dtype))
    weights = LossWeights.of(TrainConfig(loss="3dgb" if variant == "3dgb" else "seed"))
    volume = MouthVolume(scene["mouth_center"], RADIUS, HALF_HEIGHT)
    target = scene["target"] * scene["mask"][..., None]
    loss = image_loss(image, target, scene["mask"], weights) + mouth_loss(upper.means, lower.means, volume, weights)
    loss.backward()
    found = gradients(neutral, "face_") | gradients(deltas, "face_d_")
    return loss.detach(), found | gradients(upper, "up_") | gradients(lower, "down_")


@pytest.mark.parametrize("variant", ["3dgb", "seed"])
def test_gradients_of_the_reference(golden_dir: Path, variant: str) -> None:
    for stem in stems(golden_dir, "grad"):
        a, scene = (load(golden_dir, stem, suffix, torch.float64) for suffix in ("skin", "render"))
        wanted = load(golden_dir, stem, "grad", torch.float64)
        loss, found = step(a, scene, variant, "reference")
        assert abs(loss - scene[f"loss_total_{variant}"]) < 1e-9
        for name, value in found.items():
            assert (value - wanted[f"grad_{variant}_{name}"]).abs().max() < 1e-9, name


@pytest.mark.parametrize("variant", ["3dgb", "seed"])
def test_gradients_of_the_native_engine(golden_dir: Path, variant: str) -> None:
    try:
        render.get("native")
    except BackendError as error:
        pytest.skip(str(error))
    for stem in stems(golden_dir, "grad"):
        a, scene = (load(golden_dir, stem, suffix, torch.float32) for suffix in ("skin", "render"))
        wanted = load(golden_dir, stem, "grad", torch.float32)
        loss, found = step(a, scene, variant, "native")
        assert abs(loss - scene[f"loss_total_{variant}"]) < 1e-5
        for name, value in found.items():
            reference = wanted[f"grad_{variant}_{name}"].reshape(len(value), -1)
            size = reference.norm(dim=1)
            seen = size > 1e-9 * size.max()
            error = ((value.reshape(len(value), -1) - reference).norm(dim=1) / size)[seen]
            # Tolerances of the arrays' own README for float32 twins.
            assert error.median() < 5e-5, name
            assert error.quantile(0.99) < 1e-3, name


def test_loss_terms(golden_dir: Path) -> None:
    for stem in stems(golden_dir, "render"):
        scene = load(golden_dir, stem, "render", torch.float64)
        skin = load(golden_dir, stem, "skin", torch.float64)
        target = scene["target"] * scene["mask"][..., None]
        image = Rendering(scene["image"], scene["alpha"])

        def value(l1: float, dssim: float, alpha: float) -> float:
            weights = LossWeights(l1, dssim, alpha, 0.0, joint_mouth_mean=False)
            return float(image_loss(image, target, scene["mask"], weights))  # noqa: B023 - called in this turn

        assert abs(value(1, 0, 0) - scene["loss_l1"]) < 1e-9
        assert abs(value(0, 1, 0) - scene["loss_dssim"]) < 1e-9
        assert abs(value(0, 0, 1) - scene["loss_alpha"]) < 1e-9
        volume = MouthVolume(scene["mouth_center"], RADIUS, HALF_HEIGHT)
        for name, prefix in (("sdf_up", "up_"), ("sdf_down", "down_")):
            assert (volume.distance(skin[f"{prefix}xyz"]) - scene[name]).abs().max() < 1e-9
        for joint, name in ((False, "loss_reg_3dgb"), (True, "loss_reg_seed")):
            weights = LossWeights(0, 0, 0, 1.0, joint_mouth_mean=joint)
            reg = mouth_loss(skin["up_xyz"], skin["down_xyz"], volume, weights)
            assert abs(reg - scene[name]) < 1e-9
