"""Image filters the drawn styles are made of: flow fields, line responses, painterly smoothing, tone curves.

All work on float32 arrays, are pure, and give the same bits for any number of OpenCV threads. Radii and standard
deviations are px of the image at hand; callers derive them from the size of the face.
"""

from __future__ import annotations

import functools
import itertools
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

    Plane = Float[np.ndarray, "h w"]
    Picture = Float[np.ndarray, "h w c"]
    Field = Float[np.ndarray, "h w 2"]

LAB_RANGE = 100.0
"""Largest L of CIE Lab."""
BORDER = cv2.BORDER_REFLECT_101


def to_lab(frame: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Bytes of sRGB to CIE Lab, L 0..100: the perceptual space in which bands and lines are decided."""
    return cv2.cvtColor(frame.astype(np.float32) * np.float32(1 / 255), cv2.COLOR_RGB2Lab)


def to_rgb(lab: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """CIE Lab to sRGB 0..1; colours outside the gamut are clipped."""
    return np.clip(cv2.cvtColor(lab, cv2.COLOR_Lab2RGB), 0.0, 1.0)


def to_bytes(rgb: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Colours 0..1 to bytes, rounded to nearest."""
    return cv2.convertScaleAbs(np.maximum(rgb, 0.0), alpha=255.0)


def working_size(shape: tuple[int, ...], unit: float, face_px: float) -> tuple[float, tuple[int, int]]:
    """Scale at which a face ``unit`` px wide is at most ``face_px`` wide, and the (width, height) then."""
    scale = min(1.0, face_px / unit)
    return scale, (max(1, round(shape[1] * scale)), max(1, round(shape[0] * scale)))


def resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The picture at another size: area-averaged when it shrinks, cubic when it grows."""
    if image.shape[1] == width and image.shape[0] == height:
        return image
    shrinks = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def blur(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """Gaussian blur with mirrored borders."""
    if sigma_px < 0.2:  # narrower than the sampling can represent
        return image
    return cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=BORDER)


def wide_blur(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """Gaussian blur of great width, taken at a reduced size at which it is four px wide."""
    factor = sigma_px / 4.0
    if factor <= 1.5:  # not worth the detour
        return blur(image, sigma_px)
    height, width = image.shape[:2]
    small = resize(image, max(1, round(width / factor)), max(1, round(height / factor)))
    small = blur(small, 4.0)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def smoothstep(low: float, high: float, value: np.ndarray) -> np.ndarray:
    """0 below ``low``, 1 above ``high``, and a cubic with level ends between."""
    t = np.asarray(value - np.float32(low))
    t *= np.float32(1.0 / (high - low))
    np.clip(t, 0.0, 1.0, out=t)
    return t * t * (3.0 - 2.0 * t)


def mix(first: np.ndarray, second: np.ndarray | float, amount: np.ndarray | float) -> np.ndarray:
    """``first`` where ``amount`` is 0, ``second`` where it is 1; a plane of amounts serves all channels."""
    if isinstance(amount, np.ndarray) and amount.ndim == first.ndim - 1:
        amount = spread(amount, first.shape[-1])
    return first + (second - first) * amount


def tint(picture: Picture, colour: Float[np.ndarray, " c"], amount: Plane) -> Picture:
    """``picture`` with one colour laid over it; as ``mix``, channel by channel, which is faster."""
    channels = (picture[..., index] for index in range(picture.shape[2]))
    return cv2.merge([plane + (value - plane) * amount for plane, value in zip(channels, colour, strict=True)])


def spread(plane: Plane, channels: int) -> Picture:
    """The plane repeated for every channel: arithmetic on whole pictures is several times faster than numpy's
    broadcasting along so short an axis.
    """
    return cv2.merge([plane] * channels)


def dot(first: Picture, second: Picture) -> Plane:
    """Sum over the channels of the product (a plain ``sum`` over so short an axis is ten times slower)."""
    product = first * second
    return cv2.transform(product, np.ones((1, product.shape[2]), np.float32)).reshape(product.shape[:2])


@functools.lru_cache(maxsize=8)
def pixel_grid(height: int, width: int) -> Field:
    """(x, y) array index of every pixel; what ``cv2.remap`` expects where nothing moves. Read-only."""
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
    grid.setflags(write=False)
    return grid


def sample(image: np.ndarray, where: Field, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Look-up at array indices (x, y), mirrored outside."""
    no_second_map: Any = None  # OpenCV takes an (x, y) field alone, its type stubs do not
    return cv2.remap(image, where, no_second_map, interpolation, borderMode=BORDER)


def structure(lab: Picture, sigma_px: float, rest: tuple[float, float] = (0.0, 0.0)) -> tuple[Field, Plane]:
    """Direction along edges and how clear it is, from the smoothed structure tensor of all channels.

    Args:
        lab: the picture.
        sigma_px: over how far directions are averaged.
        rest: direction (rad) that the tangents take where the picture has none, and its weight in squared Lab
            units per px²; keeps strokes in flat areas from following noise.

    Returns:
        unit tangents (sign arbitrary) and anisotropy 0 (no direction) .. 1 (a straight edge).
    """
    dx = cv2.Sobel(lab, cv2.CV_32F, 1, 0, ksize=3, scale=0.125, borderType=BORDER)
    dy = cv2.Sobel(lab, cv2.CV_32F, 0, 1, ksize=3, scale=0.125, borderType=BORDER)
    tensor = cv2.merge([dot(dx, dx), dot(dx, dy), dot(dy, dy)])
    tensor = blur(tensor, sigma_px)
    angle, weight = rest
    xx = tensor[..., 0] + np.float32(weight * np.sin(angle) ** 2)
    xy = tensor[..., 1] - np.float32(weight * np.sin(angle) * np.cos(angle))
    yy = tensor[..., 2] + np.float32(weight * np.cos(angle) ** 2)
    tangent = 0.5 * np.arctan2(2.0 * xy, xx - yy) + np.float32(np.pi / 2)
    excess = np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)
    # 0.05 squared Lab units per px²: below it the direction is sensor noise, and claims no clarity
    return cv2.merge([np.cos(tangent), np.sin(tangent)]), excess / (xx + yy + np.float32(0.05))


