"""Sensor and compression noise calmed in time, from a symmetric window of source frames.

Noise is what makes bands and lines boil. Each frame is averaged with its neighbours after these are moved onto it
by optical flow, where they agree with it. A frame depends on its neighbours in the source alone, so the result is
the same however a clip is cut into chunks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.stylize.filters import blur, pixel_grid, resize, sample, spread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, UInt8

    Frame = UInt8[np.ndarray, "h w 3"]
    Field = Float[np.ndarray, "h w 2"]

RADIUS = 1
"""Frames looked at on either side; a second one brings a quarter of the gain of the first, for the same cost."""
NOISE = 7.0
"""Difference in 8-bit levels, averaged over a few px, at which a neighbour stops being the same surface."""
TRUST = np.exp(-((np.arange(256, dtype=np.float32) * np.float32(1.0 / NOISE)) ** 2))
"""Weight of a neighbour for every such difference."""
LONGEST_SIDE = 720
"""Larger frames are calmed at this size and corrected by the enlarged difference: their finest noise is removed by
the styles' own smoothing, and the cost stays bounded."""
SMALLEST_FLOW_SIDE = 24
"""Below this side in px the flow has no pyramid to work on, and neighbours are compared unmoved."""


def motion(source: UInt8[np.ndarray, "h w"], target: UInt8[np.ndarray, "h w"]) -> Field:
    """Displacement in px from each pixel of ``source`` to its place in ``target`` (DIS optical flow)."""
    if min(source.shape) < SMALLEST_FLOW_SIDE:
        return np.zeros((*source.shape, 2), np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    flow.setUseSpatialPropagation(False)  # propagation runs in stripes, one per thread: results would follow it
    return flow.calc(source, target, None)  # type: ignore[call-overload]


def calmed(window: Sequence[Frame], index: int) -> Frame:
    """Frame ``index`` of ``window`` averaged with those of its neighbours that show the same."""
    frame = window[index]
    height, width = frame.shape[:2]
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = [resize(each, *size) for each in window]
    change = cv2.subtract(_average(small, index), small[index], dtype=cv2.CV_32F)
    return cv2.add(frame, resize(change, width, height), dtype=cv2.CV_8U)  # rounds to nearest


def _average(window: Sequence[Frame], index: int) -> Float[np.ndarray, "h w 3"]:
    """Weighted mean of the motion-compensated window."""
    centre = window[index].astype(np.float32)
    height, width = centre.shape[:2]
    half = [_half_grey(each) for each in window]
    total, weights = centre.copy(), np.ones((height, width), np.float32)
    for other, neighbour in enumerate(window):
        if other == index:
            continue
        flow = motion(half[index], half[other]) * _enlargement(half[index], width, height)
        moved = sample(neighbour, pixel_grid(height, width) + resize(flow, width, height))
        difference = blur(cv2.cvtColor(cv2.absdiff(moved, window[index]), cv2.COLOR_RGB2GRAY), 2.0)
        weight = cv2.LUT(difference, TRUST * np.float32(1.0 / (1.0 + 0.25 * abs(other - index))))
        total += spread(weight, 3) * moved
        weights += weight
    return total / spread(weights, 3)


def _enlargement(half: UInt8[np.ndarray, "h w"], width: int, height: int) -> Float[np.ndarray, " 2"]:
    """Full-size px per px of the half-size picture, along x and y."""
    return np.array([width / half.shape[1], height / half.shape[0]], np.float32)


def _half_grey(frame: Frame) -> UInt8[np.ndarray, "h w"]:
    """Luma at half size: enough for motion, and a quarter of the work."""
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    return resize(grey, max(1, (frame.shape[1] + 1) // 2), max(1, (frame.shape[0] + 1) // 2))
