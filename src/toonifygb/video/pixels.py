"""From a decoded picture to an upright, opaque 8-bit RGB frame with square pixels.

Decoders deliver what was filmed: lying on its side, in luma and chroma of one of several standards, 8 to 16 bits
deep, sometimes with alpha or for HDR screens. Everything behind this door sees sRGB ``uint8 (h, w, 3)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from toonifygb.video import hdr

if TYPE_CHECKING:
    from collections.abc import Callable

    from av import VideoFrame
    from jaxtyping import UInt8

# swscale's own numbers rather than PyAV's enumerations, whose members differ from version to version.
_BT709, _BT601, _HIGH_DEFINITION_FROM = 1, 5, (1280, 577)
_MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9, 10: 9}
"""SWS_CS_* of the colour matrix by the number H.273 gives it in the stream."""
LIMITED_RANGE, FULL_RANGE = 1, 2
"""AVCOL_RANGE_*: luma 16..235 or 0..255."""
BICUBIC, FULL_CHROMA_OUT, FULL_CHROMA_IN, ACCURATE_ROUNDING = 0x4, 0x2000, 0x4000, 0x40000
"""SWS_* flags."""
_READING = BICUBIC | FULL_CHROMA_OUT | ACCURATE_ROUNDING
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
    transfer: hdr.Transfer | None
    """How an HDR clip codes light; ``None`` for standard range."""

    @classmethod
    def of(cls, frame: VideoFrame, pixel_aspect: float, transfer: hdr.Transfer | None) -> PictureFormat:
        """Format of a clip from its first picture; the shorter axis of a non-square pixel is stretched."""
        width = round(frame.width * max(pixel_aspect, 1.0))
        height = round(frame.height / min(pixel_aspect, 1.0))
        return cls(width, height, turn_of(frame), transfer)

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
        has_alpha = any(component.is_alpha for component in frame.format.components)
        if self.transfer is not None:
            note("is filmed for HDR screens; tone-mapped to standard range")
            image = hdr.tone_map(self._convert(frame, "rgb48le"), self.transfer)
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
            dst_color_range=FULL_RANGE,
            interpolation=_READING,
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


def _matrix_of(frame: VideoFrame) -> int:
    """The picture's matrix; where none is named, what players assume: BT.709 above standard definition."""
    width, height = _HIGH_DEFINITION_FROM
    guess = _BT709 if frame.width >= width or frame.height >= height else _BT601
    return _MATRICES.get(int(frame.colorspace), guess)


def _range_of(frame: VideoFrame) -> int:
    full = int(frame.color_range) == FULL_RANGE or frame.format.name.startswith("yuvj") or frame.format.is_rgb
    return FULL_RANGE if full else LIMITED_RANGE
