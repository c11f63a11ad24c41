"""The stylised video: the same file however often it was interrupted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from toonifygb import stylize, video
from toonifygb.config import RunConfig, StylizeConfig
from toonifygb.errors import FaceError, InputError
from toonifygb.pipeline import segments as pieces
from toonifygb.pipeline.files import load_state, save_state
from toonifygb.pipeline.segments import Segments
from toonifygb.pipeline.single import stylize_file
from toonifygb.pipeline.source import Source, open_source
from toonifygb.progress import SILENT, Stopped

N_FRAMES, WIDTH, HEIGHT = 28, 160, 128
SEGMENT = 8


@pytest.fixture(autouse=True)
def _short_segments_without_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_found(*_: object, **__: object) -> None:
        raise FaceError("no face")

    monkeypatch.setattr("toonifygb.pipeline.single.face.find_landmarks", none_found)
    monkeypatch.setattr(pieces, "SEGMENT", SEGMENT)
    monkeypatch.setattr("toonifygb.pipeline.create.SEGMENT", SEGMENT)


def pictures() -> Iterator[np.ndarray]:
    """Soft waves that drift: no two frames alike. (Of noise, x264 does not always make the same bytes.)"""
    x = np.arange(WIDTH)[None, :, None] + 5.0 * np.arange(3)
    y = np.arange(HEIGHT)[:, None, None]
    for index in range(N_FRAMES):
        yield (128 + 80 * np.sin(0.2 * x + 0.1 * y + 0.3 * index)).astype(np.uint8)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clip") / "drift.mp4"
    with video.Writer(path, WIDTH, HEIGHT, 25) as writer:
        for frame in pictures():
            writer.write(frame)
    return path


class Interrupt:
    """Progress that stops the work after so many frames."""

    def __init__(self, after: int) -> None:
        self.after = after

    def update(self, done: int, total: int | None, **figures: float) -> None:
        if done == self.after:
            raise Stopped


class Quiet:
    """A reporter of the stage to interrupt, if any."""

    def __init__(self, progress=SILENT) -> None:
        self.progress = progress

    def stage(self, name: str, title: str):
        return self.progress if name == "stylize" else SILENT

    def cached(self, name: str, title: str) -> None: ...

    def finished(self, title: str, seconds: float) -> None: ...

    def note(self, sentence: str) -> None: ...


def config(style: str) -> RunConfig:
    return RunConfig(stylize=StylizeConfig(style=style))


@pytest.mark.parametrize("style", stylize.available())
def test_an_interrupted_video_is_that_of_an_uninterrupted_one(style: str, clip: Path, tmp_path: Path) -> None:
    straight, broken = tmp_path / "straight.mp4", tmp_path / "broken.mp4"
    stylize_file(clip, straight, config(style), Quiet())
    for after in (11, 12, 25):
        with pytest.raises(Stopped):
            stylize_file(clip, broken, config(style), Quiet(Interrupt(after)))
    assert len(list((tmp_path / "broken.parts").glob("*.mp4"))) == 25 // SEGMENT
    stylize_file(clip, broken, config(style), Quiet())
    assert broken.read_bytes() == straight.read_bytes()
    assert video.open_clip(broken).count() == N_FRAMES
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.mp4", "straight.mp4"]


def test_what_is_done_is_not_done_again(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out.mp4"
    with pytest.raises(Stopped):
        stylize_file(clip, out, config("ink"), Quiet(Interrupt(20)))
    drawn = []
    apply = stylize.Ink.apply

    def counted(self, frames, *rest):
        drawn.append(len(frames))
        return apply(self, frames, *rest)

    monkeypatch.setattr(stylize.Ink, "apply", counted)
    monkeypatch.setattr(stylize.Ink, "prepare", lambda *_: pytest.fail("prepared again"))
    stylize_file(clip, out, config("ink"), Quiet())
    assert sum(drawn) == N_FRAMES - 2 * SEGMENT


def test_segments_of_other_settings_are_thrown_away(clip: Path, tmp_path: Path) -> None:
    out, fresh = tmp_path / "out.mp4", tmp_path / "fresh.mp4"
    with pytest.raises(Stopped):
        stylize_file(clip, out, config("ink"), Quiet(Interrupt(20)))
    stylize_file(clip, out, config("paint"), Quiet())
    stylize_file(clip, fresh, config("paint"), Quiet())
    assert out.read_bytes() == fresh.read_bytes()


def test_a_folder_with_other_things_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("")
    with pytest.raises(InputError, match=r"holds other files \(holiday.jpg\)"):
        Segments(tmp_path, "a")


def test_without_frames_there_is_no_video(tmp_path: Path, clip: Path) -> None:
    source: Source = open_source(clip, config("none"))
    with pytest.raises(InputError, match="has no frames to write"):
        Segments(tmp_path / "parts", "a").join(tmp_path / "out.mp4", source)


def test_a_state_survives_exactly(tmp_path: Path) -> None:
    state = {
        "unit": 0.1 + 0.2,
        "levels": [1.5, 2.25],
        "has": True,
        "rule": {"box": [1, 2]},
        "codes": np.float32([[0.1, 1e-7]]),
        "double": np.float64([1 / 3]),
    }
    save_state(state, tmp_path / "state")
    loaded = load_state(tmp_path / "state")
    for name in ("codes", "double"):
        assert np.array_equal(loaded.pop(name), state.pop(name))
    assert loaded == state
    (tmp_path / "state").write_bytes(b"noise")
    with pytest.raises(InputError, match="does not hold the state"):
        load_state(tmp_path / "state")


def test_killed_without_warning(clip: Path, tmp_path: Path) -> None:
    """The process is killed as soon as its second segment stands."""
    straight, killed = tmp_path / "straight.mp4", tmp_path / "killed.mp4"
    stylize_file(clip, straight, config("toon"), Quiet())
    program = (
        "import sys, time, torch\n"
        "torch.set_num_threads(1)\n"
        "from toonifygb.cli.main import main\n"
        "from toonifygb.errors import FaceError\n"
        "from toonifygb.pipeline import create, segments, single\n"
        "def none_found(*_, **__):\n"
        "    raise FaceError('no face')\n"
        "single.face.find_landmarks = none_found\n"
        f"create.SEGMENT = segments.SEGMENT = {SEGMENT}\n"
        "write = segments.video.Writer.write\n"
        "def slowly(self, frame):\n"
        "    time.sleep(0.05)\n"
        "    write(self, frame)\n"
        "segments.video.Writer.write = slowly\n"
        "main()\n"
    )
    argv = ["stylize", str(clip), "--out", str(killed), "--style", "toon", "--quiet"]
    process = subprocess.Popen([sys.executable, "-c", program, *argv], env=dict(os.environ))
    second = tmp_path / "killed.parts" / "000001.mp4"
    deadline = time.monotonic() + 120
    while not second.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert second.exists() and not killed.exists()
    stylize_file(clip, killed, config("toon"), Quiet())
    assert killed.read_bytes() == straight.read_bytes()
