"""A dataset of others becomes a run, is trained, and goes back; with a head that is FLAME but for its size."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_makers import HEIGHT, N_FRAMES, insta_folder, tiny_flame

from toonifygb import avatar, datasets, head, track, train
from toonifygb.assets import store
from toonifygb.cli.main import run
from toonifygb.geometry.cameras import project
from toonifygb.pipeline import create

SETTINGS = (
    "train.steps=30",
    "train.resolution=64",
    "train.n_gaussians=300",
    "train.n_mouth_gaussians=40",
)


@pytest.fixture
def flame(monkeypatch: pytest.MonkeyPatch) -> None:
    """A FLAME that is at hand."""
    monkeypatch.setitem(head._LOADERS, "flame", tiny_flame)
    monkeypatch.setattr(create, "MIN_FRAMES", 4)


def test_import_train_export(flame: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = insta_folder(tmp_path / "theirs", n_test=3)
    out = tmp_path / "run"
    assert run(["import", str(tmp_path / "theirs"), "--out", str(out), "--settings", *SETTINGS]) == 0
    assert f"toonifygb train {out}" in "".join(capsys.readouterr())
    sequence, crops = track.load(out / "track.safetensors"), train.load_dataset(out / "work" / "dataset")
    assert sequence.head_model == "flame" and torch.equal(sequence.shape, truth.shape)
    assert crops.split.test == (5, 6, 7) and crops.split.train == tuple(range(5))
    # The matte is the dataset's own: soft at its edge, not what a segmenter would make of a coloured hull.
    color, matte = crops.target(0)
    assert 0.1 < float(matte.mean()) < 0.9 and float(color[matte == 0].abs().max()) == 0
    assert (out / "overlay.mp4").stat().st_size > 0

    assert run(["train", str(out), "--quiet"]) == 0
    trained = avatar.load(out / "avatar")
    assert trained.head_model == "flame"
    assert trained.n_expressions == 5  # what the head model asks for; its track has 100
    assert sequence.motion.expression.shape == (N_FRAMES, 100)
    values = json.loads((out / "metrics.json").read_text())
    assert values["track_on"] == "imported" and values["landmark_error_px"] is None and values["n_test"] == 3
    assert (out / "report.html").stat().st_size > 0

    assert run(["export", str(out), "--out", str(tmp_path / "ours")]) == 0
    folder = datasets.recognize(tmp_path / "ours")
    assert folder is not None and folder.n_test == 3
    again = datasets.read_track(folder, tiny_flame()).sequence
    vertices, _ = tiny_flame().forward(again.shape, again.motion)
    # Trained on is the whole picture, as by those who made it: here the largest square of 96 x 80 px, which follows
    # the head a little and is put back to one place.
    assert (crops.boxes[:, 1] == 0).all() and (crops.boxes[:, 3] == HEIGHT).all()
    pixels = project(again.camera, vertices)[0].numpy()
    assert np.abs(pixels - (truth.pixels - crops.boxes[:, :2].min(0)) * 64 / HEIGHT).max() < 2e-3


def test_without_flame_the_way_to_it_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(store.CACHE_VARIABLE, str(tmp_path / "cache"))
    insta_folder(tmp_path / "theirs")
    assert run(["import", str(tmp_path / "theirs"), "--out", str(tmp_path / "run"), "--quiet"]) == 3
    said = capsys.readouterr().err
    assert "the model 'flame' is not in" in said
    assert "register at https://flame.is.tue.mpg.de, download generic_model.pkl" in said
    assert "toonifygb assets add flame generic_model.pkl" in said


def test_mistakes_are_one_sentence(flame: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    insta_folder(tmp_path / "theirs")
    command = ["import", str(tmp_path / "theirs"), "--out", str(tmp_path / "run"), "--quiet"]
    assert run([*command, "--style", "toon"]) == 2
    assert "overdraws eyes and chin" in capsys.readouterr().err
    assert run([*command, "--head", "flame2042"]) == 2
    assert "there is no head model 'flame2042', known are open, flame, flame2023" in capsys.readouterr().err
    pictures = tmp_path / "theirs" / "images"
    assert run(["import", str(pictures), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert "is no dataset of a kind that can be read (insta, flashavatar, tracker, vhap)" in capsys.readouterr().err
    assert run(["export", str(tmp_path / "nowhere"), "--out", str(tmp_path / "x")]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert not (tmp_path / "run").exists() and not (tmp_path / "x").exists()
