"""Pictures made of pictures: rows with labels, for the preview video and the report."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

LABEL_HEIGHT = 26
"""Height of the strip above a labelled row, px."""
_LABEL_COLOR = (235, 235, 235)
_BACKGROUND = 16


def fit(image: np.ndarray, size: int) -> np.ndarray:
    """A square image at another size; area averaging downwards, cubic upwards."""
    if image.shape[:2] == (size, size):
        return image
    method = cv2.INTER_AREA if image.shape[0] > size else cv2.INTER_CUBIC
    return cv2.resize(image, (size, size), interpolation=method)


def cut(image: np.ndarray, square: tuple[int, int, int]) -> np.ndarray:
    """A square (left, top, side, px) of an image; what lies outside is black."""
    left, top, side = square
    height, width = image.shape[:2]
    x, y = side + min(max(left, -side), width), side + min(max(top, -side), height)
    padded = np.pad(image, ((side, side), (side, side), (0, 0)))
    return np.ascontiguousarray(padded[y : y + side, x : x + side])


def row(images: Sequence[np.ndarray], labels: Sequence[str] = (), size: int | None = None) -> np.ndarray:
    """Square images side by side, each under its label.

    Args:
        images: uint8 RGB.
        labels: one per image, or none.
        size: side of each, px; that of the first when unset.
    """
    side = size or images[0].shape[0]
    strip = np.concatenate([fit(image, side) for image in images], axis=1)
    if not labels:
        return strip
    bar = np.full((LABEL_HEIGHT, strip.shape[1], 3), _BACKGROUND, np.uint8)
    for index, label in enumerate(labels):
        origin = (index * side + 8, LABEL_HEIGHT - 8)
        cv2.putText(bar, label, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _LABEL_COLOR, 1, cv2.LINE_AA)
    return np.concatenate([bar, strip], axis=0)


def stack(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Rows under each other; narrower ones are padded on the right."""
    width = max(strip.shape[1] for strip in rows)
    padded = [
        np.pad(strip, ((0, 0), (0, width - strip.shape[1]), (0, 0)), constant_values=_BACKGROUND) for strip in rows
    ]
    return np.concatenate(padded, axis=0)


def error_map(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Mean absolute difference as a colour map; a quarter of the full range is the brightest."""
    difference = np.abs(image.astype(np.int16) - target).mean(axis=2)
    heat = cv2.applyColorMap(np.clip(difference * 4, 0, 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    return np.ascontiguousarray(heat[..., ::-1])
