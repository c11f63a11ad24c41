"""Building blocks of the decoder (StyleGAN2, Karras et al. 2020) in their plain form.

Feature maps are ``n c h w``; a style is one code of w+ per image. Three kinds of convolution:

* ``same``: a 3x3 kernel, possibly dilated, zero padding;
* ``double``: a transposed convolution of stride 2, then a 4x4 low-pass filter: twice the size;
* ``simulated``: what ``double`` does to the values, at unchanged size. Here the levels of StyleGAN2 below 64 px
  run on a map of H/8 x W/8: kernels are dilated instead of maps enlarged (Sec. 3.1 of StyleGANEX).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

if TYPE_CHECKING:
    from jaxtyping import Float

Kind = Literal["same", "simulated", "double"]
Noise = Literal["zero", "fixed", "random"]
SLOPE = 0.2
"""Slope of the decoder's leaky ReLUs below zero."""
EPSILON = 1e-8


def fir_kernel() -> Float[Tensor, "4 4"]:
    """Low-pass filter that goes with zero insertion: outer([1,3,3,1])/16, whose sum is 4."""
    taps = torch.tensor([1.0, 3.0, 3.0, 1.0])
    return torch.outer(taps, taps) / 16


def binomial_kernel() -> Float[Tensor, "1 1 3 3"]:
    """Low-pass filter of the dilated levels: outer([1,2,1])/16, whose sum is 1."""
    taps = torch.tensor([1.0, 2.0, 1.0])
    return (torch.outer(taps, taps) / 16)[None, None]


def filter_channels(
    x: Float[Tensor, "n c h w"], kernel: Float[Tensor, "kh kw"], *, padding: int, dilation: int = 1
) -> Float[Tensor, "n c h2 w2"]:
    """Every channel correlated with one kernel, zero outside the map."""
    channels = x.shape[1]
    return F.conv2d(
        x, kernel.expand(channels, 1, *kernel.shape), padding=padding, dilation=dilation, groups=channels
    )


def double_size(x: Float[Tensor, "n c h w"], kernel: Float[Tensor, "4 4"]) -> Float[Tensor, "n c h2 w2"]:
    """Zero insertion and low-pass: bilinear enlargement by 2 that takes the outside of the map for zero."""
    channels = x.shape[1]
    return F.conv_transpose2d(x, kernel.expand(channels, 1, 4, 4), stride=2, padding=1, groups=channels)


class Kernel(nn.Module):
    """Holder of the filter that checkpoints store beside each up-sampling layer."""

    kernel: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("kernel", fir_kernel())


