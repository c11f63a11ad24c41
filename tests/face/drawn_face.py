"""A face drawn with ellipses and shading, plain enough to be committed and good enough for the networks."""

from __future__ import annotations

import cv2
import numpy as np

SKIN, LIP, DARK = (224, 172, 140), (180, 82, 80), (52, 36, 30)


def draw_face(side: int = 256) -> np.ndarray:
    """uint8 RGB square on a grey ground, the head about 0.55 sides wide and shaded from the upper left."""
    s = 4 * side
    image = np.full((s, s, 3), (150, 160, 165), np.uint8)

    def ellipse(x: float, y: float, rx: float, ry: float, color: tuple[int, int, int], start=0, end=360, width=-1):
        thickness = width if width < 0 else max(1, int(width * s / 256))
        axes = (int(rx * s), int(ry * s))
        cv2.ellipse(image, (int(x * s), int(y * s)), axes, 0, start, end, color, thickness, cv2.LINE_AA)

    shade = tuple(int(c * 0.82) for c in SKIN)
    ellipse(0.5, 0.40, 0.30, 0.34, DARK)  # hair
    ellipse(0.5, 0.90, 0.13, 0.22, shade)  # neck
    ellipse(0.5, 0.48, 0.265, 0.36, SKIN)
    ellipse(0.5, 0.14, 0.25, 0.09, DARK)  # fringe
    for sign in (-1, 1):
        x = 0.5 + sign * 0.115
        ellipse(x, 0.425, 0.062, 0.036, shade)
        ellipse(x, 0.43, 0.048, 0.022, (245, 245, 245))
        ellipse(x, 0.43, 0.021, 0.021, (80, 60, 45))
        ellipse(x, 0.43, 0.010, 0.010, (10, 10, 10))
        ellipse(x, 0.438, 0.052, 0.030, DARK, 190, 350, 2)
        ellipse(x, 0.385, 0.070, 0.030, DARK, 200, 340, 5)
        ellipse(0.5 + sign * 0.032, 0.575, 0.014, 0.008, (120, 70, 60))
        ellipse(0.5 + sign * 0.27, 0.47, 0.03, 0.06, shade)
    ellipse(0.5, 0.555, 0.045, 0.028, shade)
    ellipse(0.5, 0.50, 0.022, 0.07, tuple(min(255, int(c * 1.06)) for c in SKIN))
    ellipse(0.5, 0.675, 0.085, 0.028, LIP)
    ellipse(0.5, 0.670, 0.080, 0.008, (120, 45, 45))
    ellipse(0.5, 0.735, 0.05, 0.012, shade)
    image = cv2.GaussianBlur(image, (0, 0), s / 220)
    y, x = np.mgrid[:s, :s] / s
    light = 1.08 - 0.55 * ((x - 0.42) ** 2 + (y - 0.40) ** 2)
    lit = np.clip(image * light[..., None], 0, 255).astype(np.uint8)
    return cv2.resize(lit, (side, side), interpolation=cv2.INTER_AREA)
