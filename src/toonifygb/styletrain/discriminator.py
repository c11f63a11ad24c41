"""The discriminator of StyleGAN2 (Karras et al. 2020, configuration F): which pictures look like the style's?

A residual network from the full size down to 4 px. Tensors are named as in the PyTorch version of StyleGAN2 that
StyleGANEX builds on, so that a discriminator stored beside a base network can be gone on with.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toonifygb.stylize.styleganex.layers import SLOPE, EqualLinear, filter_channels, fir_kernel

if TYPE_CHECKING:
    from jaxtyping import Float

CHANNELS = {4: 512, 8: 512, 16: 512, 32: 512, 64: 512, 128: 256, 256: 128, 512: 64, 1024: 32}
"""Published channel counts by the side of the map."""
GROUP = 4
"""Images over which the spread of features is measured at the end."""


class EqualConv(nn.Module):
    """Convolution with equalised learning rate: weights of unit variance, scaled by 1/√(in·k²) when used."""

    def __init__(self, n_in: int, n_out: int, size: int, *, stride: int = 1, padding: int = 0) -> None:
        super().__init__()
        self.stride, self.padding = stride, padding
        self.weight = nn.Parameter(torch.randn(n_out, n_in, size, size))

    def forward(self, x: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h2 w2"]:
        """The convolution."""
        scale = 1 / math.sqrt(self.weight[0].numel())
        return F.conv2d(x, self.weight * scale, stride=self.stride, padding=self.padding)


class Bias(nn.Module):
    """√2 · lrelu_0.2(x + b), with one b per channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """The activated map."""
        return math.sqrt(2.0) * F.leaky_relu(x + self.bias[:, None, None], SLOPE)


class LowPass(nn.Module):
    """The filter [1,3,3,1]² of unit sum, before maps are halved."""

    kernel: Tensor

    def __init__(self, padding: int) -> None:
        super().__init__()
        self.padding = padding
        self.register_buffer("kernel", fir_kernel() / 4)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h2 w2"]:
        """The smoothed map, larger or smaller by what the padding makes of it."""
        return filter_channels(x, self.kernel, padding=self.padding)


class Block(nn.Module):
    """Residual block that halves the map: (conv, filtered conv of stride 2, + filtered 1x1 conv) / √2."""

    def __init__(self, n_in: int, n_out: int) -> None:
        super().__init__()
        self.conv1 = nn.Sequential(EqualConv(n_in, n_in, 3, padding=1), Bias(n_in))
        self.conv2 = nn.Sequential(LowPass(2), EqualConv(n_in, n_out, 3, stride=2), Bias(n_out))
        self.skip = nn.Sequential(LowPass(1), EqualConv(n_in, n_out, 1, stride=2))

    def forward(self, x: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h2 w2"]:
        """The halved map."""
        return (self.conv2(self.conv1(x)) + self.skip(x)) / math.sqrt(2.0)


class Discriminator(nn.Module):
    """Picture to one number, positive where it takes it for real.

    Args:
        resolution: side of the pictures, px; a power of two from 8.
        width: divisor of all channel counts, as of the generator it judges.
    """

    def __init__(self, resolution: int, width: int = 1) -> None:
        super().__init__()
        self.resolution = resolution

        def channels(side: int) -> int:
            return max(CHANNELS[side] // width, 1)

        layers: list[nn.Module] = [nn.Sequential(EqualConv(3, channels(resolution), 1), Bias(channels(resolution)))]
        side = resolution
        while side > 4:
            layers.append(Block(channels(side), channels(side // 2)))
            side //= 2
        self.convs = nn.Sequential(*layers)
        last = channels(4)
        self.final_conv = nn.Sequential(EqualConv(last + 1, last, 3, padding=1), Bias(last))
        self.final_linear = nn.Sequential(EqualLinear(last * 16, last, activate=True), EqualLinear(last, 1))

    def forward(self, images: Float[Tensor, "n 3 s s"]) -> Float[Tensor, " n"]:
        """How real each picture looks."""
        x = self.convs(images)
        x = self.final_conv(torch.cat((x, _spread(x)), 1))
        return self.final_linear(x.flatten(1))[:, 0]

    def features(self, images: Float[Tensor, "n 3 s s"]) -> list[Float[Tensor, "n c h w"]]:
        """Maps after the first layer and after each block, from the full size to 4 px."""
        maps = []
        for layer in self.convs:
            images = layer(images)
            maps.append(images)
        return maps


def _spread(x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n 1 h w"]:
    """Mean standard deviation of all features over groups of images, as a map: shows where images lack variety."""
    n, _, height, width = x.shape
    size = next(count for count in range(min(GROUP, n), 0, -1) if n % count == 0)
    groups = x.reshape(size, -1, *x.shape[1:])
    deviation = (groups.var(0, unbiased=False) + 1e-8).sqrt().mean((1, 2, 3))
    return deviation.repeat(size)[:, None, None, None].expand(n, 1, height, width)
