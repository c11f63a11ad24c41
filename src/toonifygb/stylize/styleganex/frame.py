"""Which part of a frame the network sees, and where its output belongs.

One rule holds for a whole clip. The frame is scaled until its face has the eye distance the network was trained
at, and a box of it, whose sides are multiples of 8, goes through the network. ``published_rule`` is the original
procedure; ``crop_rule`` and ``full_rule`` are ours: they use the true eye distance, so that a tilted head changes
nothing, and fill the box up to a multiple of 8 by mirroring instead of cutting the frame down to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from toonifygb.errors import FaceError
from toonifygb.stylize.filters import resize

if TYPE_CHECKING:
    from jaxtyping import UInt8

    from toonifygb.stylize.styleganex.align import FaceMarks

    Image = UInt8[np.ndarray, "h w 3"]

EYE_DISTANCE_PX = 64
"""Distance of the eyes in an FFHQ face of 256 px, the scale of the network's input."""
REACH_PX = 256
"""How far a crop reaches from the middle between the eyes, in px of the network's input."""
STEP = 8
"""The network's input has sides of multiples of this."""


@dataclass(frozen=True)
class CropRule:
    """Scale and box that turn every frame of a clip into an input of the network.

    ``top`` to ``right`` are px of the scaled frame; ``bottom`` and ``right`` may lie beyond it by less than
    ``STEP``, where it is continued by its mirror image.
    """

    frame: tuple[int, int]
    """Height and width of the source frames, px."""
    scale: float
    """Scaled px per source px."""
    size: tuple[int, int]
    """Height and width of the scaled frame, px."""
    top: int
    bottom: int
    left: int
    right: int
    antialias: bool = True
    """Whether scaling down averages, as it should; the published procedure interpolates and lets fine detail
    flicker."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the network's input, px."""
        return self.bottom - self.top, self.right - self.left

    @property
    def eye_distance(self) -> float:
        """Distance of the eyes in the source frames, px."""
        return EYE_DISTANCE_PX / self.scale

    @property
    def is_whole(self) -> bool:
        """Whether nothing of the frame is left out."""
        height, width = self.size
        return self.top == self.left == 0 and self.bottom >= height and self.right >= width

    def scaled(self, frame: Image) -> Image:
        """The whole frame at the network's scale."""
        height, width = self.size
        if self.antialias:
            return resize(frame, width, height)
        return cv2.resize(frame, (width, height), interpolation=cv2.INTER_LINEAR)

    def cut(self, frame: Image) -> Image:
        """The network's input from a frame, as bytes."""
        height, width = self.size
        box = self.scaled(frame)[self.top : self.bottom, self.left : self.right]
        below, beside = max(self.bottom - height, 0), max(self.right - width, 0)
        if below or beside:
            box = cv2.copyMakeBorder(box, 0, below, 0, beside, cv2.BORDER_REFLECT)
        return np.ascontiguousarray(box)

    def to_state(self) -> dict[str, Any]:
        """The rule as plain numbers."""
        box = [self.top, self.bottom, self.left, self.right]
        return {
            "frame": list(self.frame),
            "scale": self.scale,
            "size": list(self.size),
            "box": box,
            "antialias": self.antialias,
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> CropRule:
        """The rule that ``to_state`` wrote down."""
        frame, size = tuple(state["frame"]), tuple(state["size"])
        return cls(frame, state["scale"], size, *state["box"], antialias=state["antialias"])

    def covered(self, magnification: int = 1) -> tuple[slice, slice]:
        """Rows and columns of the network's output that show the frame rather than its mirrored continuation."""
        height, width = self.size
        rows = min(self.bottom, height) - self.top
        columns = min(self.right, width) - self.left
        return slice(0, rows * magnification), slice(0, columns * magnification)

    def place(self) -> tuple[slice, slice]:
        """Rows and columns of the source frame that the output belongs to, to the nearest source px."""
        rows = _span(self.top, min(self.bottom, self.size[0]), self.size[0], self.frame[0])
        columns = _span(self.left, min(self.right, self.size[1]), self.size[1], self.frame[1])
        return rows, columns


def published_rule(marks: FaceMarks, height: int, width: int) -> CropRule:
    """The rule of the published video procedure, exactly.

    Args:
        marks: the face in the first frame.
        height: of the frames, px.
        width: of the frames, px.

    Raises:
        FaceError: the eyes are not side by side, for which the procedure gives no usable scale.
    """
    across = float(marks.eye_right[0] - marks.eye_left[0])
    if across <= 0:
        raise FaceError(
            "the face in the reference frame lies on its side; the published scale needs the eyes side by side",
            "use styleganex.framing=crop, which measures the distance of the eyes in any direction",
        )
    scale = EYE_DISTANCE_PX / across
    x, y = marks.eye_middle * scale
    size = round(height * scale), round(width * scale)
    top, bottom = max(round(y - REACH_PX), 0), min(round(y + REACH_PX), size[0])
    left, right = max(round(x - REACH_PX), 0), min(round(x + REACH_PX), size[1])
    box = (side // STEP * STEP for side in (top, bottom, left, right))
    return CropRule((height, width), scale, size, *box, antialias=False)


def full_rule(eye_distance: float, height: int, width: int) -> CropRule:
    """The rule that stylises the whole frame.

    Args:
        eye_distance: true distance of the eyes in a frontal frame, px.
        height: of the frames, px.
        width: of the frames, px.
    """
    scale, size = _scaled_size(eye_distance, height, width)
    return CropRule((height, width), scale, size, 0, _up(size[0]), 0, _up(size[1]))


def crop_rule(eye_distance: float, middle: tuple[float, float], height: int, width: int) -> CropRule:
    """The rule that stylises the surroundings of the face, at most ``2 * REACH_PX`` to a side.

    Args:
        eye_distance: true distance of the eyes in a frontal frame, px.
        middle: (x, y) of the point midway between the eyes in most frames, array indices.
        height: of the frames, px.
        width: of the frames, px.
    """
    scale, size = _scaled_size(eye_distance, height, width)
    top, bottom = _around(middle[1] * scale, size[0])
    left, right = _around(middle[0] * scale, size[1])
    return CropRule((height, width), scale, size, top, bottom, left, right)


def _scaled_size(eye_distance: float, height: int, width: int) -> tuple[float, tuple[int, int]]:
    scale = EYE_DISTANCE_PX / eye_distance
    return scale, (max(round(height * scale), STEP), max(round(width * scale), STEP))


def _around(middle: float, length: int) -> tuple[int, int]:
    """Box of multiples of ``STEP`` about the middle; where the frame ends within reach, so does the box."""
    first = max(round(middle - REACH_PX), 0) // STEP * STEP
    return first, min(first + 2 * REACH_PX, _up(length))


def _up(length: int) -> int:
    return -(-length // STEP) * STEP


def _span(first: int, last: int, scaled: int, source: int) -> slice:
    """The source px between two positions of the scaled frame."""
    return slice(round(first * source / scaled), round(last * source / scaled))
