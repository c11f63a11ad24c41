"""The convolutions that were tried and left out compute what they stand in for: else their times mean nothing."""

from __future__ import annotations

import pytest
import torch

from benchmarks.styleganex_tried import Int8Conv, WinogradConv
from toonifygb.stylize.styleganex.folded import FixedConv


def layer(padding: int = 1, slope: float | None = 0.2) -> FixedConv:
    """A convolution from 12 to 16 channels."""
    rng = torch.Generator().manual_seed(0)
    weight = torch.randn(16, 12, 3, 3, generator=rng) / 108**0.5
    return FixedConv(weight, torch.randn(16, generator=rng), padding=padding, slope=slope)


@pytest.mark.parametrize("padding", [0, 1])
@pytest.mark.parametrize("size", [(16, 20), (13, 11), (3, 30)])
def test_winograds_convolution_is_the_convolution(size: tuple[int, int], padding: int) -> None:
    conv, x = layer(padding), torch.randn(2, 12, *size, generator=torch.Generator().manual_seed(1))
    assert torch.allclose(WinogradConv(conv)(x), conv(x), atol=1e-4)


def test_int8_is_within_its_steps() -> None:
    conv, x = layer(slope=None), torch.randn(1, 12, 24, 18, generator=torch.Generator().manual_seed(1))
    error = (Int8Conv(conv)(x) - conv(x)).square().mean() / conv(x).square().mean()
    assert 1e-6 < error < 3e-4
