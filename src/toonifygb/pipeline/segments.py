"""The stylised video, written in segments, so that a killed run goes on where it was.

A segment is a finished stretch of the final video. When all are there they are put together without encoding them
again; so a run that was killed, however often, ends with the same file as one that was left alone. What the style
keeps of the clip is stored beside the segments: it need not come out the same bit for bit a second time.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from toonifygb import __version__, video
from toonifygb.errors import InputError
from toonifygb.pipeline.files import load_state, save_state
from toonifygb.pipeline.stages import fingerprint

if TYPE_CHECKING:
    from toonifygb.pipeline.source import Source
    from toonifygb.progress import Progress

SEGMENT = 64
"""Frames of a segment: at most so many are done again, and every one costs the video a key frame."""
_STATE = "state-{}.safetensors"


class Segments:
    """A folder of finished segments, made with the first of them.

    Args:
        folder: where they are.
        inputs: settings and fingerprints that the frames depend on; segments of others are thrown away.

    Raises:
        InputError: the folder holds something else.
    """

    def __init__(self, folder: Path, *inputs: Any) -> None:
        self.folder = folder
        self._state = folder / _STATE.format(fingerprint(__version__, *inputs)[:16])
        if folder.exists() and not self._state.exists():
            others = [path for path in folder.iterdir() if not path.name.startswith(".")]
            if others and not list(folder.glob(_STATE.format("*"))):
                raise InputError(f"folder {folder} holds other files ({others[0].name})", "move it away")
            shutil.rmtree(folder, ignore_errors=True)

    def state(self, prepare: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What the style keeps of the clip: as stored, or prepared now and stored.

        Raises:
            InputError: the folder cannot be written.
        """
        if not self._state.exists():
            prepared = prepare()
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                save_state(prepared, self._state)
            except OSError as error:
                raise InputError(
                    f"folder {self.folder} cannot be written: {error.strerror}",
                    "check the place and its free space",
                ) from error
        return load_state(self._state)

    def finished(self) -> list[Path]:
        """The segments that are done, from the first without a gap."""
        return list(_while_there(self.folder))

    def write(self, frames: Iterator[np.ndarray], fps: float, progress: Progress, n_frames: int | None) -> None:
        """Writes the frames after those that are done."""
        number = len(self.finished())
        done = number * SEGMENT
        for first in frames:
            height, width = first.shape[:2]
            with video.Writer(_path(self.folder, number), width, height, fps) as writer:
                for frame in chain([first], islice(frames, SEGMENT - 1)):
                    writer.write(frame)
                    done += 1
                    progress.update(done, n_frames)
            number += 1

    def join(self, out: Path, source: Source) -> None:
        """Puts the segments together, with the source's sound, and removes them.

        Raises:
            InputError: there are none: the clip has no frames.
        """
        parts = self.finished()
        if not parts:
            raise InputError(f"{source.path.name} has no frames to write", "check that the video plays")
        video.join(parts, out, audio_from=source.path)
        shutil.rmtree(self.folder, ignore_errors=True)


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:06d}.mp4"


def _while_there(folder: Path) -> Iterator[Path]:
    number = 0
    while (path := _path(folder, number)).exists():
        yield path
        number += 1
