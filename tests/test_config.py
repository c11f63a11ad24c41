"""Settings: presets, overrides by name, JSON there and back."""

from __future__ import annotations

import pytest

from toonifygb.config import PRESETS, for_quality, from_json, override, to_json
from toonifygb.errors import InputError


@pytest.mark.parametrize("quality", list(PRESETS))
def test_json_round_trip(quality: str) -> None:
    config = for_quality(quality)  # type: ignore[arg-type]
    assert from_json(to_json(config)) == config


def test_override_changes_one_setting() -> None:
    config = override(for_quality("draft"), "train.steps=7")
    assert config.train.steps == 7
    assert config.train.resolution == PRESETS["draft"].resolution
    assert override(config, "train.l1_weight=1").train.l1_weight == 1.0
    assert override(config, "max_frames=null").max_frames is None
    assert override(config, "stylize.style=ink").stylize.style == "ink"


@pytest.mark.parametrize(
    ("assignment", "sentence"),
    [
        ("train.step=7", "nearest: train.steps"),
        ("train.steps", "nearest: train.steps"),
        ("train.steps=many", "expected int"),
        ("train.steps=1.5", "expected int"),
        ("train.loss=mse", "expected one of 3dgb, seed"),
        ("max_frames=x", "expected int or null"),
        ("train.test_parts=0", "expected 1 or more"),
        ("train.dropout=1", "expected 0 or more, and less than 1"),
        ("train.dropout=-0.1", "expected 0 or more, and less than 1"),
    ],
)
def test_bad_settings_are_said_in_one_sentence(assignment: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as caught:
        override(for_quality("draft"), assignment)
    assert caught.value.exit_code == 2


def test_paper_preset_is_the_paper() -> None:
    paper = PRESETS["paper"]
    assert (paper.n_gaussians, paper.n_mouth_gaussians) == (50_000, 14_000)
    assert (paper.resolution, paper.steps) == (512, 40_000)
