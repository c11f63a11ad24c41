"""A run's stages: done once, done again when an input changes, whole or absent when interrupted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from toonifygb.config import StylizeConfig
from toonifygb.errors import InputError
from toonifygb.pipeline.stages import STATE_FILE, Run, fingerprint
from toonifygb.progress import SILENT, Progress, Stopped


class Watcher:
    """A reporter that remembers."""

    def __init__(self) -> None:
        self.worked: list[str] = []
        self.reused: list[str] = []
        self.notes: list[str] = []

    def stage(self, name: str, title: str) -> Progress:
        self.worked.append(name)
        return SILENT

    def cached(self, name: str, title: str) -> None:
        self.reused.append(name)

    def finished(self, title: str, seconds: float) -> None: ...

    def note(self, sentence: str) -> None:
        self.notes.append(sentence)


def write_stage(run: Run, name: str, value: int, text: str = "x") -> str:
    out = run.file(f"{name}.txt")

    def work(progress: Progress) -> None:
        out.write_text(text)

    return run.stage(name, name, inputs=[value], outputs=[out], work=work)


def test_a_finished_stage_is_not_done_again(tmp_path: Path) -> None:
    watcher = Watcher()
    for _ in range(2):
        with Run(tmp_path / "run", watcher) as run:
            write_stage(run, "one", 1)
    assert watcher.worked == ["one"]
    assert watcher.reused == ["one"]


def test_a_changed_input_or_a_missing_output_does_it_again(tmp_path: Path) -> None:
    watcher = Watcher()
    with Run(tmp_path / "run", watcher) as run:
        write_stage(run, "one", 1)
        write_stage(run, "one", 2)
        run.file("one.txt").unlink()
        write_stage(run, "one", 2)
    assert watcher.worked == ["one", "one", "one"]


def test_an_interrupted_stage_is_not_taken_for_finished(tmp_path: Path) -> None:
    watcher = Watcher()
    out = tmp_path / "run" / "half.txt"

    def stopped(progress: Progress) -> None:
        out.write_text("half")
        raise Stopped

    with pytest.raises(Stopped), Run(tmp_path / "run", watcher) as run:
        run.stage("half", "half", inputs=[1], outputs=[out], work=stopped)
    with Run(tmp_path / "run", watcher) as run:
        write_stage(run, "half", 1, "whole")
    assert out.read_text() == "whole"
    assert watcher.reused == []


def test_seconds_add_up_over_an_interruption(tmp_path: Path) -> None:
    def stopped(progress: Progress) -> None:
        raise Stopped

    with pytest.raises(Stopped), Run(tmp_path / "run", Watcher()) as run:
        run.stage("one", "one", inputs=[1], outputs=[run.file("one.txt")], work=stopped)
    state_path = tmp_path / "run" / STATE_FILE
    state = json.loads(state_path.read_text())
    state["stages"]["one"]["seconds"] = 100.0
    state_path.write_text(json.dumps(state))
    with Run(tmp_path / "run", Watcher()) as run:
        write_stage(run, "one", 1)
        assert run.seconds()["one"] >= 100.0


def test_fingerprints_tell_settings_apart() -> None:
    assert fingerprint(StylizeConfig("toon")) == fingerprint(StylizeConfig("toon"))
    assert fingerprint(StylizeConfig("toon")) != fingerprint(StylizeConfig("ink"))


def test_two_processes_may_not_share_a_run(tmp_path: Path) -> None:
    with Run(tmp_path / "run", Watcher()):
        with pytest.raises(InputError, match="another process is working"), Run(tmp_path / "run", Watcher()):
            pass
    with Run(tmp_path / "run", Watcher()):
        pass


def test_a_folder_with_other_things_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("")
    with pytest.raises(InputError, match="is not a run of toonifygb"), Run(tmp_path, Watcher()):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == ["holiday.jpg"]


def test_an_output_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(InputError, match="cannot be written"), Run(blocker / "run", Watcher()):
        pass


def test_problems_are_said_once_and_kept(tmp_path: Path) -> None:
    watcher = Watcher()
    for _ in range(2):
        with Run(tmp_path / "run", watcher) as run:
            run.problems("face", ["lost for a while"])
            run.save()
    assert watcher.notes == ["lost for a while"]
    assert json.loads((tmp_path / "run" / STATE_FILE).read_text())["problems"] == {"face": ["lost for a while"]}
