"""Clips out: H.264 in MP4, as every browser and phone plays it."""

from __future__ import annotations

import contextlib
import os
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import av
import numpy as np
from av import VideoFrame
from av.error import FFmpegError

from toonifygb.errors import InputError
from toonifygb.video import pixels
from toonifygb.video.sound import SoundTrack, open_sound

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import TracebackType

    from av.video.stream import VideoStream
    from jaxtyping import UInt8

_QUALITY = "17"
"""x264's constant rate factor: visually lossless, since a written clip may be read again for training."""
_LOOKAHEAD_BYTES = 256 * 2**20
"""Most memory x264 may hold in frames to look ahead; only clips beyond 1440p feel it."""
_BT709 = 1
"""H.273's number for BT.709, alike for primaries, transfer and matrix, and swscale's for the matrix."""
_WRITING = pixels.BICUBIC | pixels.FULL_CHROMA_IN | pixels.ACCURATE_ROUNDING


class Writer:
    """Writes frames at a constant pace; the file appears under its name only when it is complete.

    Use as a context manager. An exception inside, also Ctrl-C, leaves nothing behind. H.264 as players need it
    (4:2:0) has even sides only: an odd side grows by one row or column, repeated from the last, so
    ``written_size`` may exceed the frames' size by one.

    Args:
        path: the file to write, ending in ``.mp4``; an existing one is replaced at the end.
        width: of the frames, px.
        height: of the frames, px.
        fps: frames per second.
        audio_from: clip whose sound accompanies the frames, from its start and cut to their length; a clip
            without sound gives none.

    Raises:
        InputError: the place cannot be written to, or the disk is full.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        width: int,
        height: int,
        fps: float | Fraction,
        *,
        audio_from: str | os.PathLike[str] | None = None,
    ) -> None:
        self.path = Path(path)
        self.written_size = (width + width % 2, height + height % 2)
        self.n_frames = 0
        self._finished = False
        self._sound: SoundTrack | None = None
        self._size = (width, height)
        self._rate = exact_rate(fps)
        self._part = self.path.with_name(f"{self.path.stem}.part.mp4")
        if self.path.suffix.lower() != ".mp4":
            raise InputError(
                f"output {self.path} does not end in .mp4", f"write to {self.path.with_suffix('.mp4')}"
            )
        with self._explained():
            self._part.touch()  # FFmpeg opens it only with the first frame, too late to complain
            # The whole index in front lets players start before the file has arrived.
            self._container = av.open(f"file:{self._part}", "w", format="mp4", options={"movflags": "+faststart"})
        try:
            with self._explained():
                self._stream = self._add_video()
                if audio_from is not None:
                    self._sound = open_sound(audio_from, self._container)
        except BaseException:
            self._discard()
            raise

    def write(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Appends one RGB frame.

        Raises:
            InputError: the disk is full or went away.
        """
        width, height = self._size
        assert frame.shape == (height, width, 3) and frame.dtype == np.uint8, (
            f"frame is {frame.shape} {frame.dtype}"
        )
        picture = VideoFrame.from_ndarray(_padded_to_even(frame), format="rgb24").reformat(
            format="yuv420p",
            dst_colorspace=_BT709,
            src_color_range=pixels.FULL_RANGE,
            dst_color_range=pixels.LIMITED_RANGE,
            interpolation=_WRITING,
        )
        picture.pts, picture.time_base = self.n_frames, 1 / self._rate
        with self._explained():
            self._container.mux(self._stream.encode(picture))
            self.n_frames += 1
            if self._sound is not None:
                self._sound.advance(self.n_frames / self._rate)

    def close(self) -> None:
        """Completes the file and gives it its name; without frames nothing is left behind.

        Raises:
            InputError: the disk is full or went away.
        """
        try:
            if self.n_frames:
                with self._explained():
                    self._container.mux(self._stream.encode(None))
                    if self._sound is not None:
                        self._sound.finish()
                    self._finished = True
                    self._container.close()
                    os.replace(self._part, self.path)
        finally:
            self._discard()

    def __enter__(self) -> Writer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._discard()

    def _add_video(self) -> VideoStream:
        width, height = self.written_size
        frame_bytes = width * height * 3 // 2
        options = {
            "crf": _QUALITY,
            "preset": "medium",
            "rc-lookahead": str(max(4, min(40, _LOOKAHEAD_BYTES // frame_bytes))),
            # x264's macroblock tree does not give the same bytes every time (seen with its AVX-512 code, on
            # drifting patterns); a resumed run must end with the same file as an uninterrupted one.
            "x264-params": "mbtree=0",
        }
        stream = self._container.add_stream("libx264", rate=self._rate, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.time_base = 1 / self._rate
        context.color_primaries = context.color_trc = context.colorspace = _BT709
        context.color_range = pixels.LIMITED_RANGE
        return stream

    def _discard(self) -> None:
        """Removes whatever is unfinished; safe to call at any time, any number of times."""
        if self._sound is not None:
            self._sound.close()
        if not self._finished:
            self._finished = True
            # Closing writes the index; on a full disk that fails again, which is no news.
            with contextlib.suppress(FFmpegError, OSError):
                self._container.close()
        self._part.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Turns the system's complaints about the output into one sentence."""
        try:
            yield
        except (FFmpegError, OSError) as error:
            reason = error.strerror or str(error)
            raise InputError(
                f"video {self.path} cannot be written: {reason}", "check the folder, its permissions and free space"
            ) from error


def exact_rate(fps: float | Fraction) -> Fraction:
    """The pace as a fraction; 29.97 and its kin become multiples of 1000/1001, as they are meant."""
    assert fps > 0, f"{fps} frames per second"
    if isinstance(fps, Fraction):
        return fps
    television = Fraction(round(fps * 1001 / 1000) * 1000, 1001)
    if television and abs(float(television) - fps) < 2e-3 and abs(round(fps) - fps) > 1e-6:
        return television
    return Fraction(fps).limit_denominator(1000)


def _padded_to_even(frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    height, width = frame.shape[:2]
    if width % 2 or height % 2:
        frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return np.ascontiguousarray(frame)
