"""``toonifygb assets`` from the command line, up to a converted network that can be loaded."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest
import torch

from toonifygb.assets import store
from toonifygb.cli.main import run
from toonifygb.stylize.styleganex import PUBLISHED, StyleGANEX, weights

NAME = "styleganex-arcane"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and nobody at the terminal."""
    monkeypatch.setenv(store.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    return tmp_path / "cache"


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A file as the authors write it, of a narrow network."""
    network = StyleGANEX(dataclasses.replace(PUBLISHED["toonify"], width=32))
    path = tmp_path / "download.pt"
    entries = {"state_dict": network.state_dict(), "opts": {"use_skip": True}, "latent_avg": torch.ones(18, 16)}
    torch.save(entries, path)
    return path


def test_add_list_verify(checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["assets", "add", NAME, str(checkpoint), "--accept-license"]) == 0
    said = capsys.readouterr()
    assert "S-Lab License 1.0" in said.err and "NON-COMMERCIAL" in said.err and "Please cite" in said.err
    network = weights.load(store.model_path(NAME))
    assert network.variant.n_fusion == 7 and torch.equal(network.latent_avg, torch.ones(18, 16))

    assert run(["assets", "verify"]) == 0
    assert f"{NAME}: unchanged" in capsys.readouterr().out
    assert run(["assets", "list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.startswith("  style")}
    assert "GB here" in lines[NAME] and "not added" in lines["styleganex-pixar"]

    assert run(["assets", "add", NAME, str(checkpoint), "--quiet"]) == 0  # the licence is asked for once
    assert capsys.readouterr() == ("", "")


def test_without_consent_nothing_is_done(cache: Path, checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["get", NAME], ["add", NAME, str(checkpoint)]):
        assert run(["assets", *arguments]) == 3
        assert "was not accepted" in capsys.readouterr().err
    assert not cache.exists()


def test_a_person_can_agree_at_the_terminal(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Keyboard:
        def __init__(self, answer: str) -> None:
            self.readline = lambda: answer

        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stdin", Keyboard("no\n"))
    assert run(["assets", "add", NAME, str(checkpoint)]) == 3
    monkeypatch.setattr(sys, "stdin", Keyboard("yes\n"))
    assert run(["assets", "add", NAME, str(checkpoint)]) == 0


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["get"], 2, "'assets get' takes NAME"),
        (["add", NAME], 2, "'assets add' takes NAME FILE"),
        (["get", "styleganex-comic"], 2, "model 'styleganex-comic' does not exist"),
        (["verify", NAME], 3, f"the model '{NAME}' is not in"),
        (["add", NAME, "absent.pt", "--accept-license"], 3, "absent.pt does not exist"),
    ],
)
def test_mistakes_are_one_sentence(
    arguments: list[str], code: int, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["assets", *arguments]) == code
    assert sentence in capsys.readouterr().err


def test_a_hostile_file_is_refused(tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save({"state_dict": {}, "opts": Path("x")}, tmp_path / "evil.pt")
    assert run(["assets", "add", NAME, str(tmp_path / "evil.pt"), "--accept-license"]) == 3
    assert "nothing of it was run" in capsys.readouterr().err
    assert [path.name for path in cache.rglob("*") if path.is_file()] == ["licenses.json"]
