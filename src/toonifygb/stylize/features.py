"""Eyes, lips, teeth and cheeks redrawn from landmarks, on top of a shaded face.

All functions edit a picture in place inside the small boxes around the features. Sizes are in face widths
(``unit``); strengths carry ``presence`` so that the features fade out where the face is lost.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from toonifygb.stylize import anchors, filters
from toonifygb.stylize.anchors import CHEEKS, EYES, LIPS, MOUTH, Eye
from toonifygb.stylize.filters import blur, mix, smoothstep

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

    Frame = UInt8[np.ndarray, "h w 3"]
    Picture = Float[np.ndarray, "h w 3"]
    Plane = Float[np.ndarray, "h w"]
    Points = Float[np.ndarray, "n 2"]


def box_around(points: Points, margin_px: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of the picture that hold ``points`` with a margin; empty when they lie outside."""
    low = np.floor(points.min(0) - margin_px).astype(int)
    high = np.ceil(points.max(0) + margin_px).astype(int)
    left, top = np.clip(low, 0, [shape[1], shape[0]])
    right, bottom = np.clip(high, 0, [shape[1], shape[0]])
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def draw_toon_features(painted: Picture, frame: Frame, points: Points, presence: float, unit: float) -> None:
    """Bright eyes, tinted lips, clean teeth and a blush, in Lab.

    Args:
        painted: the shaded picture, CIE Lab; edited.
        frame: the picture it was made from, whose eyes and mouth are still crisp.
        points: landmarks in px of both.
        presence: 0..1.
        unit: width of the face in px.
    """
    for eye in EYES:
        _draw_eye(painted, frame, points, eye, presence, unit)
    _draw_mouth(painted, frame, points, presence, unit)
    _draw_blush(painted, points, presence, unit)


def _local(points: Points, box: tuple[slice, slice]) -> Points:
    return points - np.array([box[1].start, box[0].start], np.float32)


def _draw_eye(painted: Picture, frame: Frame, points: Points, eye: Eye, presence: float, unit: float) -> None:
    lids = points[list(eye.upper + eye.lower)]
    box = box_around(lids, 0.12 * unit, painted.shape)
    if box[0].start >= box[0].stop or box[1].start >= box[1].stop:
        return
    region = painted[box]
    shape = region.shape[:2]
    detail = filters.to_lab(frame[box])
    own = _local(points, box)
    opening = anchors.mask(shape, [anchors.outline_of_eye(own, eye)], 0.006 * unit)
    around = anchors.mask(shape, [anchors.outline_of_eye(own, eye)], 0.03 * unit)
    iris, radius = own[eye.iris], float(np.linalg.norm(own[list(eye.rim)] - own[eye.iris], axis=1).mean())
    grid = filters.pixel_grid(*shape) + np.float32(0.5)
    ring = np.linalg.norm(grid - iris, axis=-1) / max(radius, 1e-3)
    pupil_px = 1.0 / max(radius, 1.0)
    disc = 1.0 - smoothstep(1.0 - pupil_px, 1.0 + pupil_px, ring)
    white = opening * (1.0 - disc) * smoothstep(30.0, 60.0, detail[..., 0])
    detail[..., 0] = mix(detail[..., 0], 93.0, 0.55 * white)
    detail[..., 1:] *= (1.0 - 0.6 * white)[..., None]
    height = (grid[..., 1] - iris[1]) / max(radius, 1e-3)
    inner = disc * opening
    glow = smoothstep(-0.6, 0.9, height)
    detail[..., 0] += inner * (22.0 * glow - 6.0)
    detail[..., 1:] *= (1.0 + 0.5 * inner)[..., None]
    core = (1.0 - smoothstep(0.36, 0.52, ring)) * opening
    detail[..., 0] = mix(detail[..., 0], 7.0, 0.85 * core)
    for dx, dy, size, power in ((-0.34, -0.38, 0.30, 1.0), (0.36, 0.40, 0.16, 0.6)):
        spark = np.linalg.norm(grid - (iris + radius * np.array([dx, dy], np.float32)), axis=-1) / max(radius, 1e-3)
        spark = power * (1.0 - smoothstep(size - 0.5 * pupil_px, size + pupil_px, spark)) * opening
        detail = mix(detail, np.array([99.0, 0.0, 0.0], np.float32), spark)
    painted[box] = mix(region, detail, np.clip(1.6 * around, 0, 1) * np.float32(presence))


