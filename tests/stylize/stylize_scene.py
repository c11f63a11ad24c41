"""A drawn portrait that moves, with the landmarks that belong to it: input for the tests of the styles."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from toonifygb.structures import Landmarks
from toonifygb.stylize import anchors

FACE_WIDTH = 0.45
"""Face width in shorter sides of the picture."""


def blank_face() -> np.ndarray:
    """478 landmarks of a frontal face one unit wide, centred on the origin, y down."""
    points = np.zeros((anchors.N_POINTS, 2), np.float32)

    def ring(indices, centre, radii, start=0.0, turn=2 * np.pi, ends=False):
        steps = np.arange(len(indices)) / (len(indices) - (1 if ends else 0))
        angle = start + turn * steps
        points[list(indices)] = np.stack([np.sin(angle), -np.cos(angle)], -1) * radii + centre

    ring(anchors.OVAL, (0, 0), (0.5, 0.66))
    ring(anchors.LIPS, (0, 0.33), (0.16, 0.07), start=-np.pi / 2, turn=-2 * np.pi)
    ring(anchors.MOUTH, (0, 0.33), (0.12, 0.02), start=-np.pi / 2, turn=-2 * np.pi)
    for eye, side in zip(anchors.EYES, (-1, 1), strict=True):
        centre = (0.22 * side, -0.08)
        ring(eye.upper, centre, (0.1, 0.045), start=side * np.pi / 2, turn=-side * np.pi, ends=True)
        ring(eye.lower, centre, (0.1, 0.035), start=side * np.pi / 2, turn=side * np.pi, ends=True)
        ring(eye.brow, (0.22 * side, -0.22), (0.13, 0.03))
        ring(eye.rim, centre, (0.04, 0.04))
        points[eye.iris] = centre
    points[list(anchors.CHEEKS)] = [(-0.28, 0.12), (0.28, 0.12)]
    points[list(anchors.NOSE_BASE)] = np.stack([np.linspace(-0.1, 0.1, 7), np.full(7, 0.16)], -1)
    return points


def face_at(width: int, height: int, shift_px: float = 0.0) -> np.ndarray:
    """The face in the middle of a picture, moved to the right."""
    side = FACE_WIDTH * min(width, height)
    return (blank_face() * side + np.float32([width / 2 + shift_px, height / 2])).astype(np.float32)


def landmarks(n_frames: int, width: int, height: int, *, shift_px: float = 0.0, lost=()) -> Landmarks:
    """Landmarks of ``frames``; NaN in the frames named by ``lost``."""
    points = np.stack([face_at(width, height, shift_px * index) for index in range(n_frames)])
    points[list(lost)] = np.nan
    score = torch.ones(n_frames)
    score[list(lost)] = 0.0
    return Landmarks(torch.from_numpy(points), score, width, height)


def frames(
    n_frames: int, width: int, height: int, *, shift_px: float = 0.0, noise: float = 0.0
) -> list[np.ndarray]:
    """Frames of the portrait in front of a toned wall.

    Args:
        n_frames: how many.
        width: px.
        height: px.
        shift_px: motion to the right per frame.
        noise: standard deviation of the sensor noise in 8-bit levels.
    """
    random = np.random.default_rng(3)
    wall = np.linspace(90, 170, width, dtype=np.float32)[None, :, None] * np.float32([0.8, 0.95, 1.0])
    wall = np.broadcast_to(wall, (height, width, 3))
    clip = []
    for index in range(n_frames):
        points = face_at(width, height, shift_px * index)
        frame = wall.astype(np.uint8).copy()

        def polygon(indices, colour, frame=frame, points=points):
            corners = np.rint((points[list(indices)] - 0.5) * 16).astype(np.int32)
            cv2.fillPoly(frame, [corners], colour, cv2.LINE_AA, 4)

        polygon(anchors.OVAL, (214, 172, 148))
        polygon(anchors.LIPS, (176, 88, 90))
        for eye in anchors.EYES:
            polygon(eye.brow, (60, 40, 34))
            polygon(eye.upper + eye.lower[-2:0:-1], (235, 235, 232))
            polygon(eye.rim, (50, 60, 70))
        noisy = frame + random.normal(0.0, noise, frame.shape) if noise else frame
        clip.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return clip
