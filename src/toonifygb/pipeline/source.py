"""The clip a run is made from."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from toonifygb import stylize, video
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

    def frames(self, config: RunConfig) -> Generator[np.ndarray, None, None]:
        """Its frames from the start, streaming."""
        yield from video.read(self.path, max_frames=config.max_frames)

    def n_frames(self, config: RunConfig) -> int | None:
        """How many frames to expect; ``None`` when the container does not say."""
        known = (n for n in (self.info.n_frames, config.max_frames) if n is not None)
        return min(known, default=None)


def open_source(clip: Path, config: RunConfig) -> Source:
    """The clip, probed and hashed; the style checked too, so that a wrong request fails before any work.

    Raises:
        InputError: no such file, not a video, no frames, or an unknown style.
    """
    info = video.probe(clip)
    open_style(config)
    return Source(clip, info, video.source_sha256(clip))


def open_style(config: RunConfig) -> Stylizer:
    """The style a run asks for; raises as ``stylize.get``."""
    return stylize.get(config.stylize.style, config.styleganex)


def style_inputs(config: RunConfig) -> list[Any]:
    """What decides a style's frames beside the clip: its settings, and the checksums of the files it reads."""
    files = [video.source_sha256(path) for path in stylize.files(config.stylize.style)]
    return [config.stylize, *([config.styleganex, *files] if files else [])]
