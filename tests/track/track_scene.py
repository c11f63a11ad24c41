"""Clips whose truth is known: the open head moving in front of a camera, its landmarks projected."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import torch

from toonifygb import head as heads
from toonifygb.geometry.cameras import project, tracked_camera
from toonifygb.head import HeadModel
from toonifygb.structures import HeadMotion, Landmarks, TrackedSequence

SIZE = 512
FPS = 25.0
N_SHAPE = 12


@cache
def open_head() -> HeadModel:
    return heads.load("open")


def true_shape() -> torch.Tensor:
    shape = torch.zeros(open_head().n_shape)
    shape[:N_SHAPE] = 0.7 * torch.randn(N_SHAPE, generator=torch.Generator().manual_seed(5))
    return shape


def true_motion(n_frames: int) -> HeadMotion:
    """Turning, nodding, talking, looking about, with one blink in the middle."""
    head = open_head()
    time = torch.arange(n_frames) / FPS
    joints = torch.zeros(n_frames, 5, 3)
    joints[:, 0, 0] = 0.12 * (2.1 * time).sin()
    joints[:, 0, 1] = 0.45 * (1.3 * time).sin()
    joints[:, 0, 2] = 0.10 * (1.7 * time).cos()
    joints[:, 2, 0] = 0.12 * (1 - (6.0 * time).cos())
    joints[:, 3:, 0] = 0.06 * (1.9 * time).sin()[:, None]
    joints[:, 3:, 1] = 0.20 * (1.1 * time).cos()[:, None]
    middle = time[n_frames // 2]
    eyelids = torch.exp(-(((time - middle) / 0.07) ** 2))[:, None].repeat(1, 2)
    expression = torch.zeros(n_frames, head.n_expression)
    for name in ("mouthSmileLeft", "mouthSmileRight"):
        expression[:, head.expression_names.index(name)] = 0.3 + 0.3 * (1.5 * time).sin()
    drift = torch.stack([0.02 * time.sin(), 0.01 * time.cos(), -0.62 + 0.03 * (0.8 * time).sin()], -1)
    return HeadMotion(expression, joints, drift, eyelids)


def true_clip(n_frames: int = 16, noise_px: float = 0.0, focal: float = 1.5 * SIZE) -> TrackedSequence:
    """A clip with its truth; the landmarks carry independent noise."""
    head, motion, shape = open_head(), true_motion(n_frames), true_shape()
    points, _ = head.landmarks().forward(shape, motion)
    camera = tracked_camera(focal, SIZE, SIZE)
    pixels, _ = project(camera, points)
    noise = noise_px * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(2))
    landmarks = Landmarks(pixels + noise, torch.ones(n_frames), SIZE, SIZE)
    return TrackedSequence(
        head_model=head.name,
        shape=shape,
        motion=motion,
        camera=camera,
        landmarks=landmarks,
        tracked=torch.ones(n_frames, dtype=torch.bool),
        error_px=torch.zeros(n_frames),
        fps=FPS,
        source_sha256="0" * 64,
    )


def without(landmarks: Landmarks, frames: slice | list[int]) -> Landmarks:
    """The landmarks with some frames lost."""
    points, score = landmarks.points.clone(), landmarks.score.clone()
    points[frames], score[frames] = math.nan, 0.0
    return replace(landmarks, points=points, score=score)