def flow_blur(image: np.ndarray, tangents: Field, sigma_px: float, step_px: float | None = None) -> np.ndarray:
    """Gaussian blur along the edge direction: calms lines and merges strokes without widening them.

    The path is the straight tangent; over the few px used here it does not leave the edge.

    Args:
        image: one channel or several.
        tangents: unit directions.
        sigma_px: standard deviation along them.
        step_px: distance of the samples; must not exceed the finest grain of the image. 0.6 sigma when unset.
    """
    step = max(1.0, sigma_px * 0.6) if step_px is None else step_px
    grid = pixel_grid(*image.shape[:2])
    total, weight_sum = image.copy(), 1.0
    for index in range(1, max(1, round(2.0 * sigma_px / step)) + 1):
        weight = float(np.exp(-0.5 * (index * step / sigma_px) ** 2))
        offset = tangents * np.float32(index * step)
        total += np.float32(weight) * (sample(image, grid + offset) + sample(image, grid - offset))
        weight_sum += 2.0 * weight
    return total * np.float32(1.0 / weight_sum)


def ink_response(lightness: Plane, tangents: Field, sigma_px: float, ratio: float = 1.6) -> Plane:
    """How much darker a place is than its surroundings, in L, calmed along the edge flow.

    The difference of Gaussians of FDoG/XDoG (Winnemöller, Kyprianidis & Olsen 2012, Eq. 5-7) with its second,
    flow-aligned integration; positive where ink belongs.
    """
    response = blur(lightness, sigma_px * ratio) - blur(lightness, sigma_px)
    return flow_blur(response, tangents, 2.5 * sigma_px)


