"""The pieces against 3DGB's own arrays, in float64 and float32."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from toonifygb.avatar.skinning import activate, blend_parameters, pose_offsets, scale_deltas, skin_splats
from toonifygb.avatar.transfer import face_consistency, mix_vertices, turns
from toonifygb.geometry.align import kabsch
from toonifygb.geometry.skinning import blend_transforms
from toonifygb.structures import GaussianParams, Splats

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.golden
LOWER_TEETH = (1.30787707e-02, 4.26467828e-02, 9.44269622e-01)
"""Upstream's blend of root, neck and jaw for the lower teeth."""


def sets(golden_dir: Path, suffix: str) -> list[Path]:
    """Every array file of one kind, whatever it is called before the suffix."""
    paths = sorted((golden_dir / "gaussian_blendshapes").glob(f"*_{suffix}.npz"))
    if not paths:
        pytest.skip(f"no *_{suffix}.npz in {golden_dir}")
    return paths


def arrays(path: Path, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    loaded = {name: torch.from_numpy(np.asarray(value)) for name, value in np.load(path).items()}
    return {n: t.to(dtype) if t.is_floating_point() else t for n, t in loaded.items()}


def params(a: dict[str, torch.Tensor], prefix: str) -> GaussianParams:
    return GaussianParams(
        means=a[f"{prefix}xyz"],
        quats=a[f"{prefix}rot"],
        log_scales=a[f"{prefix}scale"],
        opacity_logits=a[f"{prefix}opacity"][:, 0],
        sh=a[f"{prefix}sh"],
    )


def deltas(a: dict[str, torch.Tensor]) -> GaussianParams:
    """Trainable deltas scaled by the consistency mask, plus the fixed ones from the mesh."""
    trained = GaussianParams(
        means=a["g_d_xyz"].movedim(-1, 0),
        quats=a["g_d_rot"].movedim(-1, 0),
        log_scales=a["g_d_scale"].movedim(-1, 0),
        opacity_logits=a["g_d_opacity"].movedim(-1, 0)[..., 0],
        sh=a["g_d_sh"].movedim(-1, 0),
    )
    scaled = scale_deltas(trained, a["g_mask"].T)
    return GaussianParams(
        means=scaled.means + a["g_init_xyz"].movedim(-1, 0),
        quats=scaled.quats + a["g_init_rot"].movedim(-1, 0),
        log_scales=scaled.log_scales,
        opacity_logits=scaled.opacity_logits,
        sh=scaled.sh,
    )


def check(splats: Splats, a: dict[str, torch.Tensor], prefix: str, tolerance: float) -> None:
    for ours, theirs in (
        (splats.means, a[f"{prefix}xyz"]),
        (splats.quats, a[f"{prefix}rot"]),
        (splats.scales, a[f"{prefix}scale"]),
        (splats.opacities, a[f"{prefix}opacity"][:, 0]),
        (splats.sh, a[f"{prefix}sh"]),
    ):
        assert (ours - theirs).abs().max() <= tolerance


PRECISIONS = pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 2e-6)])


@PRECISIONS
def test_initial_deltas_and_consistency(golden_dir: Path, dtype: torch.dtype, tolerance: float) -> None:
    for path in sets(golden_dir, "init"):
        a = arrays(path, dtype)
        moved = a["v_expr"] - a["v_neutral"]
        offsets = mix_vertices(moved, a["faces"], a["face_id"], a["bary"])
        assert (offsets.movedim(0, -1) - a["out_init_xyz"]).abs().max() <= tolerance
        quats = turns(a["v_neutral"], a["v_expr"], a["faces"], a["face_id"], a["q0"])
        assert (quats.movedim(0, -1) - a["out_init_rot"]).abs().max() <= tolerance
        scale = face_consistency(
            a["v_neutral"], a["v_expr"], a["faces"], a["rigid_vertex_ids"], a["exclude_vertex_ids"]
        )
        # The scale divides millimetres by d_max, so float32 rounding of metre coordinates shows 1/d_max larger.
        assert (scale.T - a["out_face_mask"]).abs().max() <= (tolerance if dtype == torch.float64 else 2e-4)


@PRECISIONS
def test_blending_and_skinning(golden_dir: Path, dtype: torch.dtype, tolerance: float) -> None:
    for path in sets(golden_dir, "skin"):
        a = arrays(path, dtype)
        raw = blend_parameters(params(a, "g_"), deltas(a), a["psi"])
        face = activate(raw)
        check(face, a, "blend_", tolerance)
        corrected = Splats(
            face.means + pose_offsets(a["pose_feature"], a["posedirs_g"]),
            face.quats,
            face.scales,
            face.opacities,
            face.sh,
        )
        posed = skin_splats(
            corrected,
            blend_transforms(a["weights"], a["A"]),
            posed_offsets=a["eyelid_g"] @ a["eyelids"],
            rotate_sh=True,
        )
        check(posed, a, "out_", tolerance)
        frames = skin_splats(corrected, blend_transforms(a["weights"], a["A"])).sh_frames
        assert frames is not None
        assert (frames - a["out_R"]).abs().max() <= tolerance


@PRECISIONS
def test_mouth_sets(golden_dir: Path, dtype: torch.dtype, tolerance: float) -> None:
    for path in sets(golden_dir, "skin"):
        a = arrays(path, dtype)
        rotation, translation = kabsch(a["back_neutral"], a["back_posed"])
        upper = torch.eye(4, dtype=dtype)
        upper[:3, :3], upper[:3, 3] = rotation, translation
        assert (upper - a["M_up"]).abs().max() <= tolerance
        weights = torch.tensor([*LOWER_TEETH, 0.0, 0.0], dtype=dtype)[None]
        lower = torch.eye(4, dtype=dtype) + blend_transforms(weights, a["A"] - a["A_neutral"])[0]
        assert (lower - a["M_down"]).abs().max() <= tolerance
        for prefix, transform in (("up_", upper), ("down_", lower)):
            mouth = params(a, prefix)
            posed = skin_splats(activate(mouth), transform.expand(mouth.n, 4, 4), rotate_sh=True)
            check(posed, a, f"out_{prefix}", tolerance)
