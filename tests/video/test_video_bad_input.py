"""Whatever a user drops in: one clear sentence, or the frames that are there."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import av
import numpy as np
import pytest
from video_clips import moving, write_clip

from toonifygb.errors import InputError
from toonifygb.video import open_clip, read

if TYPE_CHECKING:
    from pathlib import Path


def _silent_sound(path: Path) -> None:
    with av.open(str(path), "w") as output:
        stream = output.add_stream("mp3", rate=44_100)
        frame = av.AudioFrame.from_ndarray(np.zeros((2, 44_100), np.float32), format="fltp", layout="stereo")
        frame.sample_rate = 44_100
        output.mux(stream.encode(frame))
        output.mux(stream.encode(None))


def _no_frames(path: Path) -> None:
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        output.start_encoding()


def _headless(path: Path) -> None:
    """A recording that broke off before its index was written, as when a phone's battery dies."""
    write_clip(path, [moving(i) for i in range(20)])
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"moov")])


MAKERS = {
    "text.txt": lambda path: path.write_text("hello\n" * 100),
    "text.mp4": lambda path: path.write_text("hello\n" * 100),
    "empty.mp4": lambda path: path.touch(),
    "noise.mp4": lambda path: path.write_bytes(np.random.default_rng(0).bytes(50_000)),
    "sound.mp3": _silent_sound,
    "no_frames.mp4": _no_frames,
    "headless.mp4": _headless,
    "folder": lambda path: path.mkdir(),
    "absent.mp4": lambda path: None,
}


@pytest.mark.parametrize("name", MAKERS)
def test_unusable_input_is_one_sentence(tmp_path: Path, name: str):
    path = tmp_path / name
    MAKERS[name](path)
    with pytest.raises(InputError) as caught:
        open_clip(path)
    assert name in caught.value.message and caught.value.hint
    assert "\n" not in str(caught.value) and "Errno" not in str(caught.value)
    with pytest.raises(InputError):
        read(path)  # complains at once, not at the first frame


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may read everything")
def test_forbidden_file_is_one_sentence(tmp_path: Path):
    path = write_clip(tmp_path / "locked.mp4", [moving(0)])
    path.chmod(0)
    with pytest.raises(InputError, match=r"locked\.mp4"):
        open_clip(path)


def _big(path: Path, **options: dict[str, str]) -> bytes:
    images = [moving(i, 120, 160) for i in range(60)]
    return write_clip(path, images, options={"crf": "5"}, **options).read_bytes()


@pytest.mark.parametrize("name", ["cut.mp4", "cut.mkv"])
def test_cut_off_file_gives_its_frames_and_a_sentence(tmp_path: Path, name: str):
    path = tmp_path / name
    data = _big(path, container={"movflags": "+faststart"} if name.endswith("mp4") else {})
    path.write_bytes(data[: int(0.6 * len(data))])
    clip = open_clip(path)
    frames = list(clip)
    assert 20 < len(frames) < 50 and clip.count() == len(frames)
    assert "ends early" in clip.problems[0]
    assert np.abs(frames[10].astype(int) - moving(10, 120, 160)).mean() < 6


@pytest.mark.parametrize("tail_only", [True, False])
def test_damaged_data_gives_the_frames_before_and_a_sentence(tmp_path: Path, tail_only: bool):
    path = tmp_path / "damaged.mp4"
    data = bytearray(_big(path, container={"movflags": "+faststart"}))
    middle = len(data) // 2
    end = len(data) if tail_only else middle + 4000
    data[middle:end] = bytes(end - middle)
    path.write_bytes(data)
    clip = open_clip(path)
    frames = list(clip)
    assert 10 < len(frames) < 60
    assert len(clip.problems) == 1 and f"damaged after frame {len(frames)}" in clip.problems[0]
    for index in (0, len(frames) - 1):
        assert np.abs(frames[index].astype(int) - moving(index, 120, 160)).mean() < 6


def test_broadcast_cut_starts_at_its_first_whole_picture(tmp_path: Path):
    path = tmp_path / "cut.ts"
    write_clip(path, [moving(i) for i in range(60)], options={"g": "20"})
    data = path.read_bytes()
    path.write_bytes(data[len(data) // 3 // 188 * 188 :])
    assert 20 <= len(list(open_clip(path))) <= 45


def test_one_frame_is_a_clip(tmp_path: Path):
    assert len(list(read(write_clip(tmp_path / "one.mp4", [moving(0)])))) == 1


def test_size_change_inside_a_clip_keeps_one_frame_size(tmp_path: Path):
    small, large = tmp_path / "small.ts", tmp_path / "large.ts"
    write_clip(small, [moving(i, 48, 64) for i in range(5)])
    write_clip(large, [moving(i, 96, 128) for i in range(5)])
    both = tmp_path / "both.ts"
    both.write_bytes(small.read_bytes() + large.read_bytes())
    shapes = {frame.shape for frame in read(both)}
    assert shapes == {(48, 64, 3)}