SECTORS = 8
_REACH, _SIZE = 0.75, 0.35
"""Distance and standard deviation of a sector's disc, in radii of the filter."""


def kuwahara(lab: Picture, tangents: Field, anisotropy: Plane, radius_px: float) -> Picture:
    """Anisotropic generalised Kuwahara filter: flat dabs of colour with crisp borders, drawn out along edges.

    Kyprianidis, Kang & Döllner 2009 with Gaussian sectors: the mean and variance of each of the eight sectors are
    those of a Gaussian disc centred three quarters out, so one blur and one look-up per sector replace the sum
    over its pixels. A sector counts by ``(1 + variance)^-4``: the calmest sides win and borders stay sharp. As
    mean and weight depend on the disc's place alone, they are tabulated before the eight look-ups.
    """
    mean = blur(lab, _SIZE * radius_px)
    variance = blur(dot(lab, lab), _SIZE * radius_px) - dot(mean, mean)
    weight = 1.0 / (1.0 + np.maximum(variance, 0.0))
    weight *= weight
    weight *= weight
    table = cv2.merge([mean * spread(weight, 3), weight])
    along = np.float32(_REACH * radius_px) * (1.0 + anisotropy)
    across = np.float32((_REACH * radius_px) ** 2) / along
    x, y = tangents[..., 0], tangents[..., 1]
    axes = cv2.merge([x * along, y * along]), cv2.merge([-y * across, x * across])
    grid = pixel_grid(*lab.shape[:2])
    total = np.zeros_like(table)
    for sector in range(SECTORS // 2):
        angle = 2.0 * np.pi * sector / SECTORS
        offset = cv2.addWeighted(axes[0], float(np.cos(angle)), axes[1], float(np.sin(angle)), 0.0)
        total += sample(table, grid + offset)
        total += sample(table, grid - offset)
    *sums, weights = cv2.split(total)
    return cv2.merge([cv2.divide(each, weights) for each in sums])


CURVE_STEPS = 4096


def curve_lookup(values: Plane, curve: Float[np.ndarray, " n"], top: float = LAB_RANGE) -> Plane:
    """Values 0..top through a tabulated curve; the table is fine enough that nearest entry is exact to 0.03 L."""
    index = values * np.float32((len(curve) - 1) / top) + np.float32(0.5)
    return curve.take(index.astype(np.int32), mode="clip")


def band_curve(
    levels: list[float], softness: float, remain: float, contrast: tuple[float, float] = (0.0, 1.0)
) -> Float[np.ndarray, " n"]:
    """Tone curve that gathers L into bands.

    Args:
        levels: the L of each band, ascending.
        softness: half-width in L of the step between two bands.
        remain: share 0..1 of the original gradation kept inside the bands.
        contrast: L that stays, and the factor by which others move away from it.
    """
    tone = np.linspace(0.0, LAB_RANGE, CURVE_STEPS, dtype=np.float32)
    stairs = np.full_like(tone, levels[0])
    for low, high in itertools.pairwise(levels):
        middle = 0.5 * (low + high)
        stairs += np.float32(high - low) * smoothstep(middle - softness, middle + softness, tone)
    pivot, gain = contrast
    return np.clip(pivot + gain * (mix(stairs, tone, remain) - pivot), 0.0, LAB_RANGE).astype(np.float32)


def cluster_levels(values: Float[np.ndarray, " n"], count: int) -> list[float]:
    """``count`` ascending levels that represent the values best (Lloyd's algorithm from even quantiles)."""
    ordered = np.sort(values.astype(np.float64))
    levels = np.quantile(ordered, (np.arange(count) + 0.5) / count)
    total = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(30):
        cuts = np.searchsorted(ordered, 0.5 * (levels[1:] + levels[:-1]))
        edges = np.concatenate([[0], cuts, [len(ordered)]])
        sizes = np.diff(edges)
        means = np.diff(total[edges]) / np.maximum(sizes, 1)
        levels = np.where(sizes > 0, means, levels)
    return [float(level) for level in levels]
