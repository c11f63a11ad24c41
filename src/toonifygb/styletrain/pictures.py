"""The pictures a style is learnt from: a folder of JPEG and PNG files as aligned faces of one size.

Nothing in the folder can end the training but too few faces: what is no picture, shows no face or claims an absurd
size is left out and reported with a sentence.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from toonifygb.atomic import replacing
from toonifygb.config import FaceConfig
from toonifygb.errors import FaceError, InputError
from toonifygb.face import find_landmarks
from toonifygb.progress import SILENT
from toonifygb.stylize.styleganex.align import FaceMarks, align_face, face_quad
from toonifygb.video import load_image

if TYPE_CHECKING:
    from pathlib import Path

    from jaxtyping import UInt8
    from torch import Tensor

    from toonifygb.config import StyleTrainConfig
    from toonifygb.progress import Progress

    Image = UInt8[np.ndarray, "h w 3"]

SUFFIXES = (".jpg", ".jpeg", ".png")
MIN_PICTURES = 5
MAX_PIXELS = 100_000_000
"""Largest picture that is decoded; a few bytes can claim far more."""
MIN_FACE_SHARE = 0.5
"""Square around a face, in sides of the training's pictures, below which it is too small to learn from."""
_JPEG_SIZES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
"""Markers of the JPEG segments that hold a picture's size."""


@dataclass(frozen=True)
class Pictures:
    """Aligned faces and what was left out."""

    images: UInt8[Tensor, "n 3 s s"]
    problems: tuple[str, ...]
    """One sentence per file that was left out."""
    fingerprint: str
    """Of the files and of how they were aligned."""


def read_pictures(
    folder: Path, config: StyleTrainConfig, kept: Path, device: str = "cpu", progress: Progress = SILENT
) -> Pictures:
    """The usable pictures of a folder.

    Args:
        folder: with JPEG or PNG files; folders inside it are not looked into.
        config: resolution, and whether the pictures are aligned already.
        kept: file the aligned pictures are kept in, so that a training that goes on need not align again.
        device: where the face networks run.
        progress: told after every file.

    Raises:
        InputError: no such folder, or fewer than ``MIN_PICTURES`` usable pictures.
    """
    files = check_folder(folder)
    fingerprint = _fingerprint(files, config)
    found = _read_kept(kept, fingerprint)
    if found is not None:
        return found
    images, problems = [], []
    for index, file in enumerate(files):
        try:
            images.append(_prepared(_decoded(file), config, device))
        except (InputError, FaceError) as error:
            problems.append(f"{file.name} is left out: {error.message}")
        progress.update(index + 1, len(files))
    _check_count(folder, len(images), len(files), f"; {problems[0]}" if problems else "")
    stacked = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).contiguous()
    pictures = Pictures(stacked, tuple(problems), fingerprint)
    notes = {"fingerprint": fingerprint, "problems": json.dumps(problems)}
    with replacing(kept) as temporary:
        save_file({"images": stacked}, temporary, metadata=notes)
    return pictures


def check_folder(folder: Path) -> list[Path]:
    """The files of a folder that may be pictures, by name.

    Raises:
        InputError: no such folder, or fewer than ``MIN_PICTURES`` such files.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; expected one with pictures of the style", "check the path")
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and file.name[0] != ".")
    _check_count(folder, len(files), len(files), "")
    return files


def _check_count(folder: Path, n_usable: int, n_files: int, why: str) -> None:
    if n_usable < MIN_PICTURES:
        raise InputError(
            f"{folder} has {n_usable} usable of {n_files} pictures ({', '.join(SUFFIXES)}); a style needs at least "
            f"{MIN_PICTURES}{why}",
            "add pictures that show one face each, from the front; 50 to 300 are best",
        )


def claimed_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a JPEG or PNG file claims to have, read without decoding it; None for other files."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        return struct.unpack(">II", data[16:24])
    if data[:2] != b"\xff\xd8":
        return None
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        if data[place + 1] in _JPEG_SIZES:
            height, width = struct.unpack(">HH", data[place + 5 : place + 9])
            return width, height
        # A marker may be preceded by any number of fill bytes.
        place += 1 if data[place + 1] == 0xFF else 2 + struct.unpack(">H", data[place + 2 : place + 4])[0]
    return None


def _decoded(file: Path) -> Image:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"it cannot be read ({error.strerror})") from error
    size = claimed_size(data)
    if size is None:
        raise InputError("it is no JPEG or PNG picture")
    if not 0 < size[0] * size[1] <= MAX_PIXELS:
        raise InputError(f"it claims {size[0]}x{size[1]} px; at most {MAX_PIXELS // 1_000_000} million px are read")
    return load_image(file)


def _prepared(image: Image, config: StyleTrainConfig, device: str) -> Image:
    """The face of a picture at the training's size.

    Raises:
        InputError: it was said to be aligned and is not square.
        FaceError: it shows no face, or one that is too small.
    """
    side = config.resolution
    if config.aligned:
        height, width = image.shape[:2]
        if height != width:
            raise InputError(f"it is {width}x{height} px; aligned pictures are square")
        _check_size(width, side)
        return _resized(image, side)
    landmarks, _ = find_landmarks([image], FaceConfig(), device=device)
    marks = FaceMarks.from_mediapipe(landmarks.points[0].numpy())
    quad = face_quad(marks)
    _check_size(float(np.linalg.norm(quad[2] - quad[1])), side)
    # Twice as fine and then averaged: the alignment alone picks single px where it shrinks.
    return _resized(align_face(image, marks, 2 * side).image, side)


def _check_size(shown_px: float, side: int) -> None:
    least = MIN_FACE_SHARE * side
    if shown_px < least:
        raise FaceError(
            f"the square around its face is {shown_px:.0f} px wide; --resolution {side} needs {least:.0f}"
        )


def _resized(image: Image, side: int) -> Image:
    """A square picture at another size, low-pass filtered where it shrinks."""
    planes = torch.from_numpy(image).permute(2, 0, 1)[None].float()
    sized = F.interpolate(planes, (side, side), mode="bicubic", antialias=True, align_corners=False)
    return sized[0].round().clamp(0, 255).byte().permute(1, 2, 0).numpy()


def _fingerprint(files: list[Path], config: StyleTrainConfig) -> str:
    digest = hashlib.sha256(f"{config.resolution} {config.aligned}".encode())
    for file in files:
        digest.update(f"\n{file.name} ".encode())
        if file.is_file():
            with file.open("rb") as content:
                digest.update(hashlib.file_digest(content, "sha256").digest())
    return digest.hexdigest()


def _read_kept(kept: Path, fingerprint: str) -> Pictures | None:
    """The pictures aligned by an earlier run, if they are of the same files."""
    try:
        with safe_open(kept, framework="pt") as file:
            notes = file.metadata() or {}
            if notes.get("fingerprint") != fingerprint:
                return None
            return Pictures(file.get_tensor("images"), tuple(json.loads(notes["problems"])), fingerprint)
    except (SafetensorError, OSError, KeyError, ValueError):
        return None
