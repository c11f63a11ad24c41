"""Single images: files in, files out, and JPEG bytes for reports."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.atomic import replacing
from toonifygb.errors import InputError
from toonifygb.video.pixels import flatten_alpha

if TYPE_CHECKING:
    from jaxtyping import UInt8

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
_ALPHA_STEPS = {"uint8": 1, "uint16": 257}
"""By what the alpha of each depth is divided to become 0..255."""


def load_image(path: str | os.PathLike[str]) -> UInt8[np.ndarray, "h w 3"]:
    """An image file as upright 8-bit RGB: EXIF rotation applied, grey repeated, 16 bits cut to 8, alpha on black.

    Raises:
        InputError: no such file, or not an image.
    """
    path = Path(path)
    data = _file_bytes(path)
    stored = _decoded(data, cv2.IMREAD_UNCHANGED) if data.size else None
    # Decoded twice because only the second mode applies the EXIF rotation and brings every depth to 8 bits, and
    # only the first keeps alpha.
    image = _decoded(data, cv2.IMREAD_COLOR) if stored is not None else None
    if stored is None or image is None:
        raise InputError(f"{path} is not an image that can be read", f"use one of {', '.join(IMAGE_SUFFIXES)}")
    step = _ALPHA_STEPS.get(stored.dtype.name)
    if step and stored.ndim == 3 and stored.shape[2] == 4:
        alpha = (stored[..., 3:] // step).astype(np.uint8)
        rgba = np.concatenate((cv2.cvtColor(image, cv2.COLOR_BGR2RGB), alpha), axis=2)
        return flatten_alpha(rgba)[0]
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _file_bytes(path: Path) -> UInt8[np.ndarray, " n"]:
    """The file as it is: bytes are decoded, because OpenCV cannot open a path on Windows that is not ASCII.

    Raises:
        InputError: no such file, or not to be read.
    """
    try:
        return np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"image {path} cannot be read: {error.strerror}", "check the path") from error


def _decoded(data: UInt8[np.ndarray, " n"], mode: int) -> np.ndarray | None:
    """What OpenCV makes of a file's bytes; None where it refuses them, or the size they claim."""
    try:
        return cv2.imdecode(data, mode)
    except cv2.error:
        return None


def load_rgba(path: str | os.PathLike[str]) -> UInt8[np.ndarray, "h w 4"]:
    """An image file as it is stored, 8-bit RGB with straight alpha; opaque where it has none, grey repeated.

    Raises:
        InputError: no such file, or not an image.
    """
    path = Path(path)
    data = _file_bytes(path)
    stored = _decoded(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if stored is None or stored.dtype.name not in _ALPHA_STEPS:
        raise InputError(f"{path} is not an image that can be read", f"use one of {', '.join(IMAGE_SUFFIXES)}")
    image = (stored // _ALPHA_STEPS[stored.dtype.name]).astype(np.uint8)
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGBA)
    return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGBA)


def save_png(path: str | os.PathLike[str], image: UInt8[np.ndarray, "h w c"]) -> None:
    """Writes an RGB image, or one with straight alpha, as PNG; the file appears only when it is complete.

    Raises:
        InputError: the place cannot be written to.
    """
    path = Path(path)
    order = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    _, data = cv2.imencode(".png", cv2.cvtColor(image, order))
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(data.tobytes())
    except OSError as error:
        raise InputError(f"image {path} cannot be written: {error.strerror}", "choose another place") from error


def encode_jpeg(image: UInt8[np.ndarray, "h w 3"], quality: int = 85) -> bytes:
    """An RGB image as JPEG bytes; ``quality`` 0..100."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()