def _draw_mouth(painted: Picture, frame: Frame, points: Points, presence: float, unit: float) -> None:
    box = box_around(points[list(LIPS)], 0.08 * unit, painted.shape)
    if box[0].start >= box[0].stop or box[1].start >= box[1].stop:
        return
    region = painted[box]
    own = _local(points, box)
    shape = region.shape[:2]
    whole = anchors.mask(shape, [own[list(LIPS)]], 0.012 * unit)
    inside = anchors.mask(shape, [own[list(MOUTH)]], 0.006 * unit)
    detail = filters.to_lab(frame[box])
    smooth = blur(detail, 0.008 * unit)
    lips = np.clip(whole - inside, 0.0, 1.0)
    tinted = mix(region, smooth, 0.6) * np.array([0.97, 1.1, 1.05], np.float32) + np.array(
        [0.0, 2.5, 0.5], np.float32
    )
    teeth = inside * smoothstep(38.0, 62.0, smooth[..., 0])
    mouth = mix(smooth * np.array([0.9, 1.0, 1.0], np.float32), np.array([93.0, 0.5, 4.0], np.float32), 0.7 * teeth)
    out = mix(region, tinted, 0.85 * lips * np.float32(presence))
    painted[box] = mix(out, mouth, inside * np.float32(presence))


def _draw_blush(painted: Picture, points: Points, presence: float, unit: float) -> None:
    box = box_around(points[list(anchors.OVAL)], 0.0, painted.shape)
    if box[0].start >= box[0].stop or box[1].start >= box[1].stop:
        return
    own = _local(points, box)
    shape = painted[box].shape[:2]
    face = anchors.face_mask(shape, own, 0.03 * unit) * np.float32(presence)
    for cheek in CHEEKS:
        glow = anchors.spot(shape, own[cheek], 0.085 * unit) * face
        painted[box] += glow[..., None] * np.array([0.0, 4.5, 1.5], np.float32)


def draw_lashes(rgb: Picture, points: Points, presence: float, unit: float, ink: np.ndarray) -> None:
    """Upper lid lines: tapered strokes, heaviest over the outer half of the eye; they remain when it closes."""
    for eye in EYES:
        lid = points[list(eye.upper)].astype(np.float64)
        box = box_around(lid, 0.1 * unit, rgb.shape)
        if box[0].start >= box[0].stop or box[1].start >= box[1].stop:
            continue
        stroke = _lash(_local(lid, box), unit)
        plane = np.zeros(rgb[box].shape[:2], np.uint8)
        anchors.fill(plane, stroke)
        amount = plane.astype(np.float32) * np.float32(0.9 * presence / 255)
        rgb[box] = mix(rgb[box], ink, blur(amount, 0.003 * unit))


def _lash(lid: Points, unit: float, steps: int = 48) -> Points:
    """Outline of the stroke along an upper lid given from the outer to the inner corner."""
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lid, axis=0), axis=1))])
    share = np.linspace(0.0, 1.0, steps)
    line = np.stack([np.interp(share * run[-1], run, lid[:, axis]) for axis in (0, 1)], axis=-1)
    kernel = np.hanning(13)[1:-1] / np.hanning(13).sum()  # rounds the corners of the polyline
    padded = np.concatenate([2 * line[0] - line[5:0:-1], line, 2 * line[-1] - line[-2:-7:-1]])
    line = np.stack([np.convolve(padded[:, axis], kernel, "valid") for axis in (0, 1)], axis=-1)
    along = np.gradient(line, axis=0)
    normal = (
        np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    )
    if normal[steps // 2, 1] > 0:  # outwards is up, away from the eye
        normal = -normal
    width = (0.016 * unit * np.sin(np.pi * share**0.7) ** 0.8)[:, None]
    return np.concatenate([line + normal * width, (line - 0.2 * normal * width)[::-1]])
