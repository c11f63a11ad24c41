"""Pictures for HDR screens (PQ and HLG, BT.2020) brought to sRGB.

Light is measured in units of 203 cd/m², the level BT.2408 gives to diffuse white, so ordinary scenes keep their
brightness and only highlights above it are compressed.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from av.video.stream import VideoStream
    from jaxtyping import Float, UInt8, UInt16

Transfer = Literal["pq", "hlg"]
_TRANSFERS: dict[int, Transfer] = {16: "pq", 18: "hlg"}
"""By H.273's number of the transfer characteristic."""
_WHITE = 203.0
_HLG_PEAK = 1000.0
"""cd/m² of the screen HLG is meant for when nothing else is known (BT.2100)."""
_LUMA = np.array([0.2627, 0.6780, 0.0593], np.float32)
"""Luminance of BT.2020's primaries."""
_TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
"""Linear BT.2020 to linear BT.709 (BT.2087)."""
_KNEE = 0.7
"""Light below this share of diffuse white passes unchanged; above, it approaches 1."""


def transfer_of(stream: VideoStream) -> Transfer | None:
    """The HDR transfer of a stream; ``None`` for standard range."""
    return _TRANSFERS.get(int(stream.codec_context.color_trc))


def tone_map(image: UInt16[np.ndarray, "h w 3"], transfer: Transfer) -> UInt8[np.ndarray, "h w 3"]:
    """The sRGB image of a full-range 16-bit HDR signal with BT.2020 primaries."""
    light = _linear_table(transfer)[image]
    if transfer == "hlg":
        # BT.2100's system gamma turns scene light into screen light, by luminance so that hues stay.
        light *= (light @ _LUMA)[..., None] ** 0.2 * (_HLG_PEAK / _WHITE)
    light = np.maximum(light @ _TO_BT709.T, 0)
    # The strongest channel is compressed and takes the others along: hue and saturation survive.
    strongest = np.maximum(light.max(-1, keepdims=True), 1e-6)
    light *= _compress(strongest) / strongest
    return np.rint(255 * _srgb(light)).astype(np.uint8)


@cache
def _linear_table(transfer: Transfer) -> Float[np.ndarray, " 65536"]:
    """Light of every 16-bit signal value: screen light over white for PQ, scene light 0..1 for HLG."""
    signal = np.linspace(0, 1, 65_536)
    if transfer == "pq":  # SMPTE ST 2084, eq. 4.1
        m1, m2, c1, c2, c3 = 2610 / 16_384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        root = signal ** (1 / m2)
        light = 10_000 / _WHITE * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)
    else:  # BT.2100, table 5, inverse OETF
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    return light.astype(np.float32)


def _compress(light: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    room = 1 - _KNEE
    return np.where(light <= _KNEE, light, 1 - room * np.exp(-(np.maximum(light, _KNEE) - _KNEE) / room))


def _srgb(light: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Signal of sRGB for light 0..1 (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)
