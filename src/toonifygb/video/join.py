"""Clips written piece by piece, put together without encoding them again."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import av
from av.error import FFmpegError

from toonifygb.errors import InputError
from toonifygb.video.sound import open_sound

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from av.container import OutputContainer
    from av.packet import Packet


def join(
    parts: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    audio_from: str | os.PathLike[str] | None = None,
) -> None:
    """Puts clips one after the other; the pictures are copied bit for bit.

    Args:
        parts: clips that one ``Writer`` setting made: same size, pace and encoder.
        out: the file to write; it appears only when it is complete.
        audio_from: clip whose sound accompanies the frames, as for ``Writer``.

    Raises:
        InputError: the place cannot be written to, or a part is damaged.
    """
    out = Path(out)
    temporary = out.with_name(f"{out.stem}.part.mp4")
    try:
        with av.open(f"file:{temporary}", "w", format="mp4", options={"movflags": "+faststart"}) as target:
            _copy(parts, target, audio_from)
        os.replace(temporary, out)
    except (FFmpegError, OSError) as error:
        reason = error.strerror or str(error)
        raise InputError(
            f"video {out} cannot be put together: {reason}", "check the folder, its permissions and free space"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _copy(
    parts: Sequence[str | os.PathLike[str]],
    target: OutputContainer,
    audio_from: str | os.PathLike[str] | None,
) -> None:
    """Copies the packets of all parts, each part's times moved to the end of the one before."""
    with av.open(f"file:{parts[0]}") as first:
        template = first.streams.video[0]
        stream = target.add_stream_from_template(template)
        rate, time_base = template.average_rate, template.time_base
        assert rate and time_base, f"{parts[0]} has no pace"
        stream.time_base = time_base
        frame_ticks = round(1 / (rate * time_base))
    sound = None if audio_from is None else open_sound(audio_from, target)
    try:
        n_frames = 0
        for part in parts:
            start = n_frames * frame_ticks
            for packet in _packets(part):
                packet.pts, packet.dts = (packet.pts or 0) + start, (packet.dts or 0) + start
                packet.stream = stream
                target.mux(packet)
                n_frames += 1
                if sound is not None:
                    sound.advance(Fraction(n_frames) / rate)
        if sound is not None:
            sound.finish()
    finally:
        if sound is not None:
            sound.close()


def _packets(part: str | os.PathLike[str]) -> Iterator[Packet]:
    """The encoded frames of a clip in the order they are stored."""
    with av.open(f"file:{part}") as source:
        for packet in source.demux(source.streams.video[0]):
            if packet.size:  # the last one is empty and only says that there are no more
                yield packet
