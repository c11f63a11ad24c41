"""Bad input: one clear sentence, the right exit code, nothing half-written.

The sentences are an interface: ``messages.json`` pins them. After a deliberate change run
``TOONIFYGB_UPDATE_MESSAGES=1 pytest tests/cli`` and read the difference.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from toonifygb import video
from toonifygb.cli.main import run

MESSAGES = Path(__file__).with_name("messages.json")


def pattern(size: tuple[int, int], seed: int) -> np.ndarray:
    """A picture without a face."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (6, 8, 3), np.uint8)
    return cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)


def write_clip(path: Path, n_frames: int, first_seed: int = 0) -> Path:
    with video.Writer(path, 128, 96, 25) as writer:
        for index in range(n_frames):
            writer.write(pattern((128, 96), first_seed + index))
    return path


def no_such_file(folder: Path) -> list[str]:
    return ["create", str(folder / "absent.mp4"), "--out", str(folder / "run")]


def no_bases(folder: Path) -> list[str]:
    clip = write_clip(folder / "clip.mp4", 2)
    return ["create", str(clip), "--out", str(folder / "run"), "--blendshapes", "reduced", "--n-bases", "0"]


def too_many_bases(folder: Path) -> list[str]:
    clip = write_clip(folder / "clip.mp4", 2)
    return ["create", str(clip), "--out", str(folder / "run"), "--blendshapes", "reduced", "--n-bases", "60"]


def unknown_blendshapes(folder: Path) -> list[str]:
    clip = write_clip(folder / "clip.mp4", 2)
    return ["create", str(clip), "--out", str(folder / "run"), "--settings", "train.blendshapes=few"]


def not_a_video(folder: Path) -> list[str]:
    path = folder / "notes.mp4"
    path.write_text("milk, bread, apples")
    return ["create", str(path), "--out", str(folder / "run")]


def empty_file(folder: Path) -> list[str]:
    path = folder / "empty.mp4"
    path.touch()
    return ["create", str(path), "--out", str(folder / "run")]


def folder_without_images(folder: Path) -> list[str]:
    path = folder / "frames"
    path.mkdir()
    return ["create", str(path), "--out", str(folder / "run")]


def unknown_style(folder: Path) -> list[str]:
    return ["create", str(write_clip(folder / "clip.mp4", 2)), "--out", str(folder / "run"), "--style", "tooon"]


def no_face(folder: Path) -> list[str]:
    return [
        "create",
        str(write_clip(folder / "clip.mp4", 6, first_seed=20)),
        "--out",
        str(folder / "run"),
        "--quiet",
    ]


def unknown_setting(folder: Path) -> list[str]:
    clip = write_clip(folder / "clip.mp4", 2)
    return ["create", str(clip), "--out", str(folder / "run"), "--settings", "train.stepz=4"]


def unknown_command(folder: Path) -> list[str]:
    return ["craete"]


def output_is_a_file(folder: Path) -> list[str]:
    (folder / "run").write_text("")
    return ["create", str(write_clip(folder / "clip.mp4", 2)), "--out", str(folder / "run")]


def output_holds_other_things(folder: Path) -> list[str]:
    (folder / "run").mkdir()
    (folder / "run" / "holiday.jpg").touch()
    return ["create", str(write_clip(folder / "clip.mp4", 2)), "--out", str(folder / "run")]


def stylized_is_not_mp4(folder: Path) -> list[str]:
    return ["stylize", str(write_clip(folder / "clip.mp4", 2)), "--out", str(folder / "clip.avi")]


def avatar_is_absent(folder: Path) -> list[str]:
    return ["render", str(folder / "nobody"), "--out", str(folder / "x.png")]


def run_is_absent(folder: Path) -> list[str]:
    return ["train", str(folder / "nowhere")]


def style_of_three_pictures(folder: Path) -> list[str]:
    (folder / "drawings").mkdir()
    for index in range(3):
        video.save_png(folder / "drawings" / f"{index}.png", pattern((64, 64), index))
    style = str(folder / "style.safetensors")
    return ["style", "train", "--images", str(folder / "drawings"), "--base", "nothing.pt", "--out", style]


def style_from_nowhere(folder: Path) -> list[str]:
    arguments = style_of_three_pictures(folder)
    for index in range(3, 6):
        video.save_png(folder / "drawings" / f"{index}.png", pattern((64, 64), index))
    return arguments


CASES: dict[str, Callable[[Path], list[str]]] = {
    case.__name__: case
    for case in (
        no_such_file,
        not_a_video,
        empty_file,
        folder_without_images,
        unknown_style,
        no_face,
        unknown_setting,
        no_bases,
        too_many_bases,
        unknown_blendshapes,
        unknown_command,
        output_is_a_file,
        output_holds_other_things,
        stylized_is_not_mp4,
        avatar_is_absent,
        run_is_absent,
        style_of_three_pictures,
        style_from_nowhere,
    )
}


@pytest.mark.parametrize("name", list(CASES))
def test_message(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = CASES[name](tmp_path)
    before = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    code = run(argv)
    lines = capsys.readouterr().err.replace(str(tmp_path), "DIR").splitlines()
    said = [re.sub(r"\s+", " ", line).strip() for line in lines if line.startswith(("error:", "  hint:"))]
    found = {"exit_code": code, "text": said}
    known = json.loads(MESSAGES.read_text()) if MESSAGES.exists() else {}
    if os.environ.get("TOONIFYGB_UPDATE_MESSAGES"):
        MESSAGES.write_text(json.dumps({**known, name: found}, indent=1, sort_keys=True, ensure_ascii=False) + "\n")
    else:
        assert found == known[name]
    assert code != 0
    assert sorted(path for path in tmp_path.rglob("*") if path.is_file()) == before, "something was left behind"


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    text = capsys.readouterr().out
    for name in ("create", "demo", "stylize", "track", "train", "render", "import", "export", "doctor"):
        assert f"  {name} " in text


def test_a_full_disk_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import errno

    from toonifygb.pipeline import stages

    def full(path: Path, value: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(stages, "write_json", full)
    clip = write_clip(tmp_path / "clip.mp4", 2)
    assert run(["create", str(clip), "--out", str(tmp_path / "run")]) == 2
    assert "the disk is full" in capsys.readouterr().err
