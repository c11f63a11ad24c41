"""A folder of images as a clip."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from toonifygb.errors import InputError
from toonifygb.structures import VideoInfo
from toonifygb.video.still import IMAGE_SUFFIXES, load_image

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import numpy as np
    from jaxtyping import UInt8

FOLDER_FPS = 25.0
"""Pace of a folder of images, which carries none."""


class ImageFolder:
    """The images of a folder in natural order: ``frame2`` before ``frame10``. Hidden files are left out.

    Raises:
        InputError: the folder has no images, or the first one cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.files = image_files(path)
        height, width = load_image(self.files[0]).shape[:2]
        self.info = VideoInfo(
            path=str(path),
            width=width,
            height=height,
            fps=FOLDER_FPS,
            n_frames=len(self.files),
            has_audio=False,
            problems=(f"{path} is a folder of images without a pace; taken as {FOLDER_FPS:g} frames per second",),
        )

    def frames(self, note: Callable[[str], None]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """The images one after the other.

        Raises:
            InputError: an image cannot be read or differs in size from the first.
        """
        for file in self.files:
            image = load_image(file)
            height, width = image.shape[:2]
            if (width, height) != (self.info.width, self.info.height):
                raise InputError(
                    f"image {file} is {width}x{height} px, expected {self.info.width}x{self.info.height} px "
                    f"like {self.files[0].name}",
                    "bring all images of the folder to one size",
                )
            yield image

    def count(self) -> int:
        """Number of images."""
        return len(self.files)


def image_files(path: Path) -> list[Path]:
    """The image files of a folder in natural order.

    Raises:
        InputError: there are none.
    """
    files = [
        file for file in path.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")
    ]
    if not files:
        raise InputError(
            f"folder {path} contains no images ({', '.join(IMAGE_SUFFIXES)})", "give a video or a folder of frames"
        )
    return sorted(files, key=_natural)


def _natural(file: Path) -> list[tuple[int, int, str]]:
    """Key that compares runs of digits as numbers; the name itself decides between 01 and 1."""
    parts = re.split(r"(\d+)", file.name.lower())
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts]
