"""Renderers and losses against arrays of an independent implementation of 3DGB's rasteriser.

Every set whose name ends in ``_render`` or ``_raster`` is used. Pixels within 1e-4 of a threshold (``margin``) are
left out, because float32 may decide them otherwise. Tolerances are those the arrays' notes give for float32.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from render_scenes import relative_errors, variables

from toonifygb import render
from toonifygb.structures import Camera, Splats

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.golden
Arrays = dict[str, np.ndarray]


def sets(golden_dir: Path, suffix: str) -> list[Arrays]:
    """All sets of arrays whose name ends in ``suffix``."""
    found = sorted(golden_dir.glob(f"**/*_{suffix}.npz"))
    if not found:
        pytest.skip(f"no *_{suffix}.npz below {golden_dir}")
    return [dict(np.load(path)) for path in found]


def scene_of(arrays: Arrays, dtype: torch.dtype) -> tuple[Splats, Camera]:
    """Splats and camera of a set."""

    def tensor(name: str) -> torch.Tensor:
        return torch.tensor(arrays[name], dtype=dtype)

    splats = Splats(
        tensor("in_xyz"), tensor("in_rot"), tensor("in_scale"), tensor("in_opacity").reshape(-1), tensor("in_sh")
    )
    K, transform = torch.eye(3, dtype=dtype), torch.eye(4, dtype=dtype)
    for (row, column), name in {(0, 0): "fx", (1, 1): "fy", (0, 2): "cx", (1, 2): "cy"}.items():
        K[row, column] = float(arrays[f"cam_{name}"])
    transform[:3, :3], transform[:3, 3] = tensor("cam_R"), tensor("cam_t")
    return splats, Camera(K, transform, int(arrays["cam_W"]), int(arrays["cam_H"]))


def dtypes(renderer: render.Renderer) -> list[torch.dtype]:
    """Precisions to test a renderer in."""
    return [torch.float64, torch.float32] if renderer.name == "reference" else [torch.float32]


def worst(found: torch.Tensor, expected: np.ndarray, arrays: Arrays) -> float:
    """Largest difference over the pixels that are not on a threshold."""
    clear = torch.tensor(arrays["margin"] > 1e-4)
    return (found.detach().double() - torch.tensor(expected))[clear].abs().max().item()


def test_images(renderer: render.Renderer, golden_dir: Path) -> None:
    names = {3: "image", 2: "image_deg2", 1: "image_deg1", 0: "image_deg0"}
    for arrays in sets(golden_dir, "render"):
        for dtype in dtypes(renderer):
            tolerance = 1e-9 if dtype == torch.float64 else 1e-5
            splats, view = scene_of(arrays, dtype)
            for degree, name in names.items():
                rendering = renderer.render(splats, view, sh_degree=degree)
                assert worst(rendering.color, arrays[name], arrays) < tolerance, name
                assert worst(rendering.alpha, arrays["alpha"], arrays) < tolerance
            white = renderer.render(splats, view, background=torch.ones(3))
            assert worst(white.color, arrays["image_white"], arrays) < tolerance


def test_stress_scene(renderer: render.Renderer, golden_dir: Path) -> None:
    for arrays in sets(golden_dir, "raster"):
        for dtype in dtypes(renderer):
            splats, view = scene_of(arrays, dtype)
            splats, leaves = variables(splats)
            info = render.RenderInfo()
            rendering = renderer.render(splats, view, background=torch.tensor(arrays["bg"], dtype=dtype), info=info)
            exact = dtype == torch.float64
            assert worst(rendering.color, arrays["image"], arrays) < (1e-9 if exact else 3e-4)
            assert worst(rendering.alpha, arrays["alpha"], arrays) < (1e-9 if exact else 1e-5)
            assert info.radii is not None
            assert torch.equal(info.radii, torch.tensor(arrays["p_radius"]).to(torch.int32))

            upstream = [torch.tensor(arrays[name]).to(dtype) for name in ("dL_dimage", "dL_dalpha")]
            found = torch.autograd.grad([rendering.color, rendering.alpha], leaves, upstream)
            assert info.mean2d_gradient is not None
            named = dict(zip(("xyz", "rot", "scale", "opacity", "sh"), found, strict=True))
            expected = {name: torch.tensor(arrays[f"grad_{name}"]) for name in named}
            named["2d"], expected["2d"] = info.mean2d_gradient, torch.tensor(arrays["grad2d_color"])
            for name, gradient in named.items():
                errors = relative_errors(gradient, expected[name])
                assert errors.median() < (1e-9 if exact else 1e-5), name
                assert torch.quantile(errors, 0.99) < (1e-9 if exact else 2e-2), name
                untouched = expected[name].reshape(len(gradient), -1).abs().amax(1) == 0
                assert gradient[untouched].abs().sum() == 0, name


@pytest.mark.parametrize("backend", ["reference", "native"])
def test_losses(backend: str, golden_dir: Path, request: pytest.FixtureRequest) -> None:
    kernels = request.getfixturevalue("native_kernels") if backend == "native" else render.kernels("reference")
    for arrays in sets(golden_dir, "render"):
        supervision = torch.tensor(arrays["target"] * arrays["mask"][..., None]).float()
        image = torch.tensor(arrays["image"]).float()
        for weights, name in (((0.8, 0.2), "loss_rgb_3dgb"), ((0.2, 0.8), "loss_rgb_seed")):
            loss, _ = kernels.l1_dssim(image, supervision, *weights)
            assert abs(loss.item() - arrays[name]) < 1e-5


def test_gradients_through_pose_and_loss_are_covered_by_the_same_scene(
    renderer: render.Renderer, golden_dir: Path
) -> None:
    """Where posing only maps raw opacity by a sigmoid and raw scale by exp, the chain is one multiplication.

    So the renderer with the 3DGB loss must give the stored gradients of the raw opacities and scales of the mouth
    Gaussians, which no blendshape touches.
    """
    sources = list(zip(sets(golden_dir, "render"), sets(golden_dir, "grad"), strict=True))
    for arrays, gradients in sources:
        splats, view = scene_of(arrays, torch.float32)
        splats, leaves = variables(splats)
        rendering = renderer.render(splats, view)
        mask = torch.tensor(arrays["mask"]).float()
        kernels = render.kernels(renderer.name)
        _, v_color = kernels.l1_dssim(
            rendering.color.detach(), torch.tensor(arrays["target"]).float() * mask[..., None]
        )
        v_alpha = 2 * 10 / mask.numel() * (rendering.alpha.detach() - mask)
        v = torch.autograd.grad([rendering.color, rendering.alpha], leaves, [v_color, v_alpha])
        raw_opacity = v[3] * splats.opacities * (1 - splats.opacities)
        raw_scale = v[2] * splats.scales
        n_up = len(gradients["grad_3dgb_up_opacity"])
        n_face = len(splats.means) - n_up - len(gradients["grad_3dgb_down_opacity"])
        for part, begin in (("face", 0), ("up", n_face), ("down", n_face + n_up)):
            for name, found in (("opacity", raw_opacity), ("scale", raw_scale)):
                expected = torch.tensor(gradients[f"grad_3dgb_{part}_{name}"])
                errors = relative_errors(found[begin : begin + len(expected)].detach(), expected)
                assert errors.median() < 5e-5 and torch.quantile(errors, 0.99) < 1e-3, (part, name)
