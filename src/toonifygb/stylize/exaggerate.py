"""Caricature by landmarks: larger eyes and a slimmer chin, as a smooth warp of the picture.

The warp is a function of the landmarks alone. ``sources`` says where in the input each output position looks;
``move_points`` inverts it for landmarks, so that whatever was found in the input can be carried to the output.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.stylize.anchors import EYES, Eye, face_widths
from toonifygb.stylize.filters import sample, smoothstep

if TYPE_CHECKING:
    from jaxtyping import Float

    Points = Float[np.ndarray, "n 2"]

JAWS = ((172, 136, 150), (397, 365, 379))
CHIN, FOREHEAD = 152, 10
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
    """A soft elliptical region of the picture, in px."""

    centre: Float[np.ndarray, " 2"]
    radii: Float[np.ndarray, " 2"]
    axis: Float[np.ndarray, " 2"]
    """Unit direction of the first radius."""


def _eye_bump(points: Points, eye: Eye) -> _Bump:
    """Region of an eye; from its corners only, which do not move when it blinks."""
    outer, inner = points[eye.upper[0]], points[eye.upper[-1]]
    width = float(np.linalg.norm(inner - outer))
    widest = max(float(np.linalg.norm(points[e.upper[-1]] - points[e.upper[0]])) for e in EYES)
    axis = (inner - outer) / max(width, 1e-6)
    return _Bump(0.5 * (outer + inner), np.array([1.1 * width, 1.0 * widest]) + 1e-6, axis)


def offsets(
    positions: Float[np.ndarray, "*b 2"], points: Points, amount: Exaggeration
) -> Float[np.ndarray, "*b 2"]:
    """Where output positions look, relative to themselves, in px.

    Inside an eye's region the picture is magnified about the eye's centre, fully in the inner third and fading to
    nothing at its border; the map stays one-to-one for gains below 1.6.
    """
    moved = np.zeros(positions.shape, np.float32)
    shrink = 1.0 - 1.0 / amount.eye_gain
    for eye in EYES if shrink else ():
        bump = _eye_bump(points, eye)
        away = positions - bump.centre.astype(np.float32)
        axes = np.stack([bump.axis, [-bump.axis[1], bump.axis[0]]]) / bump.radii[:, None]
        local = away @ axes.T.astype(np.float32)
        inside = 1.0 - smoothstep(0.3, 1.0, np.hypot(local[..., 0], local[..., 1]))
        moved -= np.float32(shrink) * inside[..., None] * away
    if amount.chin:
        moved += _jaw_offsets(positions, points, amount.chin)
    return moved


def _jaw_offsets(positions: Float[np.ndarray, "*b 2"], points: Points, chin: float) -> Float[np.ndarray, "*b 2"]:
    width = float(face_widths(points[None])[0])
    up = points[FOREHEAD] - points[CHIN]
    across = np.array([-up[1], up[0]]) / max(float(np.linalg.norm(up)), 1e-6)
    moved = np.zeros(positions.shape, np.float32)
    for jaw in JAWS:
        centre = points[list(jaw)].mean(0)
        outward = across * np.sign((centre - points[CHIN]) @ across)
        away = positions - centre.astype(np.float32)
        near = np.exp(-0.5 * (away[..., 0] ** 2 + away[..., 1] ** 2) / np.float32((0.2 * width + 1e-6) ** 2))
        moved += near[..., None] * (np.float32(chin * width) * outward.astype(np.float32))
    return moved


def move_points(points: Points, amount: Exaggeration, anchors: Points | None = None) -> Points:
    """Positions carried along by the warp (the inverse of its look-up, by fixed point).

    Args:
        points: px; NaN stays NaN.
        amount: how far.
        anchors: landmarks that define the warp; ``points`` themselves when unset.
    """
    anchors = points if anchors is None else anchors
    moved = points.astype(np.float32)
    for _ in range(0 if amount.is_none else INVERSION_STEPS):
        moved = points - offsets(moved, anchors, amount)
    return moved.astype(np.float32)


def _region(points: Points, width: int, height: int, chin: bool) -> tuple[slice, slice]:
    """Rows and columns the warp can change."""
    reach = [_eye_bump(points, eye) for eye in EYES]
    low = np.min([bump.centre - bump.radii.max() for bump in reach], axis=0)
    high = np.max([bump.centre + bump.radii.max() for bump in reach], axis=0)
    if chin:  # the Gaussian of the jaw moves less than 0.001 face widths beyond 2.7 sigma
        jaws = np.stack([points[list(jaw)].mean(0) for jaw in JAWS])
        margin = 0.2 * 3.5 * float(face_widths(points[None])[0])
        low, high = np.minimum(low, jaws.min(0) - margin), np.maximum(high, jaws.max(0) + margin)
    left, top = np.clip(np.floor(low), 0, [width, height]).astype(int)
    right, bottom = np.clip(np.ceil(high), 0, [width, height]).astype(int)
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def warp(image: np.ndarray, points: Points, amount: Exaggeration) -> np.ndarray:
    """The picture with the caricature applied; pixels beyond its reach are the input's, bit for bit.

    Args:
        image: any dtype OpenCV remaps, ``h w`` or ``h w c``.
        points: landmarks in px of this picture.
        amount: how far.
    """
    rows, columns = _region(points, image.shape[1], image.shape[0], amount.chin > 0)
    if amount.is_none or rows.start >= rows.stop or columns.start >= columns.stop:
        return image
    y, x = np.mgrid[rows, columns].astype(np.float32)
    indices = np.stack([x, y], axis=-1)
    where = indices + offsets(indices + np.float32(0.5), points, amount)
    out = image.copy()
    out[rows, columns] = sample(image, where, cv2.INTER_CUBIC)
    return out
