"""Soft mattes from coarse ones: guided filter, and the foreground colour under a soft edge.

All images here are float32, 0..1. Windows are boxes, so every cost is independent of their radius. Channels are
kept as planes: arithmetic on them is several times faster than numpy's along an axis of three.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jaxtyping import Float

    Plane = Float[np.ndarray, "h w"]


SMOOTH_RADIUS = 8
"""Least radius, px, of a mean that is taken on a reduced image: its steps then stay invisible."""


def box_mean(image: Float[np.ndarray, "h w *c"], radius: int) -> Float[np.ndarray, "h w *c"]:
    """Mean over (2 · radius + 1)² px, the image reflected at its border."""
    size = (2 * radius + 1, 2 * radius + 1)
    return cv2.boxFilter(image, -1, size, borderType=cv2.BORDER_REFLECT_101)  # type: ignore[return-value]


class GuidedFilter:
    """Mattes whose edges follow an image: He et al. 2013, colour guide (eqs. 19-21), fast variant of 2015.

    In every window the result is an affine function of the guide's colour, fitted to the given matte. What depends
    on the guide alone is computed once.

    Args:
        guide: the image the mattes belong to.
        radius: half the window's side, px; about the distance by which a matte's edge may be wrong.
        epsilon: colour variance below which a window counts as flat; flat windows give their mean.
        step: fits on an image reduced by this factor; 1 is exact.
    """

    def __init__(self, guide: Float[np.ndarray, "h w 3"], radius: int, epsilon: float, step: int = 1) -> None:
        self._shape, self._step = guide.shape[:2], step
        self._radius = max(1, radius // step)
        self._guide = cv2.split(guide)
        self._colors = cv2.split(self._reduce(guide))
        self._means = [self._mean(color) for color in self._colors]
        self._solve = _solver([self._covariance(i, j) for i in range(3) for j in range(i, 3)], epsilon)

    def __call__(self, matte: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """The refined matte."""
        target = self._reduce(matte)
        mean = self._mean(target)
        covariances = [
            self._mean(color * target) - color_mean * mean
            for color, color_mean in zip(self._colors, self._means, strict=True)
        ]
        slopes = self._solve(covariances)
        offset = mean - _dot(slopes, self._means)
        mean_slopes = [self._enlarge(self._mean(slope)) for slope in slopes]
        return _dot(mean_slopes, self._guide) + self._enlarge(self._mean(offset))

    def _mean(self, plane: Plane) -> Plane:
        return box_mean(plane, self._radius)

    def _covariance(self, i: int, j: int) -> Plane:
        return self._mean(self._colors[i] * self._colors[j]) - self._means[i] * self._means[j]

    def _reduce(self, image: Float[np.ndarray, "h w *c"]) -> Float[np.ndarray, "r s *c"]:
        return reduced(image, self._step)

    def _enlarge(self, plane: Plane) -> Plane:
        return enlarged(plane, self._shape)


def reduced(image: Float[np.ndarray, "h w *c"], step: int) -> Float[np.ndarray, "r s *c"]:
    """The image at one ``step``-th of its size, by area."""
    return _resized(image, (max(1, image.shape[1] // step), max(1, image.shape[0] // step)), cv2.INTER_AREA)


def enlarged(plane: Float[np.ndarray, "r s"], shape: tuple[int, ...]) -> Plane:
    """A smooth plane of a reduced image at the size (height, width) that it was reduced from."""
    return _resized(plane, (shape[1], shape[0]), cv2.INTER_LINEAR)


def _resized(image: np.ndarray, size: tuple[int, int], method: int) -> np.ndarray:
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=method)


def _dot(first: Sequence[Plane], second: Sequence[Plane]) -> Plane:
    """Sum over the channels of the products."""
    (a, b, c), (x, y, z) = first, second
    return a * x + b * y + c * z


def _solver(upper: Sequence[Plane], epsilon: float) -> Callable[[Sequence[Plane]], list[Plane]]:
    """Function that solves (A + epsilon I) x = right at every pixel, by cofactors in double precision.

    Args:
        upper: A's upper triangle, row by row.
        epsilon: added to A's diagonal.
    """
    a, b, c, d, e, f = (plane.astype(np.float64) for plane in upper)
    a, d, f = a + epsilon, d + epsilon, f + epsilon
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * bb + c * cc
    rows = ((aa, bb, cc), (bb, dd, ee), (cc, ee, ff))
    return lambda right: [(_dot(row, right) / determinant).astype(np.float32) for row in rows]


def foreground_color(
    image: Float[np.ndarray, "h w 3"], matte: Float[np.ndarray, "h w"], radius: int
) -> Float[np.ndarray, "h w 3"]:
    """Colour of the foreground alone at every pixel: Forte 2021, "blur-fusion", in three rounds.

    Solves image = matte · F + (1 - matte) · B for F, starting from means of both over a wide window and going to
    narrow ones. The means are weighted by the cubes of matte and 1 - matte instead of the matte itself: pixels that
    are nearly pure know the colours, mixed ones would carry the background into F. Where the matte is 1 the result
    is the image; far outside it is the colour of the nearest foreground.

    The two wide rounds, whose means are smooth, run on a reduced image where the radius allows it.
    """
    step = max(1, radius // 2 // SMOOTH_RADIUS)
    small = cv2.split(reduced(image, step))
    wide = [max(1, radius // step), max(1, radius // 2 // step)]
    found = _unmixed(small, reduced(matte, step), (small, small), wide)
    start = [[enlarged(plane, matte.shape) for plane in planes] for planes in found]
    foregrounds, _ = _unmixed(cv2.split(image), matte, (start[0], start[1]), [max(1, radius // 8)])
    return cv2.merge(foregrounds)


def _unmixed(
    channels: Sequence[Plane],
    matte: Plane,
    start: tuple[Sequence[Plane], Sequence[Plane]],
    radii: Sequence[int],
) -> tuple[list[Plane], list[Plane]]:
    """Foreground and background colours after one round per radius, from those at the start."""
    rest = 1 - matte
    weight_f, weight_b = matte * matte * matte, rest * rest * rest  # numpy's power takes ten times as long
    foregrounds, backgrounds = list(start[0]), list(start[1])
    for r in radii:
        total_f, total_b = box_mean(weight_f, r) + 1e-5, box_mean(weight_b, r) + 1e-5
        for i, channel in enumerate(channels):
            mean_f = box_mean(foregrounds[i] * weight_f, r) / total_f
            mean_b = box_mean(backgrounds[i] * weight_b, r) / total_b
            foregrounds[i] = np.clip(mean_f + matte * (channel - matte * mean_f - rest * mean_b), 0, 1)
            backgrounds[i] = mean_b
    return foregrounds, backgrounds
