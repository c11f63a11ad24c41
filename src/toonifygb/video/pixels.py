"""From a decoded picture to an upright, opaque 8-bit RGB frame with square pixels.

Decoders deliver what was filmed: lying on its side, in luma and chroma of one of several standards, 8 to 16 bits
deep, sometimes with alpha or for HDR screens. Everything behind this door sees sRGB ``uint8 (h, w, 3)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation

from toonifygb.video import hdr

if TYPE_CHECKING:
    from collections.abc import Callable

    from av import VideoFrame
    from jaxtyping import UInt8

_MATRICES = {
    1: Colorspace.ITU709,
    4: Colorspace.FCC,
    5: Colorspace.ITU601,
    6: Colorspace.ITU601,
    7: Colorspace.SMPTE240M,
    9: Colorspace.BT2020,
    10: Colorspace.BT2020,
}
"""Colour matrix by the number H.273 gives it in the stream."""
_FULL_RANGE = 2
_QUALITY = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
"""Without the last two swscale rounds every colour down by up to 3 levels and doubles chroma columns."""


class Turn(NamedTuple):
    """How a stored picture becomes upright: transposed first, then mirrored."""

    transpose: bool = False
    mirror_x: bool = False
    mirror_y: bool = False

    def apply(self, image: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h2 w2 c"]:
        """The upright image, contiguous."""
        if self.transpose:
            image = image.swapaxes(0, 1)
        if self.mirror_x:
            image = image[:, ::-1]
        if self.mirror_y:
            image = image[::-1]
        return np.ascontiguousarray(image)


def turn_of(frame: VideoFrame) -> Turn:
    """Turn asked for by the picture's display matrix, to the nearest quarter.

    The matrix is a, b, u, c, d, v, x, y, w in 16.16 fixed point and sends (x, y) to (a x + c y, b x + d y).
    """
    side_data = frame.side_data.get("DISPLAYMATRIX")
    if side_data is None:
        return Turn()
    a, b, _, c, d = np.frombuffer(bytes(side_data), "<i4")[:5].tolist()
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return Turn(False, a < 0, d < 0)
    return Turn(True, c < 0, b < 0)


@dataclass(frozen=True)
class PictureFormat:
    """What every frame of a clip has in common."""

    width: int
    """Stored size with square pixels, before the turn, px."""
    height: int
    turn: Turn

    @classmethod
    def of(cls, frame: VideoFrame, pixel_aspect: float) -> PictureFormat:
        """Format of a clip from its first picture; the shorter axis of a non-square pixel is stretched."""
        width = round(frame.width * max(pixel_aspect, 1.0))
        height = round(frame.height / min(pixel_aspect, 1.0))
        return cls(width, height, turn_of(frame))

    @property
    def upright_size(self) -> tuple[int, int]:
        """Width and height after the turn, px."""
        return (self.height, self.width) if self.turn.transpose else (self.width, self.height)

    def to_rgb(self, frame: VideoFrame, note: Callable[[str], None]) -> UInt8[np.ndarray, "h w 3"]:
        """The upright RGB frame.

        Args:
            frame: decoded picture of any pixel format and size.
            note: receives a sentence for whatever could not be kept; the same one each time.
        """
        transfer = hdr.transfer_of(frame)
        has_alpha = any(component.is_alpha for component in frame.format.components)
        if transfer is not None:
            note("is filmed for HDR screens; tone-mapped to standard range")
            image = hdr.tone_map(self._convert(frame, "rgb48le"), transfer)
        elif has_alpha:
            image, was_opaque = flatten_alpha(self._convert(frame, "rgba"))
            if not was_opaque:
                note("is partly transparent; shown on black")
        else:
            image = self._convert(frame, "rgb24")
        return self.turn.apply(image)

    def _convert(self, frame: VideoFrame, pixel_format: str) -> np.ndarray:
        converted = frame.reformat(
            width=self.width,
            height=self.height,
            format=pixel_format,
            src_colorspace=_matrix_of(frame),
            src_color_range=_range_of(frame),
            dst_color_range=ColorRange.JPEG,
            interpolation=_QUALITY,
        )
        image = converted.to_ndarray()
        # A picture that needed no conversion still belongs to the decoder, which may predict the next one from it.
        return image.copy() if converted is frame else image


def flatten_alpha(image: UInt8[np.ndarray, "h w 4"]) -> tuple[UInt8[np.ndarray, "h w 3"], bool]:
    """RGBA with straight alpha shown on black, and whether it was opaque everywhere."""
    alpha = image[..., 3:]
    if (alpha == 255).all():
        return np.ascontiguousarray(image[..., :3]), True
    # Rounded division by 255 in integers.
    return ((image[..., :3].astype(np.uint16) * alpha + 127) // 255).astype(np.uint8), False


def _matrix_of(frame: VideoFrame) -> Colorspace:
    """The picture's matrix; where none is named, what players assume: BT.709 above standard definition."""
    high_definition = frame.width >= 1280 or frame.height > 576
    return _MATRICES.get(int(frame.colorspace), Colorspace.ITU709 if high_definition else Colorspace.ITU601)


def _range_of(frame: VideoFrame) -> ColorRange:
    full = int(frame.color_range) == _FULL_RANGE or frame.format.name.startswith("yuvj") or frame.format.is_rgb
    return ColorRange.JPEG if full else ColorRange.MPEG
