"""Grain, bristles and hatching that stay put: in the picture for paper, on the head for strokes.

A texture that slides over a moving head looks like a dirty window. So the coordinates in which strokes are laid
come from the head's landmarks inside the head and from the picture outside.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.stylize.anchors import EYES, OVAL, face_mask

if TYPE_CHECKING:
    from jaxtyping import Float

    Plane = Float[np.ndarray, "h w"]
    Points = Float[np.ndarray, "478 2"]

IDENTITY = np.eye(2, 3)
"""Place of a texture at rest in the picture."""
TILE = 512
"""Side of the periodic noise tile, px."""
RIGID = (
    *OVAL[:8],
    *OVAL[-8:],
    6,
    197,
    195,
    5,
    168,
    8,
    *(eye.upper[0] for eye in EYES),
    *(eye.upper[-1] for eye in EYES),
)
"""Landmarks that move with the skull and not with the mouth."""


@functools.lru_cache(maxsize=8)
def noise_tile(sigma_px: float, seed: int) -> Float[np.ndarray, "512 512"]:
    """Periodic smooth noise with mean 0 and standard deviation 1. Read-only."""
    raw = np.random.Generator(np.random.PCG64(seed)).random((TILE, TILE)).astype(np.float32) - np.float32(0.5)
    margin = TILE // 4
    smooth = cv2.GaussianBlur(np.pad(raw, margin, mode="wrap"), (0, 0), sigma_px)[margin:-margin, margin:-margin]
    smooth = (smooth - smooth.mean()) / smooth.std()
    smooth.setflags(write=False)
    return smooth


def fixed_noise(shape: tuple[int, int], sigma_px: float, seed: int, zoom: float = 1.0) -> Plane:
    """Noise at rest in the picture, ``zoom`` texels of the tile per px. Read-only."""
    return _fixed_noise(shape, sigma_px, seed, zoom)


@functools.lru_cache(maxsize=8)
def _fixed_noise(shape: tuple[int, int], sigma_px: float, seed: int, zoom: float) -> Plane:
    plane = laid(shape, noise_tile(sigma_px, seed), IDENTITY, zoom)
    plane.setflags(write=False)
    return plane


def laid(
    shape: tuple[int, int], tile: Float[np.ndarray, "512 512"], place: Float[np.ndarray, "2 3"], zoom: float
) -> Plane:
    """The tile, repeated without end, seen through the affine map ``place`` (picture px to texture px)."""
    # cv2 counts from pixel centres on both sides; only where the origin of the tile lies changes, which is free
    return cv2.warpAffine(
        tile,
        (place * zoom).astype(np.float64),
        (shape[1], shape[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_WRAP,
    )


def head_place(points: Points, template: Points) -> Float[np.ndarray, "2 3"]:
    """The affine map from today's picture onto the face of ``template``, on which strokes ride with the head."""
    rigid = list(RIGID)
    source = np.concatenate([points[rigid], np.ones((len(rigid), 1))], axis=1).astype(np.float64)
    affine, *_ = np.linalg.lstsq(source, template[rigid].astype(np.float64), rcond=None)
    return affine.T


def head_share(shape: tuple[int, int], points: Points, presence: float, unit: float) -> Plane:
    """Where strokes ride on the head: the face outline, widened to hair and neck; 0..1."""
    centre = points[list(OVAL)].mean(0)
    grown = centre + (points - centre) * np.array([1.25, 1.35], np.float32)
    return face_mask(shape, grown.astype(np.float32), 0.06 * unit) * np.float32(presence)


def anchored_noise(
    shape: tuple[int, int],
    points: Points,
    presence: float,
    template: Points,
    unit: float,
    grain: float,
    seed: int,
) -> Plane:
    """Noise of unit strength that moves with the head inside it and is fixed in the picture outside.

    Args:
        shape: height and width.
        points: landmarks in px of this picture.
        presence: 0..1.
        template: landmarks that define the head's own coordinates, px of the same picture size.
        unit: face width in px.
        grain: size of a grain in face widths.
        seed: which noise.
    """
    zoom = 2.0 / max(grain * unit, 0.5)  # a grain is two texels of the tile
    fixed = fixed_noise(shape, 1.0, seed, zoom)
    if presence == 0:
        return fixed
    riding = laid(shape, noise_tile(1.0, seed), head_place(points, template), zoom)
    share = head_share(shape, points, presence, unit)
    return (fixed * (1.0 - share) + riding * share) / np.sqrt(share * share + (1.0 - share) ** 2)
