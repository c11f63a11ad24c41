"""``--settings`` says the same however often it is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from toonifygb.cli import main
from toonifygb.cli.main import run


@pytest.mark.parametrize(
    "argv",
    [
        ["clip.mp4", "--settings", "a=1", "b=2", "--quiet"],
        ["clip.mp4", "--settings", "a=1", "--quiet", "--settings", "b=2"],
        ["clip.mp4", "--settings=a=1", "--out", "x", "--settings", "b=2", "--quiet"],
        ["--quiet", "clip.mp4", "--settings=a=1", "--settings=b=2"],
    ],
)
def test_all_settings_count(monkeypatch: pytest.MonkeyPatch, argv: list[str]) -> None:
    seen = []

    def command(
        clip: Path, /, out: Path | None = None, settings: tuple[str, ...] = (), quiet: bool = False
    ) -> None:
        seen.append((clip, out, settings, quiet))

    monkeypatch.setitem(main.COMMANDS, "create", command)
    assert run(["create", *argv]) == 0
    out = Path("x") if "--out" in argv else None
    assert seen == [(Path("clip.mp4"), out, ("a=1", "b=2"), True)]


def test_the_rest_of_a_line_is_left_alone() -> None:
    argv = ["clip.mp4", "--expression", "smile=1", "--yaw", "-25"]
    assert main._gathered(argv) == argv
