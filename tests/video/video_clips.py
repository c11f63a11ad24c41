"""Makers of small clips in every shape a user might bring."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

RED, GREEN, BLUE, WHITE = (220, 30, 30), (30, 200, 60), (30, 40, 220), (235, 235, 235)


def quarters(height: int, width: int) -> np.ndarray:
    """Red, green, blue, white in reading order: tells every rotation and mirroring apart."""
    image = np.empty((height, width, 3), np.uint8)
    y, x = height // 2, width // 2
    image[:y, :x], image[:y, x:], image[y:, :x], image[y:, x:] = RED, GREEN, BLUE, WHITE
    return image


def corners(image: np.ndarray) -> tuple[str, ...]:
    """Names of the colours in the four quarters, reading order."""
    height, width = image.shape[:2]
    names = {"red": RED, "green": GREEN, "blue": BLUE, "white": WHITE}
    found = []
    for y in (height // 4, 3 * height // 4):
        for x in (width // 4, 3 * width // 4):
            colour = image[y, x].astype(int)
            found.append(min(names, key=lambda name: np.abs(colour - names[name]).sum()))
    return tuple(found)


def moving(index: int, height: int = 48, width: int = 64) -> np.ndarray:
    """Textured frames that differ from one to the next, so that none can be dropped unnoticed."""
    y, x = np.mgrid[:height, :width]
    pattern = np.stack((x * 3 + index * 5, y * 4 + index * 3, (x + y) * 2 + index * 7), -1)
    return (127.5 + 100 * np.sin(pattern / 20)).astype(np.uint8)


def write_clip(
    path: Path,
    images: list[np.ndarray],
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    rate: int = 25,
    options: dict[str, str] | None = None,
    container: dict[str, str] | None = None,
    times_ms: list[int] | None = None,
    setup: Callable[[Any], None] | None = None,
    source_format: str = "rgb24",
) -> Path:
    """A clip written with PyAV directly, not with the writer under test."""
    with av.open(str(path), "w", options=container or {}) as output:
        stream = output.add_stream(codec, rate=rate, options=options or {})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pix_fmt
        if setup is not None:
            setup(stream)
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format=source_format)
            if times_ms is not None:
                frame.pts, frame.time_base = times_ms[index], Fraction(1, 1000)
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return path
