"""A small picture and its gradient, drawn by a renderer and by the reference: is this machine's GPU to be trusted?

Drivers, compilers and chips differ, so ``auto`` does not take a GPU on faith.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.cameras import tracked_camera
from toonifygb.render.reference import ReferenceRenderer
from toonifygb.structures import Splats

if TYPE_CHECKING:
    from torch import Tensor

    from toonifygb.render.base import Renderer

N, SIZE, DEPTH = 200, 64, 0.5
TOLERANCE = 1e-3
"""Largest difference of a colour, and of a gradient as a share of the largest; rounding makes 1e-5."""


def disagreement(renderer: Renderer) -> str | None:
    """What is wrong with the renderer, as a clause; ``None`` when it agrees with the reference."""
    try:
        ours = _picture_and_slopes(renderer)
    except Exception as error:  # a driver or compiler may fail in any way, and the answer is the same
        return f"it fails on a small picture ({type(error).__name__}: {error})"
    for name, mine, true in zip(
        ("picture", "gradient"), ours, _picture_and_slopes(ReferenceRenderer()), strict=True
    ):
        apart = float((mine - true).abs().max() / true.abs().max())
        if not apart <= TOLERANCE:
            return f"its {name} of a small scene is off by {apart:.1g} of the largest value"
    return None


def _picture_and_slopes(renderer: Renderer) -> tuple[Tensor, Tensor]:
    """Colour and opacity of a scene, and their gradient for every parameter, flat."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    means = (uniform(N, 3) - 0.5) * 0.4 - torch.tensor([0.0, 0.0, DEPTH])
    parts = [means, uniform(N, 4) + 0.2, 0.01 + 0.02 * uniform(N, 3), 0.2 + 0.7 * uniform(N), uniform(N, 4, 3)]
    weights = uniform(SIZE, SIZE, 4)
    leaves = [part.requires_grad_() for part in parts]
    shown = renderer.render(Splats(*leaves), tracked_camera(float(SIZE), SIZE, SIZE))
    picture = torch.cat([shown.color, shown.alpha[..., None]], -1)
    slopes = torch.autograd.grad((picture * weights).sum(), leaves)
    # Each kind of parameter by its own largest slope: centres would drown all others.
    flat = torch.cat([(slope / slope.abs().max()).flatten() for slope in slopes])
    return picture.detach(), flat
