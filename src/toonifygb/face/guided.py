"""Soft mattes from coarse ones: guided filter, and the foreground colour under a soft edge.

All images here are float32, 0..1. Windows are boxes, so every cost is independent of their radius.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float


def box_mean(image: Float[np.ndarray, "h w *c"], radius: int) -> Float[np.ndarray, "h w *c"]:
    """Mean over (2 · radius + 1)² px, the image reflected at its border."""
    size = (2 * radius + 1, 2 * radius + 1)
    return cv2.boxFilter(image, -1, size, borderType=cv2.BORDER_REFLECT_101)  # type: ignore[return-value]


def guided_filter(
    guide: Float[np.ndarray, "h w 3"], matte: Float[np.ndarray, "h w"], radius: int, epsilon: float, step: int = 1
) -> Float[np.ndarray, "h w"]:
    """The matte whose edges follow the guide: He et al. 2013, colour guide (eqs. 19-21), fast variant of 2015.

    In every window the result is an affine function of the guide's colour, fitted to the given matte.

    Args:
        guide: the image the matte belongs to.
        matte: the matte to refine.
        radius: half the window's side, px; about the distance by which the matte's edge may be wrong.
        epsilon: colour variance below which a window counts as flat; flat windows give their mean.
        step: fits on an image reduced by this factor; 1 is exact.
    """
    height, width = matte.shape
    small = (max(1, width // step), max(1, height // step))
    image = guide if step == 1 else cv2.resize(guide, small, interpolation=cv2.INTER_AREA)
    target = matte if step == 1 else cv2.resize(matte, small, interpolation=cv2.INTER_AREA)
    r = max(1, radius // step)
    mean_i, mean_p = box_mean(image, r), box_mean(target, r)
    rows, columns = np.triu_indices(3)
    products = box_mean(image[..., rows] * image[..., columns], r)
    products -= mean_i[..., rows] * mean_i[..., columns]
    covariance_ip = box_mean(image * target[..., None], r) - mean_i * mean_p[..., None]
    slope = _solve_symmetric(products, covariance_ip, epsilon)
    offset = mean_p - (slope * mean_i).sum(-1)
    mean_slope, mean_offset = box_mean(slope, r), box_mean(offset, r)
    if step > 1:
        mean_slope = cv2.resize(mean_slope, (width, height), interpolation=cv2.INTER_LINEAR)
        mean_offset = cv2.resize(mean_offset, (width, height), interpolation=cv2.INTER_LINEAR)
    return (mean_slope * guide).sum(-1) + mean_offset


def _solve_symmetric(
    upper: Float[np.ndarray, "h w 6"], right: Float[np.ndarray, "h w 3"], epsilon: float
) -> Float[np.ndarray, "h w 3"]:
    """Solution of (A + epsilon I) x = right by cofactors; ``upper`` is A's upper triangle, row by row."""
    a, b, c, d, e, f = np.moveaxis(upper.astype(np.float64), -1, 0)
    a, d, f = a + epsilon, d + epsilon, f + epsilon
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    x, y, z = np.moveaxis(right, -1, 0)
    solved = np.stack([aa * x + bb * y + cc * z, bb * x + dd * y + ee * z, cc * x + ee * y + ff * z], -1)
    return (solved / (a * aa + b * bb + c * cc)[..., None]).astype(np.float32)


def foreground_color(
    image: Float[np.ndarray, "h w 3"], matte: Float[np.ndarray, "h w"], radius: int
) -> Float[np.ndarray, "h w 3"]:
    """Colour of the foreground alone at every pixel: Forte 2021, "blur-fusion", in three rounds.

    Solves image = matte · F + (1 - matte) · B for F, starting from means of both over a wide window and going to
    narrow ones. The means are weighted by the cubes of matte and 1 - matte instead of the matte itself: pixels that
    are nearly pure know the colours, mixed ones would carry the background into F. Where the matte is 1 the result
    is the image; far outside it is the colour of the nearest foreground.
    """
    alpha = matte[..., None]
    foreground = background = image
    weight_f, weight_b = matte**3, (1 - matte) ** 3
    for r in (radius, max(1, radius // 2), max(1, radius // 8)):
        mean_f = box_mean(foreground * weight_f[..., None], r) / (box_mean(weight_f, r) + 1e-5)[..., None]
        mean_b = box_mean(background * weight_b[..., None], r) / (box_mean(weight_b, r) + 1e-5)[..., None]
        foreground = np.clip(mean_f + alpha * (image - alpha * mean_f - (1 - alpha) * mean_b), 0, 1)
        background = mean_b
    return foreground
