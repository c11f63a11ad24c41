"""Clips in: any file FFmpeg decodes, or a folder of images, frame by frame.

Memory holds a few frames whatever the length of the clip. Frames are delivered as they were filmed, none dropped
or doubled, also where their spacing varies. What a user should know about the clip is collected as sentences.
"""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from toonifygb.errors import InputError
from toonifygb.video.container import VideoFile
from toonifygb.video.folder import ImageFolder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np
    from jaxtyping import UInt8

    from toonifygb.structures import VideoInfo


class _Source(Protocol):
    info: VideoInfo

    def frames(self, note: Callable[[str], None]) -> Iterator[UInt8[np.ndarray, "h w 3"]]: ...

    def count(self) -> int: ...


class Clip:
    """A clip that can be iterated any number of times; each time it is read anew."""

    info: VideoInfo
    """What was known before the first frame was asked for."""
    problems: list[str]
    """``info.problems`` and what the latest iteration added: a damaged tail, alpha, HDR. One sentence each."""

    def __init__(self, source: _Source) -> None:
        self._source = source
        self.info = source.info
        self.problems = list(source.info.problems)

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Upright RGB frames, contiguous and not shared.

        Raises:
            InputError: an image of a folder cannot be used.
        """
        self.problems = list(self.info.problems)
        yield from self._source.frames(self._note)

    def count(self) -> int:
        """Number of frames an iteration delivers, counted by decoding."""
        return self._source.count()

    def _note(self, finding: str) -> None:
        sentence = f"{self.info.path} {finding}"
        if sentence not in self.problems:
            self.problems.append(sentence)


def open_clip(path: str | os.PathLike[str]) -> Clip:
    """The clip of a video file or a folder of images.

    Raises:
        InputError: nothing is there, or it is no video with at least one frame.
    """
    path = Path(path)
    if path.is_dir():
        return Clip(ImageFolder(path))
    if not path.exists():
        raise InputError(f"{path} does not exist; expected a video file or a folder of images", "check the path")
    return Clip(VideoFile(path))


def probe(path: str | os.PathLike[str]) -> VideoInfo:
    """What can be told of a clip without decoding more than its first frame; raises as ``open_clip``."""
    return open_clip(path).info


def read(path: str | os.PathLike[str], *, max_frames: int | None = None) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Upright RGB frames of a clip, at most ``max_frames``; raises as ``open_clip``, before the first frame."""
    return itertools.islice(open_clip(path), max_frames)
