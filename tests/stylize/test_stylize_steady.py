"""Styles hold still: no boiling on noise, no popping of bands."""

from __future__ import annotations

import numpy as np
import pytest
import stylize_scene as scene

from toonifygb import stylize
from toonifygb.metrics import itf


def styled(name: str, clip: list[np.ndarray], marks) -> list[np.ndarray]:
    style = stylize.get(name)
    return list(stylize.stylize_frames(iter(clip), marks, style, stylize.prepare(iter(clip), marks, style)))


@pytest.mark.parametrize("name", ["toon", "paint", "ink"])
def test_noise_on_a_still_picture_does_not_boil(name: str) -> None:
    clip, marks = scene.frames(6, 256, 224, noise=3.0), scene.landmarks(6, 256, 224)
    assert itf(styled(name, clip, marks)) > itf(clip) + 3.0  # half the noise energy at most


@pytest.mark.parametrize("name", ["toon", "paint", "ink"])
def test_a_slow_pan_changes_no_more_than_its_source(name: str) -> None:
    """Against the same pan without noise, whose changes are the motion itself."""
    clip = scene.frames(6, 256, 224, shift_px=0.7, noise=3.0)
    clean = scene.frames(6, 256, 224, shift_px=0.7)
    marks = scene.landmarks(6, 256, 224, shift_px=0.7)
    noisy, quiet = styled(name, clip, marks), styled(name, clean, marks)
    drop_styled = itf(quiet) - itf(noisy)
    drop_source = itf(clean) - itf(clip)
    assert drop_styled < 0.6 * drop_source


def test_a_slow_change_of_light_moves_bands_softly() -> None:
    """Brightening by 1/255 per frame never moves a pixel by more than a soft band edge allows."""
    base = scene.frames(1, 256, 224)[0].astype(int)
    clip = [np.clip(base + step, 0, 255).astype(np.uint8) for step in range(6)]
    out = styled("toon", clip, scene.landmarks(6, 256, 224))
    steps = np.abs(np.diff(np.stack(out).astype(int), axis=0)).max(-1)
    assert np.quantile(steps, 0.99) <= 12
