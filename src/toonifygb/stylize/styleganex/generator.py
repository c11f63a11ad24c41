"""The decoder: StyleGAN2 for 1024 px whose levels of 4, 8 and 16 px run at 1/8 of the input's size.

========  ============  ===================  ===========  ============
level     layers        kinds                size         channels
========  ============  ===================  ===========  ============
(stem)    conv1         same, dilation 8     H/8          512
0 (8)     convs 0, 1    simulated 8, same 4  H/8          512
1 (16)    convs 2, 3    simulated 4, same 2  H/8          512
2 (32)    convs 4, 5    simulated 2, same 1  H/8          512
3 (64)    convs 6, 7    double, same         H/4          512
4 (128)   convs 8, 9    double, same         H/2          256
5 (256)   convs 10, 11  double, same         H            128
6 (512)   convs 12, 13  double, same         2H           64
7 (1024)  convs 14, 15  double, same         4H           32
========  ============  ===================  ===========  ============

Each level ends in a ``ToRGB`` that adds to the image so far, so an image can be taken after any of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toonifygb.errors import InputError
from toonifygb.stylize.styleganex.layers import EqualLinear, PixelNorm, StyledConv, ToRGB
from toonifygb.stylize.styleganex.variants import STYLE_WIDTH

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float

    from toonifygb.stylize.styleganex.layers import Kind, Noise
    from toonifygb.stylize.styleganex.variants import Variant

    Fuse = Callable[[int, Tensor, Tensor], tuple[Tensor, Tensor]]

N_LEVELS = 8
FIRST_DOUBLING = 3
"""Levels before this one are simulated at H/8."""
LEVEL_CHANNELS = (512, 512, 512, 512, 256, 128, 64, 32)
STEM_DILATION = 8
MAPPING_LAYERS = 8
MAPPING_RATE = 0.01
START_SIZE = 32
"""Side of the map that replaces the first-layer feature where there is none: 1024 px / 32."""


def level_kind(level: int) -> tuple[Kind, int, int]:
    """Kind of a level's first convolution, its dilation, and the dilation of the second."""
    dilations = max(1, 32 // 2 ** (level + 2)), max(1, 32 // 2 ** (level + 3))
    return ("simulated" if level < FIRST_DOUBLING else "double", *dilations)


def scale_of(levels: int) -> int:
    """Output pixels per input pixel after so many levels: 8 → 4, 7 → 2, 6 → 1.

    Raises:
        InputError: another number of levels.
    """
    if levels not in (6, 7, 8):
        raise InputError(f"the decoder cannot stop after {levels} levels; expected 6 (1x), 7 (2x) or 8 (4x)")
    return 2 ** (levels - 6)


class Constant(nn.Module):
    """The learnt 4x4 map at which StyleGAN2 starts when no image is given."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.input = nn.Parameter(torch.randn(1, channels, 4, 4))


class NoiseMaps(nn.Module):
    """Stored noise: ``noise_0`` of 4 px, then two maps each of 8, 16, … 1024 px."""

    def __init__(self) -> None:
        super().__init__()
        for index in range(1 + 2 * N_LEVELS):
            side = 4 * 2 ** ((index + 1) // 2)
            self.register_buffer(f"noise_{index}", torch.randn(1, 1, side, side))

    def __getitem__(self, index: int) -> Float[Tensor, "1 1 s s"]:
        return self.get_buffer(f"noise_{index}")


class Generator(nn.Module):
    """w+ and a first-layer feature to an image."""

    def __init__(self, variant: Variant) -> None:
        super().__init__()
        code = variant.channels(STYLE_WIDTH)
        mapping = [EqualLinear(code, code, rate=MAPPING_RATE, activate=True) for _ in range(MAPPING_LAYERS)]
        self.style = nn.Sequential(PixelNorm(), *mapping)
        channels = variant.channels(LEVEL_CHANNELS[0])
        self.input = Constant(channels)
        self.conv1 = StyledConv(channels, channels, code, dilation=STEM_DILATION)
        self.to_rgb1 = ToRGB(channels, code)
        self.convs, self.to_rgbs = nn.ModuleList(), nn.ModuleList()
        for level, published in enumerate(LEVEL_CHANNELS):
            kind, first, second = level_kind(level)
            before, channels = channels, variant.channels(published)
            self.convs.append(StyledConv(before, channels, code, kind=kind, dilation=first))
            self.convs.append(StyledConv(channels, channels, code, dilation=second))
            self.to_rgbs.append(ToRGB(channels, code, kind=kind, dilation=first))
        self.noises = NoiseMaps()

    def start(self, n: int) -> Float[Tensor, "n 512 32 32"]:
        """The map that replaces the first-layer feature for images from style codes alone."""
        return F.adaptive_avg_pool2d(self.input.input, START_SIZE).expand(n, -1, -1, -1)

    def forward(
        self,
        feature: Float[Tensor, "n 512 h8 w8"],
        w_plus: Float[Tensor, "n 18 512"],
        fuse: Fuse,
        *,
        noise: Noise = "zero",
        levels: int = N_LEVELS,
    ) -> Float[Tensor, "n 3 h w"]:
        """The image, from about -1 to 1 and not clamped.

        Code 0 goes to the stem; codes 1+2j and 2+2j to the convolutions of level j; 3+2j to its ``ToRGB`` and again
        to the first convolution of the next level.

        Args:
            feature: first-layer feature.
            w_plus: style codes.
            fuse: (level, features, image) → what the level shall begin with.
            noise: which noise layers add.
            levels: how many to run: 8 (4x the network's input), 7 (2x) or 6 (1x).
        """
        scale_of(levels)
        codes = w_plus.unbind(1)
        out = self.conv1(feature, codes[0], noise, self.noises[0])
        rgb = self.to_rgb1(out, codes[1])
        for level in range(levels):
            first = 1 + 2 * level
            out, rgb = fuse(level, out, rgb)
            out = self.convs[2 * level](out, codes[first], noise, self.noises[first])
            out = self.convs[2 * level + 1](out, codes[first + 1], noise, self.noises[first + 1])
            rgb = self.to_rgbs[level](out, codes[first + 2], rgb)
        return rgb
