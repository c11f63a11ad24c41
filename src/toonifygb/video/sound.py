"""The source's sound, re-encoded and cut to the length of the written frames."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

import av
import numpy as np
from av import AudioFrame, AudioResampler
from av.error import FFmpegError

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator

    from av.audio.stream import AudioStream
    from av.container import InputContainer, OutputContainer

_BIT_RATE = 192_000
_RATES = (8_000, 11_025, 12_000, 16_000, 22_050, 24_000, 32_000, 44_100, 48_000)
"""Sample rates AAC knows and every player takes, Hz; sound of any other is brought to the last."""


class SoundTrack:
    """Streams one file's sound into another, sample-exact and in step with its frames.

    Sound that starts after the picture is preceded by silence, sound before it is left out. A damaged remainder
    is left out as well: the frames matter more.
    """

    def __init__(self, source: InputContainer, stream: AudioStream, target: OutputContainer) -> None:
        self._source, self._target = source, target
        self._rate = stream.rate if stream.rate in _RATES else _RATES[-1]
        layout = "mono" if stream.codec_context.channels == 1 else "stereo"
        self._stream: AudioStream = target.add_stream("aac", rate=self._rate, layout=layout)
        self._stream.bit_rate = _BIT_RATE
        self._resampler = AudioResampler(format="fltp", layout=layout, rate=self._rate)
        self._layout = layout
        self._waiting = np.zeros((1 if layout == "mono" else 2, 0), np.float32)
        self._chunks = self._decode(stream)
        self._sent = 0

    def advance(self, seconds: Fraction) -> None:
        """Writes sound up to this moment of the clip."""
        wanted = round(seconds * self._rate) - self._sent
        while self._waiting.shape[1] < wanted:
            chunk = next(self._chunks, None)
            if chunk is None:
                break
            self._waiting = np.concatenate((self._waiting, chunk), axis=1)
        now, self._waiting = self._waiting[:, :wanted], self._waiting[:, wanted:]
        if now.shape[1]:
            frame = AudioFrame.from_ndarray(np.ascontiguousarray(now), "fltp", self._layout)
            frame.sample_rate = self._rate
            frame.pts, frame.time_base = self._sent, Fraction(1, self._rate)
            self._sent += now.shape[1]
            self._target.mux(self._stream.encode(frame))

    def finish(self) -> None:
        """Writes what the encoder still holds."""
        self._target.mux(self._stream.encode(None))

    def close(self) -> None:
        """Lets go of the source."""
        self._source.close()

    def _decode(self, stream: AudioStream) -> Iterator[np.ndarray]:
        """Planar float samples from the moment the picture starts."""
        lead: int | None = None
        try:
            for frame in self._source.decode(stream):
                if lead is None:
                    lead = self._lead(frame)
                    if lead > 0:
                        yield np.zeros((len(self._waiting), lead), np.float32)
                for piece in self._resampler.resample(frame):
                    samples = piece.to_ndarray()
                    skipped = min(max(-lead, 0), samples.shape[1])
                    lead += skipped
                    yield np.ascontiguousarray(samples[:, skipped:])
        except FFmpegError:
            return

    def _lead(self, first: AudioFrame) -> int:
        """Samples by which the sound starts after the picture; negative when before."""
        video = next(iter(self._source.streams.video), None)
        if video is None or video.start_time is None or not video.time_base or first.time is None:
            return 0
        return round((first.time - float(video.start_time * video.time_base)) * self._rate)


def open_sound(path: str | os.PathLike[str], target: OutputContainer) -> SoundTrack | None:
    """The sound of a clip as a track of ``target``; ``None`` when it has none that can be decoded."""
    try:
        source = av.open(f"file:{path}", options={"protocol_whitelist": "file"})
    except (FFmpegError, OSError):
        return None
    stream = decodable_sound(source)
    if stream is None:
        source.close()
        return None
    return SoundTrack(source, stream, target)


def decodable_sound(source: InputContainer) -> AudioStream | None:
    """The first audio stream FFmpeg can decode; phones add spatial sound that it cannot."""
    return next((stream for stream in source.streams.audio if stream.codec_context is not None), None)
