"""Eyes, lips, teeth and cheeks redrawn from landmarks, on top of a shaded face.

All functions edit a picture in place inside the small boxes around the features. Sizes are in face widths
(``unit``); strengths carry ``presence`` so that the features fade out where the face is lost.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.stylize import anchors, filters
from toonifygb.stylize.anchors import CHEEKS, EYES, LIPS, MOUTH, Eye, box_around, in_box, is_empty
from toonifygb.stylize.filters import blur, mix, smoothstep

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

    Frame = UInt8[np.ndarray, "h w 3"]
    Picture = Float[np.ndarray, "h w 3"]
    Plane = Float[np.ndarray, "h w"]
    Points = Float[np.ndarray, "n 2"]


CATCH_LIGHTS = ((-0.34, -0.38, 0.30, 1.0), (0.36, 0.40, 0.16, 0.6))
"""Reflections in the iris: right, down and size in radii of the iris, and brightness."""


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
        _draw_brow(painted, frame, points, eye, presence, unit)
    _draw_mouth(painted, frame, points, presence, unit)
    _draw_blush(painted, points, presence, unit)


def _draw_eye(painted: Picture, frame: Frame, points: Points, eye: Eye, presence: float, unit: float) -> None:
    lids = points[list(eye.upper + eye.lower)]
    box = box_around(lids, 0.12 * unit, painted.shape)
    if is_empty(box):
        return
    shape = painted[box].shape[:2]
    outline = anchors.outline_of_eye(in_box(points, box), eye)
    opening = anchors.mask(shape, [outline], 0.006 * unit) * np.float32(_openness(points, eye))
    around = np.clip(1.6 * anchors.mask(shape, [outline], 0.03 * unit), 0.0, 1.0) * np.float32(presence)
    detail = _bright_eye(filters.to_lab(frame[box]), in_box(points, box), eye, opening)
    painted[box] = mix(painted[box], detail, around)


def _openness(points: Points, eye: Eye) -> float:
    """0 for a closed eye .. 1 for one open enough to show white and iris."""
    middle = len(eye.upper) // 2
    height = float(np.linalg.norm(points[eye.upper[middle]] - points[eye.lower[middle]]))
    width = float(np.linalg.norm(points[eye.upper[0]] - points[eye.upper[-1]]))
    share = np.clip((height / max(width, 1e-6) - 0.08) / 0.10, 0.0, 1.0)
    return float(share * share * (3.0 - 2.0 * share))


def _bright_eye(detail: Picture, points: Points, eye: Eye, opening: Plane) -> Picture:
    """An eye with clean white, an iris lit from below, a deep pupil and two catch-lights; Lab in, Lab out."""
    iris = points[eye.iris]
    radius = max(float(np.linalg.norm(points[list(eye.rim)] - iris, axis=1).mean()), 1e-3)
    grid = filters.pixel_grid(*opening.shape) + np.float32(0.5)
    soft = 1.0 / max(radius, 1.0)  # one px, in radii of the iris

    def ring(dx: float, dy: float) -> Plane:
        """Distance from a point of the iris, in its radii."""
        return np.hypot(grid[..., 0] - (iris[0] + dx * radius), grid[..., 1] - (iris[1] + dy * radius)) / radius

    disc = 1.0 - smoothstep(1.0 - soft, 1.0 + soft, ring(0.0, 0.0))
    white = opening * (1.0 - disc) * smoothstep(30.0, 60.0, detail[..., 0])
    dark = 1.0 - smoothstep(40.0, 62.0, detail[..., 0])  # where the landmarks miss the iris, its white stays white
    inner = disc * opening * dark
    core = opening * dark * (1.0 - smoothstep(0.36, 0.52, ring(0.0, 0.0)))
    below = smoothstep(-0.6, 0.9, (grid[..., 1] - iris[1]) / radius)
    tone = mix(detail[..., 0], 93.0, 0.55 * white) + inner * (22.0 * below - 6.0)
    chroma = (1.0 - 0.6 * white) * (1.0 + 0.5 * inner)
    out = cv2.merge([mix(tone, 7.0, 0.85 * core), detail[..., 1] * chroma, detail[..., 2] * chroma])
    for dx, dy, size, power in CATCH_LIGHTS:
        spark = 1.0 - smoothstep(size - 0.5 * soft, size + soft, ring(dx, dy))
        out = filters.tint(out, np.array([99.0, 0.0, 0.0], np.float32), power * spark * opening)
    return out


def _draw_brow(painted: Picture, frame: Frame, points: Points, eye: Eye, presence: float, unit: float) -> None:
    """Brows as one dark shape each: what is darker than the skin there, deepened."""
    brow = points[list(eye.brow)]
    box = box_around(brow, 0.06 * unit, painted.shape)
    if is_empty(box):
        return
    region = painted[box]
    hair = blur(filters.to_lab(frame[box]), 0.009 * unit)
    where = np.minimum(1.5 * anchors.mask(region.shape[:2], [in_box(brow, box)], 0.022 * unit), 1.0)
    # the brighter half of the region is skin between the hairs, which keeps its shading
    darker = smoothstep(2.0, 14.0, float(np.quantile(hair[..., 0], 0.8)) - hair[..., 0])
    deep = hair * np.array([0.72, 1.0, 1.0], np.float32)
    painted[box] = mix(region, deep, where * darker * np.float32(0.9 * presence))


def _draw_mouth(painted: Picture, frame: Frame, points: Points, presence: float, unit: float) -> None:
    box = box_around(points[list(LIPS)], 0.08 * unit, painted.shape)
    if is_empty(box):
        return
    region = painted[box]
    own = in_box(points, box)
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
    if is_empty(box):
        return
    own = in_box(points, box)
    shape = painted[box].shape[:2]
    face = anchors.face_mask(shape, own, 0.03 * unit) * np.float32(presence)
    for cheek in CHEEKS:
        glow = anchors.spot(shape, own[cheek], 0.085 * unit) * face
        painted[box] += cv2.merge([np.zeros_like(glow), 4.0 * glow, 1.5 * glow])


def draw_lashes(rgb: Picture, points: Points, presence: float, unit: float, ink: np.ndarray) -> None:
    """Upper lid lines: tapered strokes, heaviest over the outer half of the eye; they remain when it closes."""
    for eye in EYES:
        lid = points[list(eye.upper)].astype(np.float64)
        box = box_around(lid, 0.1 * unit, rgb.shape)
        if is_empty(box):
            continue
        stroke = _lash(in_box(lid, box), unit)
        plane = np.zeros(rgb[box].shape[:2], np.uint8)
        anchors.draw(plane, stroke)
        amount = plane.astype(np.float32) * np.float32(0.9 * presence / 255)
        rgb[box] = filters.tint(rgb[box], ink, blur(amount, 0.003 * unit))


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
