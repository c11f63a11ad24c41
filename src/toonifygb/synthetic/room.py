"""The room behind the subject: a wall, a window, shelves, a plant and a lamp, all out of focus."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.synthetic.noise import fractal_noise

if TYPE_CHECKING:
    from jaxtyping import Float32

    from toonifygb.synthetic.look import Look, Rgb

BOOKS: tuple[Rgb, ...] = (
    (150, 72, 60),
    (62, 92, 110),
    (196, 164, 104),
    (88, 104, 82),
    (222, 214, 198),
    (74, 62, 84),
)
BLUR = 0.016
"""Standard deviation of the defocus in image heights."""


def paint_room(look: Look, width: int, height: int, seed: int) -> Float32[np.ndarray, "h w 3"]:
    """Picture of the room, sRGB 0..1; the same picture at every size."""
    rng = np.random.Generator(np.random.Philox(seed + 3000))
    canvas = _wall(look, width, height, seed)
    mirrored = bool(rng.integers(2))
    _shelf(canvas, rng)
    near = cv2.GaussianBlur(canvas, (0, 0), BLUR * height)
    _plant(near, rng)
    near = cv2.GaussianBlur(near, (0, 0), 0.7 * BLUR * height)
    _window(near)
    _lamp(near)
    picture = cv2.GaussianBlur(near, (0, 0), 0.8 * BLUR * height)
    if mirrored:
        picture = picture[:, ::-1]
    rows, columns = _grid(width, height)
    vignette = 1 - 0.22 * ((columns - 0.5) ** 2 + (rows - 0.45) ** 2)
    return np.clip(picture * vignette[..., None], 0, 1).astype(np.float32)


def _grid(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of each pixel centre, 0..1."""
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32) + 0.5
    return rows / height, columns / width


def _wall(look: Look, width: int, height: int, seed: int) -> Float32[np.ndarray, "h w 3"]:
    """Plaster, brighter towards the window on the left, darker towards the floor."""
    rows, columns = _grid(width, height)
    cloud = fractal_noise(np.stack([columns, rows, 0 * rows], -1).reshape(-1, 3), 3, seed).reshape(height, width)
    light = 1.04 - 0.30 * columns - 0.16 * rows + 0.035 * cloud
    warm = np.stack([1 + 0.04 * columns, np.ones_like(rows), 1 - 0.06 * columns], -1)
    return (np.array(look.wall, np.float32) / 255 * light[..., None] * warm).astype(np.float32)


def _box(
    canvas: np.ndarray, left: float, top: float, right: float, bottom: float, color: tuple[float, float, float]
) -> None:
    """Fills a rectangle given in image widths and heights."""
    height, width = canvas.shape[:2]
    corner = (round(left * width), round(top * height))
    cv2.rectangle(canvas, corner, (round(right * width), round(bottom * height)), color, cv2.FILLED)


def _window(canvas: np.ndarray) -> None:
    """Daylight through two panes at the left edge."""
    _box(canvas, -0.1, 0.02, 0.165, 0.60, (0.86, 0.84, 0.80))
    for top, bottom in ((0.05, 0.29), (0.32, 0.56)):
        _box(canvas, -0.1, top, 0.135, bottom, (0.93, 0.97, 1.0))
    _box(canvas, -0.1, 0.60, 0.19, 0.635, (0.80, 0.77, 0.72))


def _shelf(canvas: np.ndarray, rng: np.random.Generator) -> None:
    """Two boards with books at the right edge."""
    for base in (0.30, 0.56):
        left = 0.79
        while left < 1.0:
            thickness = float(rng.uniform(0.018, 0.034))
            tall = float(rng.uniform(0.11, 0.17))
            color = np.array(BOOKS[int(rng.integers(len(BOOKS)))]) / 255 * rng.uniform(0.8, 1.05)
            if rng.random() > 0.12:
                _box(
                    canvas,
                    left,
                    base - tall,
                    left + thickness,
                    base,
                    (float(color[0]), float(color[1]), float(color[2])),
                )
            left += thickness + 0.003
        _box(canvas, 0.77, base, 1.1, base + 0.022, (0.42, 0.31, 0.22))


def _plant(canvas: np.ndarray, rng: np.random.Generator) -> None:
    """Broad leaves rising from the lower left."""
    height, width = canvas.shape[:2]
    foot = np.array((0.085, 0.98))
    for _ in range(16):
        lean, reach = rng.uniform(-0.75, 0.75), rng.uniform(0.16, 0.36)
        tip = foot + reach * np.array((np.sin(lean), -np.cos(lean)))
        side = np.array((np.cos(lean), np.sin(lean))) * rng.uniform(0.018, 0.034)
        middle = 0.45 * foot + 0.55 * tip
        outline = np.stack([foot, middle - side, tip, middle + side]) * (width, height)
        shade = float(rng.uniform(0.65, 1.15))
        cv2.fillConvexPoly(canvas, outline.round().astype(np.int32), (0.24 * shade, 0.36 * shade, 0.21 * shade))


def _lamp(canvas: np.ndarray) -> None:
    """A warm glow on the shelf."""
    height, width = canvas.shape[:2]
    rows, columns = _grid(width, height)
    distance = (columns - 0.93) ** 2 + (rows - 0.70) ** 2
    glow = 0.30 * np.exp(-distance / 0.03) + 0.55 * np.exp(-distance / 0.0022)
    canvas += glow[..., None].astype(np.float32) * np.array((1.0, 0.80, 0.52), np.float32)
