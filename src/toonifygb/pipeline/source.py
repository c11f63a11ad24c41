"""The clip a run is made from."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from toonifygb import datasets, head, stylize, video
from toonifygb.structures import VideoInfo

if TYPE_CHECKING:
    from toonifygb.config import RunConfig
    from toonifygb.stylize import Stylizer


@dataclass(frozen=True)
class Source:
    """A clip that was probed and hashed."""

    path: Path
    info: VideoInfo
    sha256: str
    foreign: datasets.ForeignFolder | None = None
    """The dataset whose pictures are the clip, where it is one."""

    def frames(self, config: RunConfig) -> Generator[np.ndarray, None, None]:
        """Its frames from the start, streaming."""
        if self.foreign is None:
            yield from video.read(self.path, max_frames=config.max_frames)
        else:
            yield from (datasets.read_picture(picture)[0] for picture in self.foreign.pictures)

    def clip(self, config: RunConfig) -> tuple[Iterable[np.ndarray], list[str]]:
        """Its frames, and a list of sentences about it that grows while they are read."""
        if self.foreign is not None:
            return self.frames(config), []
        clip = video.open_clip(self.path)
        return itertools.islice(clip, config.max_frames), clip.problems

    def n_frames(self, config: RunConfig) -> int | None:
        """How many frames to expect; ``None`` when the container does not say."""
        known = (n for n in (self.info.n_frames, config.max_frames) if n is not None)
        return min(known, default=None)


def open_source(clip: Path, config: RunConfig) -> Source:
    """The clip or dataset, probed and hashed; style and head model checked: wrong requests fail before any work.

    Raises:
        InputError: no such file, not a video, no frames, or an unknown style or head model.
        AssetError: a head model that has not been added.
    """
    foreign = datasets.recognize(clip)
    open_style(config)
    head.load(head_name(config, foreign))
    if foreign is None:
        return Source(clip, video.probe(clip), video.source_sha256(clip))
    foreign = foreign.first(config.max_frames)
    height, width = video.load_rgba(foreign.pictures[0].image).shape[:2]
    info = VideoInfo(str(clip), width, height, datasets.FPS, len(foreign.ids), has_audio=False)
    whole = hashlib.sha256()
    for file in (*foreign.parameters, *(file for picture in foreign.pictures for file in picture.files)):
        whole.update(bytes.fromhex(video.source_sha256(file)))
    return Source(clip, info, whole.hexdigest(), foreign)


def head_name(config: RunConfig, foreign: datasets.ForeignFolder | None) -> str:
    """The head model of a run: the one asked for, or else that of a dataset's track."""
    return foreign.head if foreign is not None and config.head == "open" else config.head


def open_style(config: RunConfig) -> Stylizer:
    """The style a run asks for; raises as ``stylize.get``."""
    return stylize.get(config.stylize.style, config.styleganex)


def style_inputs(config: RunConfig) -> list[Any]:
    """What decides a style's frames beside the clip: its settings, and the checksums of the files it reads."""
    files = [video.source_sha256(path) for path in stylize.files(config.stylize.style)]
    return [config.stylize, *([config.styleganex, *files] if files else [])]
