"""The warping error: nothing for what merely moves, more for what boils."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from toonifygb import stylize
from toonifygb.errors import InputError
from toonifygb.stylize.steadiness import visible


def moving(n_frames: int, step: int = 2) -> list[np.ndarray]:
    """A textured picture that moves to the right by whole pixels."""
    random = np.random.default_rng(2)
    wide = cv2.GaussianBlur(random.integers(0, 256, (96, 200, 3)).astype(np.float32), (0, 0), 3)
    wide = ((wide - wide.min()) / (wide.max() - wide.min()) * 255).astype(np.uint8)
    return [np.ascontiguousarray(wide[:, 60 - step * i : 180 - step * i]) for i in range(n_frames)]


def test_motion_costs_nothing() -> None:
    frames = moving(4)
    inverted = [255 - frame for frame in frames]
    plain = np.mean([np.abs(a.astype(float) - b).mean() / 255 for a, b in pairwise(frames)])
    assert stylize.warping_error(frames, inverted) < 0.1 * plain
    assert stylize.warping_error([frames[0]] * 3, [frames[1]] * 3) == 0.0


def test_boiling_is_measured() -> None:
    frames, random = moving(4), np.random.default_rng(0)
    errors = []
    for amount in (0.0, 4.0, 12.0):
        noisy = [np.clip(f + random.normal(0, amount, f.shape), 0, 255).astype(np.uint8) for f in frames]
        errors.append(stylize.warping_error(frames, noisy))
    assert errors[0] < 0.5 * errors[1] < 0.25 * errors[2]
    # the mean absolute difference of two normal noises is 2/sqrt(pi) of their deviation; sub-pixel look-up calms it
    assert 0.6 < errors[2] / (12.0 * 2 / np.sqrt(np.pi) / 255) < 1.05


def test_the_motion_is_that_of_the_source() -> None:
    """A drawing that stays while the person moves is as wrong as one that moves while the person stays."""
    frames = moving(3, step=4)
    assert stylize.warping_error(frames, [frames[0]] * 3) > 0.02
    assert stylize.warping_error([frames[0]] * 3, frames) > 0.02


def test_what_is_hidden_does_not_count() -> None:
    there = np.zeros((40, 60, 2), np.float32)
    back = np.zeros_like(there)
    there[:, :20, 0] = -3.0  # leaves the picture, or lands on something that did not come from there
    back[:, 30:40, 0] = 5.0
    seen = visible(there, back)
    assert not seen[:, :20].any()
    assert not seen[:, 30:40].any()
    assert seen[:, 20:30].all() and seen[:, 40:].all()


def test_size_and_length() -> None:
    frames = moving(3)
    large = [cv2.resize(frame, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC) for frame in frames]
    small, enlarged = stylize.warping_error(frames, frames), stylize.warping_error(frames, large)
    assert enlarged == pytest.approx(small, abs=2e-3)
    with pytest.raises(InputError, match="at least 2"):
        stylize.warping_error(frames[:1], frames[:1])
