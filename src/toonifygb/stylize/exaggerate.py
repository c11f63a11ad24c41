"""Caricature by landmarks: larger eyes and a slimmer chin, as a smooth warp of the picture.

The warp is a function of the landmarks alone. ``offsets`` says where in the input each output position looks;
``move_points`` inverts it, so that whatever was found in the input can be carried to the output.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.stylize.anchors import EYES, Eye, box_around, face_widths, is_empty
from toonifygb.stylize.filters import pixel_grid, sample, smoothstep

if TYPE_CHECKING:
    from jaxtyping import Float

    Points = Float[np.ndarray, "n 2"]

JAWS = ((172, 136, 150), (397, 365, 379))
CHIN, FOREHEAD = 152, 10
JAW_SIGMA = 0.2
"""Standard deviation of the jaw's region in face widths."""
INVERSION_STEPS = 12
"""Fixed-point steps; each at least halves the error, so 100 px shrink below 0.03 px."""


@dataclass(frozen=True)
class Exaggeration:
    """How far the geometry of the face is overdrawn; the default leaves it as it is."""

    eye_gain: float = 1.0
    """Magnification at the centre of each eye."""
    chin: float = 0.0
    """How far each side of the jaw moves inwards, in face widths."""

    def scaled(self, amount: float) -> Exaggeration:
        """The same caricature at ``amount`` 0..1 of its strength."""
        return Exaggeration(1.0 + (self.eye_gain - 1.0) * amount, self.chin * amount)

    @property
    def is_none(self) -> bool:
        """Whether nothing would move."""
        return self.eye_gain == 1.0 and self.chin == 0.0


@dataclass(frozen=True)
class _Bump:
    """A soft elliptical region, px, and what happens in it."""

    centre: Float[np.ndarray, " 2"]
    axes: Float[np.ndarray, "2 2"]
    """Rows: the directions of the radii, each divided by its radius."""
    reach: float
    """Largest radius."""
    shrink: float = 0.0
    """Share by which look-ups near the centre are drawn towards it."""
    push: Float[np.ndarray, " 2"] | None = None
    """Shift of the look-ups at the centre, px."""

    @property
    def extremes(self) -> Float[np.ndarray, "2 2"]:
        """Corners of a box that holds the region."""
        return np.stack([self.centre - self.reach, self.centre + self.reach])


def _bumps(points: Points, amount: Exaggeration) -> list[_Bump]:
    """The regions of a face that the caricature moves."""
    bumps = []
    if amount.eye_gain != 1.0:
        bumps += [_eye_bump(points, eye, 1.0 - 1.0 / amount.eye_gain) for eye in EYES]
    if amount.chin != 0.0:
        bumps += _jaw_bumps(points, amount.chin)
    return bumps


def _eye_bump(points: Points, eye: Eye, shrink: float) -> _Bump:
    """Region of an eye; from its corners only, which do not move when it blinks."""
    outer, inner = points[eye.upper[0]], points[eye.upper[-1]]
    width = float(np.linalg.norm(inner - outer)) + 1e-6
    widest = max(float(np.linalg.norm(points[e.upper[-1]] - points[e.upper[0]])) for e in EYES) + 1e-6
    x, y = (inner - outer) / width
    radii = np.array([1.1 * width, widest])  # a turned head narrows the eye, not its height
    axes = np.array([[x, y], [-y, x]]) / radii[:, None]
    return _Bump(0.5 * (outer + inner), axes, float(radii.max()), shrink=shrink)


def _jaw_bumps(points: Points, chin: float) -> list[_Bump]:
    width = float(face_widths(points[None])[0]) + 1e-6
    up = points[FOREHEAD] - points[CHIN]
    across = np.array([-up[1], up[0]]) / (float(np.linalg.norm(up)) + 1e-6)
    bumps = []
    for jaw in JAWS:
        centre = points[list(jaw)].mean(0)
        outward = across * np.sign((centre - points[CHIN]) @ across)
        radius = 2.0 * JAW_SIGMA * width
        bumps.append(_Bump(centre, np.eye(2) / radius, radius, push=chin * width * outward))
    return bumps


def offsets(
    positions: Float[np.ndarray, "*b 2"], points: Points, amount: Exaggeration
) -> Float[np.ndarray, "*b 2"]:
    """Where output positions look, relative to themselves, in px.

    Inside an eye's region the picture is magnified about the eye's centre, fully in the inner third and fading to
    nothing at its border; the map stays one-to-one for gains below 1.6.
    """
    return _offsets(positions, _bumps(points, amount))


def _offsets(positions: Float[np.ndarray, "*b 2"], bumps: list[_Bump]) -> Float[np.ndarray, "*b 2"]:
    x, y = positions[..., 0], positions[..., 1]
    moved_x, moved_y = np.zeros_like(x), np.zeros_like(y)
    for bump in bumps:
        away_x, away_y = x - np.float32(bump.centre[0]), y - np.float32(bump.centre[1])
        axes = bump.axes.astype(np.float32)
        across = axes[0, 0] * away_x + axes[0, 1] * away_y
        down = axes[1, 0] * away_x + axes[1, 1] * away_y
        squared = across * across + down * down
        if bump.push is not None:
            near = np.maximum(1.0 - squared, 0.0) ** 2
            moved_x += near * np.float32(bump.push[0])
            moved_y += near * np.float32(bump.push[1])
        else:
            inside = np.float32(-bump.shrink) * (1.0 - smoothstep(0.3, 1.0, np.sqrt(squared)))
            moved_x += inside * away_x
            moved_y += inside * away_y
    return np.stack([moved_x, moved_y], axis=-1)


def move_points(points: Points, amount: Exaggeration, anchors: Points | None = None) -> Points:
    """Positions carried along by the warp (the inverse of its look-up, by fixed point).

    Args:
        points: px; NaN stays NaN.
        amount: how far.
        anchors: landmarks that define the warp; ``points`` themselves when unset.
    """
    target = points.astype(np.float32)
    moved = target
    bumps = _bumps(points if anchors is None else anchors, amount)
    for _ in range(INVERSION_STEPS if bumps else 0):
        moved = target - _offsets(moved, bumps)
    return moved


def warp(image: np.ndarray, points: Points, amount: Exaggeration) -> np.ndarray:
    """The picture with the caricature applied; pixels beyond its reach are the input's, bit for bit.

    Args:
        image: any dtype OpenCV remaps, ``h w`` or ``h w c``.
        points: landmarks in px of this picture.
        amount: how far.
    """
    bumps = _bumps(points, amount)
    if not bumps:
        return image
    box = box_around(np.concatenate([bump.extremes for bump in bumps]), 0.0, image.shape)
    if is_empty(box):
        return image
    indices = pixel_grid(*image.shape[:2])
    where = indices.copy()
    for bump in bumps:  # each in its own box, beyond which it moves nothing
        own = box_around(bump.extremes, 0.0, image.shape)
        where[own] += _offsets(indices[own] + np.float32(0.5), [bump])
    out = image.copy()
    out[box] = sample(image, where[box], cv2.INTER_CUBIC)
    return out
