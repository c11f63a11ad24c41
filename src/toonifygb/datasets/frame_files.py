"""metrical-tracker's ``.frame`` files: one ``torch.save`` of numpy arrays per frame, read by the restricted reader.

Writing one takes no pickle either: the few instructions that make a dict of arrays are written down as bytes.
"""

from __future__ import annotations

import struct
import zipfile
from typing import TYPE_CHECKING, Any

import numpy as np

from toonifygb.assets.convert import StoredTensor, read_checkpoint
from toonifygb.atomic import replacing
from toonifygb.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

_REQUIRED = {
    "flame.exp": 100,
    "flame.shape": 300,
    "flame.jaw": 6,
    "flame.eyes": 12,
}
"""Arrays of the head and how many numbers each has."""
_CAMERAS = {
    "opencv.R": 9,
    "opencv.t": 3,
    "opencv.K": 9,
    "camera.R": 6,
    "camera.t": 3,
    "camera.fl": 1,
    "camera.pp": 2,
}


def read_frame(path: Path) -> dict[str, np.ndarray]:
    """The arrays of one frame, flat, by dotted name; a camera as OpenCV's or as PyTorch3D's, and ``img_size``.

    Raises:
        AssetError: the file is damaged or holds code.
        InputError: it is no frame of the tracker.
    """
    values = read_checkpoint(path).values
    found = {}
    for name, count in {**_REQUIRED, **_CAMERAS, "flame.eyelids": 2, "img_size": 2}.items():
        value: Any = values
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if value is None:
            continue
        array = _numbers(value)
        if array is None or array.size != count or not np.isfinite(array).all():
            raise InputError(f"{path}: {name} is not {count} finite numbers", "track the clip again")
        found[name] = array
    missing = [name for name in (*_REQUIRED, "img_size") if name not in found]
    if "opencv.K" not in found and "camera.fl" not in found:
        missing.append("opencv or camera")
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}; expected a frame of metrical-tracker")
    return found


def _numbers(value: Any) -> np.ndarray | None:
    if isinstance(value, StoredTensor):
        return value.array().flatten()
    plain = isinstance(value, list) and all(isinstance(item, int | float) for item in value)
    return np.asarray(value, np.float64) if plain else None


def write_frame(path: Path, values: dict[str, Any]) -> None:
    """Writes nested dicts of arrays, strings and whole numbers as ``torch.save`` would."""
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x03" + _written(values) + b".")
        archive.writestr("archive/version", b"3\n")


def _written(value: Any) -> bytes:
    """Instructions of a pickle, protocol 3, that leave the value on the stack."""
    if isinstance(value, dict):
        return b"}(" + b"".join(_written(key) + _written(item) for key, item in value.items()) + b"u"
    if isinstance(value, str):
        return b"X" + struct.pack("<I", len(value.encode())) + value.encode()
    if isinstance(value, int):
        return b"J" + struct.pack("<i", value)
    assert isinstance(value, np.ndarray) and value.dtype.kind in "fi", f"{type(value)} cannot be written"
    little = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
    data = little.tobytes()
    made = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
    dtype = b"cnumpy\ndtype\n" + _written(f"{value.dtype.kind}{value.dtype.itemsize}") + b"\x89\x88\x87R"
    dtype += b"(K\x03" + _written("<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    shape = b"(" + b"".join(_written(length) for length in value.shape) + b"t"
    return made + b"(K\x01" + shape + dtype + b"\x89B" + struct.pack("<I", len(data)) + data + b"tb"