class PixelNorm(nn.Module):
    """x / sqrt(mean_c x² + ε)."""

    def forward(self, x: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """Rows of unit mean square."""
        return x * torch.rsqrt(x.square().mean(1, keepdim=True) + EPSILON)


class EqualLinear(nn.Module):
    """Linear layer with equalised learning rate: y = x·(m/√in · W)ᵀ + m·b.

    Args:
        n_in: inputs.
        n_out: outputs.
        bias: initial value of every b.
        rate: m; weights are stored divided by it.
        activate: whether √2·lrelu_0.2 follows.
    """

    def __init__(
        self, n_in: int, n_out: int, *, bias: float = 0.0, rate: float = 1.0, activate: bool = False
    ) -> None:
        super().__init__()
        self.rate, self.activate = rate, activate
        self.weight = nn.Parameter(torch.randn(n_out, n_in) / rate)
        self.bias = nn.Parameter(torch.full((n_out,), bias))

    def forward(self, x: Float[Tensor, "n i"]) -> Float[Tensor, "n o"]:
        """The layer's answer to each row."""
        y = F.linear(x, self.weight * (self.rate / math.sqrt(self.weight.shape[1])), self.bias * self.rate)
        return math.sqrt(2.0) * F.leaky_relu(y, SLOPE) if self.activate else y


class ModulatedConv(nn.Module):
    """Convolution whose kernel is scaled by a style (StyleGAN2, Eqs. 1 and 3), without bias.

    s = modulation(style); K = W·s_i/√(in·k²); demodulated: K_o / sqrt(Σ K_o² + ε).

    Args:
        n_in: input channels.
        n_out: output channels.
        size: side of the kernel.
        style_width: length of a style code.
        kind: see the module.
        dilation: distance between kernel taps (``same``), or twice that (``simulated``).
        demodulate: whether output channels are brought back to unit expected variance.
    """

    blur_weight: Tensor

    def __init__(
        self,
        n_in: int,
        n_out: int,
        size: int,
        style_width: int,
        *,
        kind: Kind = "same",
        dilation: int = 1,
        demodulate: bool = True,
    ) -> None:
        super().__init__()
        self.kind, self.dilation, self.demodulate = kind, dilation, demodulate
        self.weight = nn.Parameter(torch.randn(1, n_out, n_in, size, size))
        self.modulation = EqualLinear(style_width, n_in, bias=1.0)
        if kind != "same":
            self.blur = Kernel()
        if kind == "simulated":
            self.register_buffer("blur_weight", binomial_kernel())

    def kernels(self, style: Float[Tensor, "n s"]) -> Float[Tensor, "n o i k k"]:
        """One kernel per style."""
        scale = 1 / math.sqrt(self.weight[0, 0].numel())
        kernels = self.weight * scale * self.modulation(style)[:, None, :, None, None]
        if self.demodulate:
            kernels = kernels * torch.rsqrt(kernels.square().sum((2, 3, 4), keepdim=True) + EPSILON)
        return kernels

    def forward(self, x: Float[Tensor, "n i h w"], style: Float[Tensor, "n s"]) -> Float[Tensor, "n o h2 w2"]:
        """The convolution with each image's own kernel."""
        kernels = self.kernels(style)
        if self.kind == "double":
            return filter_channels(_transposed(x, kernels), self.blur.kernel, padding=1)
        if self.kind == "simulated":
            step = self.dilation // 2
            # Blur first, and over the rim as well: the kernel then needs no padding and sees no artificial edge.
            wide = filter_channels(x, self.blur_weight[0, 0], padding=2 * step, dilation=step)
            # A transposed convolution adds what a correlation with the turned kernel gathers.
            return _each(wide, kernels.flip(3, 4), padding=0, dilation=step)
        return _each(x, kernels, padding=self.dilation * (kernels.shape[-1] // 2), dilation=self.dilation)


def _each(x: Tensor, kernels: Float[Tensor, "n o i k k"], *, padding: int, dilation: int) -> Tensor:
    """Every image with its own kernel, as one grouped convolution."""
    n, n_out = kernels.shape[:2]
    maps = x.reshape(1, -1, *x.shape[2:])
    y = F.conv2d(maps, kernels.flatten(0, 1), padding=padding, dilation=dilation, groups=n)
    return y.reshape(n, n_out, *y.shape[2:])


def _transposed(x: Tensor, kernels: Float[Tensor, "n o i k k"]) -> Float[Tensor, "n o h2 w2"]:
    """Transposed convolution of stride 2 with each image's own kernel: h to 2h + 1."""
    n, n_out = kernels.shape[:2]
    maps = x.reshape(1, -1, *x.shape[2:])
    y = F.conv_transpose2d(maps, kernels.transpose(1, 2).flatten(0, 1), stride=2, groups=n)
    return y.reshape(n, n_out, *y.shape[2:])


class NoiseStrength(nn.Module):
    """How strongly noise, one map for all channels, is added to a layer."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, x: Tensor, mode: Noise, stored: Float[Tensor, "1 1 s s"]) -> Tensor:
        """``x`` with noise.

        Args:
            x: feature map.
            mode: ``zero`` adds none; ``fixed`` the stored map, averaged to the size of ``x``; ``random`` a new one.
            stored: the layer's own noise map.
        """
        if mode == "zero":
            return x
        if mode == "fixed":
            return x + self.weight * F.adaptive_avg_pool2d(stored, (x.shape[2], x.shape[3]))
        return x + self.weight * torch.randn(len(x), 1, *x.shape[2:], dtype=x.dtype, device=x.device)


class Activation(nn.Module):
    """√2 · lrelu_0.2(x + b), with one b per channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """The activated map."""
        return math.sqrt(2.0) * F.leaky_relu(x + self.bias[:, None, None], SLOPE)


class StyledConv(nn.Module):
    """Modulated 3x3 convolution, noise, activation; arguments as ``ModulatedConv``."""

    def __init__(self, n_in: int, n_out: int, style_width: int, *, kind: Kind = "same", dilation: int = 1) -> None:
        super().__init__()
        self.conv = ModulatedConv(n_in, n_out, 3, style_width, kind=kind, dilation=dilation)
        self.noise = NoiseStrength()
        self.activate = Activation(n_out)

    def forward(self, x: Tensor, style: Tensor, mode: Noise, stored: Tensor) -> Tensor:
        """The layer's feature map; noise as in ``NoiseStrength``."""
        return self.activate(self.noise(self.conv(x, style), mode, stored))


class ToRGB(nn.Module):
    """What a level adds to the image: a modulated 1x1 convolution to three channels, on top of the image so far.

    Args:
        n_in: channels of the level.
        style_width: length of a style code.
        kind: how the level treats the image so far: the very first one (``same``) has none.
        dilation: of a ``simulated`` level.
    """

    blur_weight: Tensor

    def __init__(self, n_in: int, style_width: int, *, kind: Kind = "same", dilation: int = 1) -> None:
        super().__init__()
        self.kind, self.dilation = kind, dilation
        self.bias = nn.Parameter(torch.zeros(1, 3, 1, 1))
        self.conv = ModulatedConv(n_in, 3, 1, style_width, demodulate=False)
        if kind != "same":
            self.upsample = Kernel()
        if kind == "simulated":
            self.register_buffer("blur_weight", binomial_kernel())

    def forward(self, x: Tensor, style: Tensor, rgb: Tensor | None = None) -> Float[Tensor, "n 3 h w"]:
        """The image after this level, from about -1 to 1."""
        own = self.conv(x, style) + self.bias
        if rgb is None:
            return own
        if self.kind == "double":
            return own + double_size(rgb, self.upsample.kernel)
        step = self.dilation // 2
        return own + filter_channels(rgb, self.blur_weight[0, 0], padding=step, dilation=step)
