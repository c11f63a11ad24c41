"""StyleGANEX at 1/8 of its side and a fraction of its width: the same code in a fraction of a second."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from toonifygb import video
from toonifygb.config import StyleTrainConfig
from toonifygb.styletrain import encode, foundation, preview
from toonifygb.stylize.styleganex import PUBLISHED, StyleGANEX, generator, weights

SIDE = 64
WIDTH = 32
RED = (230, 60, 70)
"""Colour that all toy pictures have in common."""
TOY = StyleTrainConfig(
    resolution=SIDE,  # type: ignore[arg-type]
    aligned=True,
    generator_steps=2,
    generator_batch=2,
    encoder_steps=3,
    encoder_batch=1,
    checkpoint_seconds=0.0,
    preview_steps=100,
    device="cpu",
)


def shrink_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Generators start from a map of 8 px and give ``SIDE`` px after six levels, encoders read ``SIDE`` px."""
    monkeypatch.setattr(generator, "START_SIZE", SIDE // 8)
    monkeypatch.setattr(encode, "INPUT_SIZE", SIDE)
    monkeypatch.setitem(foundation.LEVELS, SIDE, 6)
    monkeypatch.setattr(preview, "N_FACES", 2)


def make_base(seed: int = 0) -> StyleGANEX:
    """A base network with weights by seed."""
    torch.manual_seed(seed)
    network = StyleGANEX(dataclasses.replace(PUBLISHED["inversion"], width=WIDTH))
    with torch.no_grad():
        # Fresh layers let through little of the picture; trained ones let features and codes of unit size out.
        network.encoder.featlayer.weight.mul_(8)
        for head in network.encoder.styles:
            head.linear.weight.mul_(20)  # type: ignore[union-attr]
        for layer in (network.decoder.to_rgb1, *network.decoder.to_rgbs):
            layer.conv.weight.mul_(3)  # type: ignore[union-attr]
    network.latent_avg.normal_(generator=torch.Generator().manual_seed(seed)).mul_(0.3)
    return network.requires_grad_(False)


def write_base(folder: Path) -> Path:
    path = folder / "base.safetensors"
    weights.save(make_base(), path)
    return path


def write_pictures(folder: Path, n: int = 6) -> Path:
    """Red squares, each with a spot of its own."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    for index in range(n):
        image = np.full((SIDE, SIDE, 3), RED, np.uint8)
        top, left = rng.integers(8, 40, 2)
        image[top : top + 10, left : left + 10] = rng.integers(0, 255, 3)
        video.save_png(folder / f"{index}.png", image)
    return folder


class Watcher:
    """A reporter that remembers what it is told, and may stop or break the work after some updates of a stage."""

    def __init__(self, stage: str = "", after: int = 0, error: BaseException | None = None) -> None:
        self.notes: list[str] = []
        self.updates: list[tuple[str, int]] = []
        self.figures: dict[str, float] = {}
        self._break = (stage, after, error)

    def stage(self, name: str, title: str) -> _Line:
        return _Line(self, name)

    def note(self, sentence: str) -> None:
        self.notes.append(sentence)

    def heard(self, name: str, done: int, figures: dict[str, float]) -> None:
        self.updates.append((name, done))
        self.figures |= figures
        stage, after, error = self._break
        if error is not None and name == stage and done == after:
            raise error


class _Line:
    def __init__(self, watcher: Watcher, name: str) -> None:
        self._watcher, self._name = watcher, name

    def update(self, done: int, total: int | None, **figures: float) -> None:
        self._watcher.heard(self._name, done, figures)
