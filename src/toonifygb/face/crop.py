"""Turned squares of an image: cut out for a network, and the way back for what it says.

Positions follow MediaPipe: the corner of a cut is the corner of its square, and samples are taken at
``corner + index * step`` counted in pixel *centres*, without a half-pixel shift. The networks were trained so;
shifting them moves every landmark by about 0.7 px.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, UInt8
    from torch import Tensor

    from toonifygb.structures import Frame

_SHRINK_FROM = 3.0
"""Bilinear sampling skips pixels above a step of 2; MediaPipe does so too, and up to here we agree with it."""


@dataclass(frozen=True)
class Square:
    """A square region of an image, possibly turned, possibly reaching outside."""

    x: float
    """Centre, px."""
    y: float
    side: float
    """px."""
    angle: float = 0.0
    """Direction of the square's own x axis in the image (y down), rad."""

    def matrix(self, size: int) -> Float[np.ndarray, "2 3"]:
        """Affine map from a ``size`` px cut to the image."""
        x_axis = np.array([np.cos(self.angle), np.sin(self.angle)])
        y_axis = np.array([-x_axis[1], x_axis[0]])
        corner = np.array([self.x, self.y]) - (x_axis + y_axis) * (self.side / 2)
        return np.stack([x_axis * (self.side / size), y_axis * (self.side / size), corner], 1)

    def to_image(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Points given in units of the square (0..1) as image positions, px."""
        matrix = self.matrix(1)
        return points @ matrix[:, :2].T + matrix[:, 2]


def cut(
    frame: Frame, square: Square, size: int, *, border: int = cv2.BORDER_REPLICATE
) -> UInt8[np.ndarray, "s s 3"]:
    """The square resampled to ``size`` px.

    Args:
        frame: the whole image; only the part under the square is read.
        square: what to cut.
        size: side of the result, px.
        border: OpenCV's rule for what lies outside the image.
    """
    matrix = square.matrix(size)
    shrink = int(square.side / size / (_SHRINK_FROM / 2)) if square.side / size > _SHRINK_FROM else 1
    if shrink > 1:
        frame, matrix = _shrunk(frame, matrix, size, shrink)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(frame, matrix, (size, size), flags=flags, borderMode=border)  # type: ignore[return-value]


def _shrunk(
    frame: Frame, matrix: Float[np.ndarray, "2 3"], size: int, factor: int
) -> tuple[Frame, Float[np.ndarray, "2 3"]]:
    """The part of the image under a cut, averaged over blocks of ``factor`` px, and the matrix into it."""
    height, width = frame.shape[:2]
    corners = np.array([[0, 0, 1], [size, 0, 1], [0, size, 1], [size, size, 1]]) @ matrix.T
    low = np.clip(np.floor(corners.min(0)).astype(int) - factor, 0, [width - factor, height - factor])
    high = np.clip(np.ceil(corners.max(0)).astype(int) + factor, low + factor, [width, height])
    counts = (high - low) // factor
    part = frame[low[1] : low[1] + counts[1] * factor, low[0] : low[0] + counts[0] * factor]
    small = cv2.resize(part, (int(counts[0]), int(counts[1])), interpolation=cv2.INTER_AREA)
    inner = matrix / factor
    inner[:, 2] = (matrix[:, 2] - low + 0.5) / factor - 0.5
    return small, inner  # type: ignore[return-value]


def as_batch(images: Sequence[UInt8[np.ndarray, "s s 3"]], device: str) -> Float[Tensor, "n 3 s s"]:
    """Cuts as network input, 0..1."""
    stacked = torch.from_numpy(np.stack(images)).to(device)
    return stacked.permute(0, 3, 1, 2).to(torch.float32).div_(255.0)
