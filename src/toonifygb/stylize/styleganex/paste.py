"""The network's output put back to where it came from, at the size of the source.

Where the output does not reach, the source shows, with its colours made to follow: first through the affine map
that explains the output's colours by the source's best, then by what that map leaves unexplained at the nearest
part of the seam, carried outwards as a smooth field. Over a feathered strip the output fades into it; so neither
colour nor brightness steps at the seam. Everything depends on the one frame alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.stylize.filters import blur, mix, resize, smoothstep, spread

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

    from toonifygb.stylize.styleganex.frame import CropRule

    Image = UInt8[np.ndarray, "h w 3"]
    Picture = Float[np.ndarray, "h w 3"]
    Plane = Float[np.ndarray, "h w"]

FEATHER = 0.5
"""Width of the strip in which output and source mix, in eye distances."""
COARSE = 1 / 8
"""Eye distances per px at which the field of colour differences is computed."""
_REACHES = (1.0, 3.0, 9.0, 27.0, 81.0)
"""Standard deviations of its extrapolation, coarse px; the wider, the less it counts where a narrower one sees."""
_FALLOFF = 1e-3
_RIDGE = 12.0
"""Spread of colours, 8-bit levels, that the colour map needs to see before it believes in more than a shift."""


def paste(output: Image, frame: Image, rule: CropRule) -> Image:
    """The frame with the network's output in place of what the network saw.

    Args:
        output: the whole output, a whole multiple of the rule's shape.
        frame: the source frame.
        rule: how the network's input was cut from it.

    Returns:
        uint8 RGB of the frame's size. The place of the output is exact when all of the frame is covered, and
        within half a source px otherwise.
    """
    rows, columns = rule.place()
    shown = output[rule.covered(output.shape[0] // rule.shape[0])]
    patch = resize(shown, columns.stop - columns.start, rows.stop - rows.start)
    if rule.is_whole:
        return patch
    canvas = frame.astype(np.float32)
    canvas[rows, columns] = patch
    weight = seam_weight(frame.shape[:2], rows, columns, FEATHER * rule.eye_distance)
    return blend_in(canvas, frame, weight, rule.eye_distance)


def blend_in(canvas: Picture, frame: Image, weight: Plane, eye_distance: float) -> Image:
    """A stylised region of a frame blended into the frame, whose colours follow it.

    Args:
        canvas: the stylised picture; only read where ``weight`` is above 0.
        frame: the source.
        weight: 1 inside the region, falling smoothly to 0 at its border.
        eye_distance: of the face, px.
    """
    source = frame.astype(np.float32)
    height, width = weight.shape
    coarse_px = COARSE * eye_distance
    size = max(2, round(width / coarse_px)), max(2, round(height / coarse_px))
    known = (weight > 0).astype(np.float32)
    share, small_canvas, small_source = (
        cv2.resize(each, size, interpolation=cv2.INTER_AREA)
        for each in (known, canvas * spread(known, 3), source * spread(known, 3))
    )
    colors = _color_map(small_source, small_canvas, share)
    unexplained = small_canvas - _mapped(small_source, share, colors)
    field = cv2.resize(_carried_outwards(unexplained, share), (width, height), interpolation=cv2.INTER_LINEAR)
    surroundings = _mapped(source, np.ones_like(weight), colors) + field
    return np.clip(np.rint(mix(surroundings, canvas, weight)), 0, 255).astype(np.uint8)


def _color_map(source: Picture, styled: Picture, share: Plane) -> Float[np.ndarray, "3 4"]:
    """Affine map from the source's colours to the stylised ones, by least squares over what is known.

    A ridge towards plain addition keeps the map tame where the source shows few colours.
    """
    known = cv2.merge([source, share]).reshape(-1, 4).astype(np.float64)
    change = (styled - source).reshape(-1, 3).astype(np.float64)
    ridge = np.diag([_RIDGE**2 * float(share.sum())] * 3 + [1e-6])
    solution = np.linalg.solve(known.T @ known + ridge, known.T @ change).T
    return (solution + np.eye(3, 4)).astype(np.float32)


def _mapped(picture: Picture, share: Plane, colors: Float[np.ndarray, "3 4"]) -> Picture:
    return cv2.transform(cv2.merge([picture, share]), colors)


def seam_weight(shape: tuple[int, int], rows: slice, columns: slice, feather_px: float) -> Plane:
    """1 inside a box, 0 outside, with a smooth ramp along those of its sides that are not the picture's own."""
    down = _ramp(shape[0], rows, feather_px)
    across = _ramp(shape[1], columns, feather_px)
    return down[:, None] * across[None, :]


def _ramp(length: int, inside: slice, feather_px: float) -> Float[np.ndarray, " n"]:
    places = np.arange(length, dtype=np.float32) + 0.5
    weight = ((places > inside.start) & (places < inside.stop)).astype(np.float32)
    if inside.start > 0:
        weight *= smoothstep(0.0, feather_px, places - inside.start)
    if inside.stop < length:
        weight *= smoothstep(0.0, feather_px, inside.stop - places)
    return weight


def _carried_outwards(values: Picture, share: Plane) -> Picture:
    """Smooth field that follows the values where they are known and continues them where they are not.

    Normalised convolution with Gaussians of growing width: the sum of all, each a thousand times lighter than the
    next narrower one, so that the narrowest that still sees known values decides.

    Args:
        values: times ``share``.
        share: how much of each px is known, 0..1.
    """
    total, weights = np.zeros_like(values), np.zeros_like(share)
    for step, reach in enumerate(_REACHES):
        lightness = np.float32(_FALLOFF**step)
        total += lightness * blur(values, reach)
        weights += lightness * blur(share, reach)
    return total / spread(np.maximum(weights, np.float32(1e-20)), 3)
