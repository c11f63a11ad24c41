"""A video file as FFmpeg sees it: what it promises, what it holds, and its frames up to the first damage."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import av
import numpy as np
from av.error import FFmpegError
from av.stream import Disposition

from toonifygb.errors import InputError
from toonifygb.structures import VideoInfo
from toonifygb.video import hdr
from toonifygb.video.pixels import PictureFormat
from toonifygb.video.sound import decodable_sound

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from av import VideoFrame
    from av.container import InputContainer
    from av.video.stream import VideoStream
    from jaxtyping import Float, UInt8

_FALLBACK_FPS = 25.0
_MAX_MISSING_SECONDS = 0.5
"""A clip shorter than it promises by more than this counts as cut off; sound often ends a little early."""
_MAX_REORDER = 16
"""Most pictures by which H.264 and HEVC store one later than it is shown."""
_NOT_VIDEO = ("tty", "subviewer", "srt", "ass")
"""FFmpeg renders plain text as if it were a clip; nobody means that here."""
_MAX_PIXEL_STRETCH = 0.15
"""Pixels farther from square than this are brought to square, for the geometry of a face depends on it. Nearer
ones (all of 4:3 television, and clips resized without care) are kept as stored: resampling would cost more."""
_MAX_BAD_STARTS = 200
"""Pictures skipped at the start while the decoder waits for a complete one, as in a recording cut out of a
broadcast."""


class VideoFile:
    """One video file; opened anew for every pass over it.

    Raises:
        InputError: not a file that holds a decodable picture.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with opened(path) as (container, stream):
            timing = _scan(container, stream)
            has_audio = decodable_sound(container) is not None
            has_lost_audio = bool(container.streams.audio) and not has_audio
            opaque_only = stream.metadata.get("alpha_mode") == "1"
        with opened(path) as (container, stream):
            first = next(_pictures(container, stream, lambda _: None), None)
            if first is None:
                raise InputError(f"{path} contains no picture that can be decoded", "convert or re-export the clip")
            aspect = float(stream.sample_aspect_ratio or 1)
            stretched = abs(aspect - 1) > _MAX_PIXEL_STRETCH
            self._format = PictureFormat.of(first, aspect if stretched else 1.0, hdr.transfer_of(stream))
            interlaced = first.interlaced_frame
        width, height = self._format.upright_size
        findings = list(timing.findings)
        if aspect != 1.0:
            done = f"stretched to {width}x{height} px" if stretched else "kept as they are"
            findings.append(f"has pixels {aspect:.3g} times as wide as high; {done}")
        if has_lost_audio:
            findings.append("has sound that cannot be decoded; it is left out")
        if interlaced:
            findings.append("is interlaced; moving edges show a comb")
        if opaque_only:
            findings.append("has an alpha channel that is not used")
        self.info = VideoInfo(
            path=str(path),
            width=width,
            height=height,
            fps=timing.fps,
            n_frames=timing.n_frames,
            has_audio=has_audio,
            problems=tuple(f"{path} {finding}" for finding in findings),
        )

    def frames(self, note: Callable[[str], None]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Upright RGB frames up to the end or the first damage, which is noted."""
        with opened(self._path) as (container, stream):
            for picture in _pictures(container, stream, note):
                yield self._format.to_rgb(picture, note)

    def count(self) -> int:
        """Number of frames that can be decoded."""
        with opened(self._path) as (container, stream):
            return sum(1 for _ in _pictures(container, stream, lambda _: None))


@contextmanager
def opened(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The container and its main video stream, closed afterwards.

    Raises:
        InputError: unreadable, no video, or no decoder for it.
    """
    hint = "give a video file such as .mp4, .mov, .webm or .gif"
    try:
        # "file:" keeps a colon in the name from being taken for a protocol; playlists must not reach the network.
        container = av.open(f"file:{path}", options={"protocol_whitelist": "file"})
    except OSError as error:
        raise InputError(f"{path} cannot be opened: {error.strerror}", hint) from error
    except FFmpegError as error:
        raise InputError(f"{path} is not a video that can be read, or its start is missing", hint) from error
    with container:
        streams = [stream for stream in container.streams.video if not _is_cover(stream)]
        if not streams or container.format.name in _NOT_VIDEO:
            raise InputError(f"{path} contains no video", hint)
        stream = streams[0]
        if stream.codec_context is None:
            raise InputError(f"{path} is encoded in a way that cannot be decoded here", "convert it to H.264")
        stream.thread_type = "AUTO"
        yield container, stream


def _is_cover(stream: VideoStream) -> bool:
    """Whether a stream is the cover picture of a sound file."""
    return bool(stream.disposition & Disposition.attached_pic)


@dataclass(frozen=True)
class _Timing:
    """What the packets tell without being decoded."""

    fps: float
    n_frames: int | None
    findings: tuple[str, ...]


def _scan(container: InputContainer, stream: VideoStream) -> _Timing:
    """Reads all packets (no decoding) for their number, their spacing and where they end."""
    times: list[int] = []
    n_packets, end = 0, 0.0
    try:
        for packet in container.demux():
            if packet.pts is not None:
                end = max(end, float((packet.pts + (packet.duration or 0)) * packet.time_base))
            if packet.stream_index == stream.index and packet.size and not packet.is_discard:
                n_packets += 1
                if packet.pts is not None:
                    times.append(packet.pts)
    except FFmpegError:
        pass  # the decoding pass meets the same damage and notes it
    declared = float(stream.average_rate or stream.guessed_rate or 0)
    fps, findings = _pace(np.array(times, np.float64) * float(stream.time_base or 0), n_packets, declared)
    promised = ((container.duration or 0) + max(container.start_time or 0, 0)) / av.time_base
    if promised > end + _MAX_MISSING_SECONDS and times:
        findings.append(f"ends early: it promises {promised:.1f} s and holds {end:.1f} s")
    return _Timing(fps, n_packets or None, tuple(findings))


def _pace(times: Float[np.ndarray, " n"], n_packets: int, declared: float) -> tuple[float, list[str]]:
    """Mean frames per second from the time stamps, s, and what is remarkable about them."""
    if len(times) < max(n_packets, 2) or np.ptp(times) == 0:
        if declared:
            return declared, []
        return _FALLBACK_FPS, [f"does not tell its pace; taken as {_FALLBACK_FPS:g} frames per second"]
    # At the end of a cut-off file pictures shown earlier but stored later are missing: gaps that mean nothing.
    steps = np.diff(np.sort(times))
    regular = steps[: len(steps) - min(_MAX_REORDER, len(steps) // 2)]
    typical = float(np.median(regular))
    if (np.abs(regular - typical) > 0.5 * typical).any():
        fps = 1 / float(steps.mean())
        return fps, [
            f"has a variable frame rate; its frames are kept as they are, at {fps:.4g} per second on average"
        ]
    fps = 1 / float(regular.mean())
    # The declared rate is exact where it agrees; time stamps are rounded.
    return (declared if abs(declared / fps - 1) < 0.002 else fps), []


def _pictures(container: InputContainer, stream: VideoStream, note: Callable[[str], None]) -> Iterator[VideoFrame]:
    """Decoded pictures in order of showing, up to the first damage."""
    n_good, n_bad = 0, 0
    source = container.decode(stream)
    while True:
        try:
            picture = next(source, None)
        except FFmpegError:
            n_bad += 1
            if n_good == 0 and n_bad <= _MAX_BAD_STARTS:
                source = container.decode(stream)
                continue
            n_drained = 0
            for picture in _drain(stream):
                n_drained += 1
                yield picture
            note(f"is damaged after frame {n_good + n_drained}; only the frames before that are used")
            return
        if picture is None:
            break
        if picture.is_corrupt and n_good:
            note(f"is damaged after frame {n_good}; only the frames before that are used")
            return
        if not picture.is_corrupt:
            n_good += 1
            yield picture


def _drain(stream: VideoStream) -> Iterator[VideoFrame]:
    """Good pictures the decoder still holds back for reordering when the stream breaks off."""
    try:
        for picture in stream.decode(None):
            if picture.is_corrupt:
                return
            yield picture
    except FFmpegError:
        return
