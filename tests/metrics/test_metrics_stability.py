"""ITF and ISI: means over consecutive frames, streamed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from toonifygb.errors import InputError
from toonifygb.metrics import isi, itf, psnr, ssim, stability
from toonifygb.metrics.similarity import PSNR_CAP

if TYPE_CHECKING:
    from collections.abc import Iterator


def clip() -> torch.Tensor:
    return torch.rand(5, 16, 20, 3, dtype=torch.float64)


def test_they_are_means_over_consecutive_pairs():
    frames = clip()
    assert itf(frames) == pytest.approx(float(psnr(frames[:-1], frames[1:]).mean()))
    assert isi(frames) == pytest.approx(float(ssim(frames[:-1], frames[1:]).mean()))


def test_both_in_one_pass_from_a_generator():
    frames = clip()

    def once() -> Iterator[torch.Tensor]:
        yield from frames

    both = stability(once())
    assert both.itf == pytest.approx(itf(frames)) and both.isi == pytest.approx(isi(frames))


def test_still_clip_is_perfectly_steady():
    frames = [np.full((16, 16, 3), 80, np.uint8)] * 4
    assert itf(frames) == PSNR_CAP and isi(frames) == pytest.approx(1.0)


def test_bytes_and_floats_agree():
    frames = (clip().numpy() * 255).astype(np.uint8)
    as_float = torch.from_numpy(frames).double() / 255
    assert itf(frames) == pytest.approx(itf(as_float), abs=1e-4)
    assert isi(frames) == pytest.approx(isi(as_float), abs=1e-5)


def test_mirrored_views_are_accepted():
    frames = (clip().numpy() * 255).astype(np.uint8)
    assert itf(frames[:, :, ::-1]) == pytest.approx(itf(frames))


def test_flicker_lowers_both():
    frames = torch.full((6, 16, 16, 3), 0.5) + 0.1 * torch.rand(16, 16, 3)
    flicker = frames.clone()
    flicker[1::2] += 0.1 * torch.rand(16, 16, 3)
    assert itf(flicker) < itf(frames) and isi(flicker) < isi(frames)


@pytest.mark.parametrize("n", [0, 1])
def test_too_short_a_clip_is_one_sentence(n: int):
    for metric in (itf, isi, stability):
        with pytest.raises(InputError, match="at least 2 frames"):
            metric([np.zeros((8, 8, 3), np.uint8)] * n)
