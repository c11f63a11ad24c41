"""An avatar of the paper's size without its initialisation, and a clip of noise to train it on."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb import head
from toonifygb.avatar import init_avatar
from toonifygb.avatar.fields import each
from toonifygb.config import TrainConfig
from toonifygb.geometry.cameras import tracked_camera
from toonifygb.structures import Camera, GaussianParams, HeadMotion, Landmarks, Split, TrackedSequence
from toonifygb.train.data import Dataset

if TYPE_CHECKING:
    from torch import Tensor

    from toonifygb.avatar import Avatar
    from toonifygb.head import HeadModel

COPIES = 8
"""Of each Gaussian that was really placed; placing 64 000 takes a minute of processor time."""
FOCAL_SIZES = 1.9
"""Focal length in image sizes: a head at 0.5 m covers some 60 % of the image."""


def motion(model: HeadModel, n_frames: int) -> HeadMotion:
    """Talking and nodding, half a metre away; all expression units move in every frame."""
    time = torch.linspace(0, 2 * math.pi, n_frames)[:, None]
    phase = torch.arange(model.n_expression) * 0.7
    joints = torch.zeros(n_frames, 5, 3)
    joints[:, 0, 1] = 0.3 * time[:, 0].sin()
    joints[:, 2, 0] = 0.1 * (1 + (3 * time[:, 0]).sin())
    translation = torch.tensor([0.0, 0.0, -0.5]).expand(n_frames, 3).clone()
    return HeadMotion(
        0.3 + 0.3 * (2 * time + phase).sin(), joints, translation, 0.5 + 0.4 * time.cos().repeat(1, 2)
    )


def camera(size: int) -> Camera:
    """Square image of the whole head."""
    return tracked_camera(FOCAL_SIZES * size, size, size)


def sequence(model: HeadModel, n_frames: int, size: int) -> TrackedSequence:
    """A track without landmarks; training looks at its motion only."""
    return TrackedSequence(
        head_model=model.name,
        shape=torch.zeros(model.n_shape),
        motion=motion(model, n_frames),
        camera=camera(size),
        landmarks=Landmarks(torch.zeros(n_frames, 478, 2), torch.ones(n_frames), size, size),
        tracked=torch.ones(n_frames, dtype=torch.bool),
        error_px=torch.zeros(n_frames),
        fps=25.0,
        source_sha256="0" * 64,
    )


def avatar(n_face: int, n_mouth: int, degree: int, size: int, *, local: bool = False) -> Avatar:
    """An avatar on the open head with so many Gaussians, opacities as training leaves them, small random deltas.

    Args:
        n_face: Gaussians of the face.
        n_mouth: Gaussians of the mouth.
        degree: of its view-dependent colour.
        size: of the image that it is placed for, px.
        local: deltas only where an expression moves the surface, as in training.
    """
    model = head.load("open")
    config = TrainConfig(
        n_gaussians=n_face // COPIES, n_mouth_gaussians=n_mouth // COPIES, resolution=size, sh_degree=degree
    )
    first = init_avatar(model, torch.zeros(model.n_shape), config, motion=motion(model, 16), camera=camera(size))
    random = torch.Generator().manual_seed(0)

    def repeated(axis: int):
        return lambda tensor: tensor.repeat_interleave(COPIES, axis)

    def spread(params: GaussianParams) -> GaussianParams:
        params = params.map(repeated(0))
        extent = params.log_scales.exp()
        return replace(
            params,
            means=params.means + extent * torch.randn(extent.shape, generator=random),
            log_scales=params.log_scales - 0.5 * math.log(COPIES),
            opacity_logits=_trained_opacities(params.n, random).logit(),
        )

    deltas = first.deltas.map(repeated(1))
    live = (deltas.means != 0).any(-1) if local else torch.ones(deltas.means.shape[:2], dtype=torch.bool)
    live[first.n_bases :] = True
    for _, delta in each(deltas):
        noise = torch.randn(delta.shape, generator=random)
        delta.add_(noise * live.view(*live.shape, *[1] * (delta.ndim - 2)), alpha=1e-3)
    return replace(
        first,
        neutral=spread(first.neutral),
        mouth_upper=spread(first.mouth_upper),
        mouth_lower=spread(first.mouth_lower),
        deltas=deltas,
        skin_weights=repeated(0)(first.skin_weights),
        pose_basis=repeated(1)(first.pose_basis),
        meta=first.meta | {"n_moved": first.meta["n_moved"] * COPIES},
    )


def _trained_opacities(n: int, random: torch.Generator) -> Tensor:
    """45 % nearly opaque, the rest mostly faint, as in ``benchmarks.scenes``."""
    opaque = 0.75 + 0.245 * torch.rand(n, generator=random)
    faint = 0.004 + 0.9 * torch.rand(n, generator=random).square()
    return torch.where(torch.rand(n, generator=random) < 0.45, opaque, faint)


def noise_dataset(n_frames: int, size: int) -> Dataset:
    """Crops of noise in memory: what a step costs does not depend on what is seen."""
    random = np.random.default_rng(0)
    frames = random.integers(0, 256, (n_frames, size, size, 3), np.uint8)
    mattes = random.integers(0, 256, (n_frames, size, size), np.uint8)
    boxes = np.tile(np.array([0, 0, size, size]), (n_frames, 1))
    split = Split(tuple(range(n_frames)), ())
    return Dataset(Path(tempfile.gettempdir()), frames, mattes, boxes, camera(size), split, "noise")
