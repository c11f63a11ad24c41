"""What the two stages learn, and that a training can be interrupted anywhere."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from styletrain_toy import SIDE, TOY, WIDTH, Watcher, make_base, shrink_networks, write_base, write_pictures

from toonifygb import stylize
from toonifygb.config import StyleganexConfig
from toonifygb.errors import InputError
from toonifygb.progress import Stopped
from toonifygb.structures import Landmarks
from toonifygb.styletrain import train_style
from toonifygb.styletrain.discriminator import Discriminator
from toonifygb.styletrain.encode import Encode
from toonifygb.styletrain.foundation import codes_of, draw, student
from toonifygb.styletrain.perceptual import FeatureDistance
from toonifygb.styletrain.transfer import Transfer
from toonifygb.stylize.styleganex.frame import CropRule


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    shrink_networks(monkeypatch)


def test_the_generator_takes_on_the_pictures_colour_and_the_base_stays() -> None:
    base = make_base()
    before = copy.deepcopy(base.state_dict())
    config = dataclasses.replace(TOY, generator_batch=4, path_weight=2.0)
    pale = torch.tensor((245, 250, 240), dtype=torch.uint8)[:, None, None]
    stage = Transfer(base, Discriminator(SIDE, WIDTH), pale.expand(6, 3, SIDE, SIDE).contiguous(), config)
    codes = codes_of(base.decoder, torch.randn(8, 512 // WIDTH), base.latent_avg)
    goal = pale / 127.5 - 1

    def distance() -> float:
        with torch.no_grad():
            return float((draw(stage.average, codes, levels=6).mean((0, 2, 3)) - goal[:, 0, 0]).abs().mean())

    first = distance()
    figures = [stage.step(step) for step in range(12)]
    assert distance() < 0.7 * first
    assert figures[-1].keys() == {"loss_d", "loss_g", "ada"}
    assert all(torch.equal(value, before[key]) for key, value in base.state_dict().items())
    mapping = stage.generator.style.state_dict()
    assert all(torch.equal(value, mapping[key]) for key, value in base.decoder.style.state_dict().items())


def test_the_encoder_learns_the_pairs_and_the_generator_stays() -> None:
    base, style = make_base(), make_base(1)
    network = student(base, style.decoder, 0)
    discriminator = Discriminator(SIDE, WIDTH)
    config = dataclasses.replace(TOY, encoder_steps=16, encoder_batch=2, encoder_rate=3e-3)
    stage = Encode(base, network, discriminator, FeatureDistance(copy.deepcopy(discriminator)), config)
    decoder = copy.deepcopy(network.decoder.state_dict())
    pairs = stage.pair(6, 1.0)

    def error() -> float:
        with torch.no_grad():
            return float((network(pairs.x, levels=6) - pairs.y).square().mean())

    first, seen = error(), set()
    for step in range(16):
        figures = stage.step(step)
        seen |= {step} if "flicker" in figures else set()
    assert error() < 0.8 * first
    assert seen == set(range(9, 16)), "the flicker term belongs to the second half"
    assert all(torch.equal(value, decoder[key]) for key, value in network.decoder.state_dict().items())


def test_interrupted_twice_equals_uninterrupted(tmp_path: Path) -> None:
    """Stopped in the first stage, killed between two checkpoints of the second: the style has the same bits."""
    pictures, base = write_pictures(tmp_path / "pictures"), str(write_base(tmp_path))
    whole, broken = tmp_path / "whole.safetensors", tmp_path / "broken.safetensors"
    watcher = Watcher()
    train_style(pictures, base, whole, TOY, watcher)
    assert watcher.updates[-5:] == [("generator", 1), ("generator", 2), *[("encoder", n) for n in (1, 2, 3)]]
    assert {"ada", "l2", "perceptual", "flicker"} <= watcher.figures.keys()
    assert any("features of the first stage's discriminator" in note for note in watcher.notes)

    with pytest.raises(Stopped):
        seldom = dataclasses.replace(TOY, checkpoint_seconds=1e9)
        train_style(pictures, base, broken, seldom, Watcher("generator", 1, Stopped()))
    with pytest.raises(OSError, match="power"):
        train_style(pictures, base, broken, TOY, Watcher("encoder", 2, OSError("power")))
    assert not broken.exists()
    again = Watcher()
    train_style(pictures, base, broken, TOY, again)
    assert again.updates == [("encoder", 3)], "what was done is not done again"
    one, two = load_file(whole), load_file(broken)
    assert one.keys() == two.keys()
    assert all(torch.equal(one[key], two[key]) for key in one)
    previews = {path.name for path in (tmp_path / "broken.training" / "previews").iterdir()}
    names = [f"{stem}{suffix}" for stem in ("generator-000002", "encoder-000003") for suffix in (".png", ".json")]
    assert previews == set(names)

    _stylises_a_clip(whole)
    with pytest.raises(InputError, match="another base or other settings"):
        train_style(pictures, base, whole, dataclasses.replace(TOY, seed=1), Watcher())


def _stylises_a_clip(style_file: Path) -> None:
    """The trained style draws other frames than they were, of the source's size or of the network's own."""
    assert stylize.files(str(style_file)) == (style_file,)
    rng = np.random.default_rng(1)
    frames = list(rng.integers(0, 255, (2, 72, 96, 3), dtype=np.uint8))
    points = torch.from_numpy(rng.normal((48, 36), 12, (478, 2)).astype(np.float32)).expand(2, -1, -1)
    marks = Landmarks(points.clone(), torch.ones(2), 96, 72)
    for size in ("source", "super"):
        style = stylize.get(str(style_file), StyleganexConfig(size=size))
        state = stylize.prepare(iter(frames), marks, style)
        drawn = list(stylize.stylize_frames(iter(frames), marks, style, state))
        if size == "source":
            assert [frame.shape for frame in drawn] == [(72, 96, 3)] * 2
            assert np.abs(drawn[0].astype(int) - frames[0]).max() > 20
        else:
            height, width = CropRule.from_state(state["rule"]).size
            assert [frame.shape for frame in drawn] == [(height, width, 3)] * 2, "six levels, as trained, not 4x"
            assert len(np.unique(drawn[0])) > 20


def test_a_diverged_training_is_not_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Transfer, "step", lambda self, step: {"loss_g": float("nan") if step else 0.5})
    pictures, base = write_pictures(tmp_path / "pictures"), str(write_base(tmp_path))
    out = tmp_path / "style.safetensors"
    with pytest.raises(InputError, match="failed in step 2: the losses are no numbers"):
        train_style(pictures, base, out, TOY, Watcher())
    _, notes = _checkpoint(tmp_path / "style.training" / "generator.safetensors")
    assert '"step": 1' in notes


def _checkpoint(path: Path) -> tuple[list[str], str]:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        return list(file.keys()), file.metadata()["notes"]


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    pictures, base = write_pictures(tmp_path / "pictures"), str(write_base(tmp_path))
    folder = tmp_path / "style.training"
    folder.mkdir()
    (folder / "generator.safetensors").write_bytes(b"\x00" * 100)
    with pytest.raises(InputError, match="is damaged"):
        train_style(pictures, base, tmp_path / "style.safetensors", TOY, Watcher())
