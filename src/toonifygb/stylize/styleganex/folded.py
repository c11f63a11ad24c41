"""Layers with everything constant folded in: the modulation by a clip's style codes, gains, normalisations.

Each class has the plain one it stands for in its docstring; ``fast`` says what is folded and why it is exact.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toonifygb.stylize.styleganex.encoder import LAST_FEATURE_UNIT, Encoder, LabelBlock, Taps, Unit
from toonifygb.stylize.styleganex.fusion import SKIP_SLOPE, Fusion
from toonifygb.stylize.styleganex.layers import SLOPE, StyledConv, ToRGB

if TYPE_CHECKING:
    from jaxtyping import Float

GAIN = math.sqrt(2.0)
"""Of the decoder's activation."""


class FixedConv(nn.Module):
    """Convolution with fixed kernel, bias and leaky ReLU.

    Args:
        weight: kernel ``o i k k``; ``i o k k`` when transposed, ``c 1 k k`` when depthwise.
        bias: per output channel.
        slope: of the leaky ReLU; None for none.
        stride: of the convolution.
        padding: zeros on each side.
        output_padding: rows and columns added at the end of a transposed convolution's output.
        dilation: distance of taps.
        transposed: whether this is a transposed convolution.
        depthwise: whether each channel has a kernel of its own.
    """

    weight: Tensor
    bias: Tensor | None

    def __init__(
        self,
        weight: Tensor,
        bias: Tensor | None = None,
        *,
        slope: float | None = None,
        stride: int = 1,
        padding: int = 0,
        output_padding: int = 0,
        dilation: int = 1,
        transposed: bool = False,
        depthwise: bool = False,
    ) -> None:
        super().__init__()
        # Copies, so that the plain network can be given back while this one lives.
        self.register_buffer("weight", weight.detach().clone())
        self.register_buffer("bias", None if bias is None else bias.detach().clone())
        self.slope, self.transposed, self.groups = slope, transposed, len(weight) if depthwise else 1
        self.stride, self.padding, self.output_padding, self.dilation = stride, padding, output_padding, dilation

    def forward(self, x: Tensor) -> Tensor:
        """The activated map."""
        if self.transposed:
            y = F.conv_transpose2d(
                x,
                self.weight,
                self.bias,
                self.stride,
                self.padding,
                self.output_padding,
                self.groups,
                self.dilation,
            )
        else:
            y = F.conv2d(x, self.weight, self.bias, self.stride, self.padding, self.dilation, self.groups)
        return y if self.slope is None else F.leaky_relu_(y, self.slope)


class FixedNorm(nn.Module):
    """A batch normalisation that could not be folded: x·scale + shift."""

    scale: Tensor
    shift: Tensor

    def __init__(self, norm: nn.BatchNorm2d) -> None:
        super().__init__()
        scale, shift = _affine(norm)
        self.register_buffer("scale", scale[None, :, None, None])
        self.register_buffer("shift", shift[None, :, None, None])

    def forward(self, x: Tensor) -> Tensor:
        """The normalised map."""
        return torch.addcmul(self.shift, x, self.scale)


class Slopes(nn.Module):
    """Leaky ReLU with one slope per channel."""

    slope: Tensor

    def __init__(self, activation: nn.PReLU) -> None:
        super().__init__()
        self.register_buffer("slope", activation.weight.detach().clone())

    def forward(self, x: Tensor) -> Tensor:
        """The activated map."""
        return F.prelu(x, self.slope)


class FoldedUnit(nn.Module):
    """``encoder.Unit`` with its second normalisation folded."""

    def __init__(self, unit: Unit) -> None:
        super().__init__()
        norm, conv, activation, strided, second, excite = unit.res_layer
        self.norm = FixedNorm(cast("nn.BatchNorm2d", norm))
        self.conv = fold_conv(conv)
        self.activation = Slopes(cast("nn.PReLU", activation))
        self.strided = fold_conv(strided, second)
        self.squeeze, self.excite = fold_conv(excite.fc1), fold_conv(excite.fc2)  # type: ignore[union-attr]
        self.stride = unit.stride
        self.shortcut = fold_conv(*unit.shortcut_layer) if unit.widens else None

    def forward(self, x: Tensor) -> Tensor:
        """The unit's map."""
        shortcut = x[:, :, :: self.stride, :: self.stride] if self.shortcut is None else self.shortcut(x)
        y = self.strided(self.activation(self.conv(self.norm(x))))
        gate = torch.sigmoid(self.excite(torch.relu(self.squeeze(y.mean((2, 3), keepdim=True)))))
        return torch.addcmul(shortcut, y, gate)


class FoldedLabelBlock(nn.Module):
    """``encoder.LabelBlock``."""

    def __init__(self, block: LabelBlock) -> None:
        super().__init__()
        self.first = fold_conv(block.conv_block[0], slope=SKIP_SLOPE)
        self.second = fold_conv(block.conv_block[2])

    def forward(self, x: Tensor) -> Tensor:
        """Input plus correction."""
        return x + self.second(self.first(x))


class FoldedFeatures(nn.Module):
    """The trunk as far as features are read."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.input = fold_input(encoder)
        self.units = nn.ModuleList(
            [FoldedUnit(cast("Unit", unit)) for unit in encoder.body[: LAST_FEATURE_UNIT + 1]]
        )
        self.feature = fold_conv(encoder.featlayer)
        self.n_skips = len(encoder.fusion)

    def forward(self, x: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """First-layer feature and skip features."""
        maps = [self.input(x)]
        for unit in self.units:
            maps.append(unit(maps[-1]))
        taps = Taps.of(maps)
        return self.feature(torch.cat((taps.c21, taps.c22, taps.c2), 1)), taps.skips()[: self.n_skips]


class FoldedAttention(nn.Module):
    """Where details of the input may stay, with scale and shift of the clip's editing vector."""

    gain: Tensor
    shift: Tensor

    def __init__(self, fusion: Fusion, vector: Tensor) -> None:
        super().__init__()
        gain, shift = fusion.norm.style(fusion.linear(vector))[:, :, None, None].chunk(2, 1)
        self.register_buffer("gain", gain.clone())
        self.register_buffer("shift", shift.clone())
        self.conv = fold_conv(fusion.conv)

    def forward(self, out: Tensor, x: Tensor) -> Tensor:
        """Shares in 0..1."""
        z = F.instance_norm(torch.cat((out, (out - x).abs()), 1))
        return torch.tanh(torch.relu(self.conv(torch.addcmul(self.shift, z, self.gain))))


class FoldedFusion(nn.Module):
    """``fusion.Fusion`` for one editing vector."""

    def __init__(self, fusion: Fusion, vector: Tensor | None) -> None:
        super().__init__()
        self.transform = fold_conv(fusion.transform[0], slope=SKIP_SLOPE)
        self.out = fold_conv(fusion.fusion_out)
        self.rgb = fold_conv(fusion.fusion_skip) if fusion.fuse_rgb else None
        self.attention = FoldedAttention(fusion, vector) if fusion.has_attention and vector is not None else None

    def forward(self, out: Tensor, rgb: Tensor, skip: Tensor) -> tuple[Tensor, Tensor]:
        """Features and image for the level to begin with."""
        x = self.transform(skip)
        if self.attention is not None:
            x = x * self.attention(out, x)
        return self.out(torch.cat((out, x), 1)), rgb if self.rgb is None else self.rgb(torch.cat((rgb, x), 1))


class FoldedLevel(nn.Module):
    """Fusion, two convolutions, and the image so far brought to the level's size."""

    def __init__(
        self, fusion: FoldedFusion | None, first: nn.Module, second: nn.Module, to_rgb: ToRGB, code: Tensor
    ) -> None:
        super().__init__()
        self.fusion, self.first, self.second = fusion, first, second
        self.to_rgb = fold_to_rgb(to_rgb, code)
        if to_rgb.kind == "double":
            kernel = to_rgb.upsample.kernel.expand(3, 1, -1, -1)
            self.enlarge = FixedConv(kernel, stride=2, padding=1, transposed=True, depthwise=True)
        else:
            step = to_rgb.dilation // 2
            self.enlarge = FixedConv(
                to_rgb.blur_weight.expand(3, -1, -1, -1), padding=step, dilation=step, depthwise=True
            )

    def forward(self, out: Tensor, rgb: Tensor, skip: Tensor | None) -> tuple[Tensor, Tensor]:
        """Features and image after the level."""
        if self.fusion is not None and skip is not None:
            out, rgb = self.fusion(out, rgb, skip)
        out = self.second(self.first(out))
        return out, self.to_rgb(out) + self.enlarge(rgb)


def _affine(norm: nn.BatchNorm2d) -> tuple[Float[Tensor, " c"], Float[Tensor, " c"]]:
    """Scale and shift that a batch normalisation amounts to in evaluation."""
    mean, variance = cast("Tensor", norm.running_mean), cast("Tensor", norm.running_var)
    scale = norm.weight * torch.rsqrt(variance + norm.eps)
    return scale, norm.bias - mean * scale


def fold_conv(conv: nn.Module, norm: nn.Module | None = None, *, slope: float | None = None) -> FixedConv:
    """A convolution with the normalisation after it, if any."""
    source = cast("nn.Conv2d | nn.ConvTranspose2d", conv)
    transposed = isinstance(conv, nn.ConvTranspose2d)
    weight, bias = source.weight, source.bias
    if norm is not None:
        scale, bias = _affine(cast("nn.BatchNorm2d", norm))
        weight = weight * scale[:, None, None, None]
    return FixedConv(
        weight,
        bias,
        slope=slope,
        stride=source.stride[0],
        padding=cast("int", source.padding[0]),
        output_padding=source.output_padding[0],
        transposed=transposed,
    )


def fold_input(encoder: Encoder) -> nn.Sequential:
    """The input layer for RGB or labels."""
    if not encoder.reads_labels:
        conv, norm, activation = encoder.input_layer
        return nn.Sequential(fold_conv(conv, norm), Slopes(cast("nn.PReLU", activation)))
    *layers, conv, norm, activation = encoder.input_label_layer.model
    baked: list[nn.Module] = []
    for layer in layers:
        if isinstance(layer, LabelBlock):
            baked.append(FoldedLabelBlock(layer))
        elif not isinstance(layer, nn.LeakyReLU):
            baked.append(fold_conv(layer, slope=SKIP_SLOPE))
    return nn.Sequential(*baked, fold_conv(conv, norm), Slopes(cast("nn.PReLU", activation)))


def fold_styled(layer: StyledConv, code: Float[Tensor, "1 s"]) -> nn.Module:
    """``layers.StyledConv`` without noise, modulated by ``code``."""
    conv = layer.conv
    kernels, bias = GAIN * conv.kernels(code)[0], GAIN * layer.activate.bias
    channels = kernels.shape[:2]
    if conv.kind == "double":
        filters = conv.blur.kernel.expand(channels[0], 1, -1, -1)
        return nn.Sequential(
            FixedConv(kernels.transpose(0, 1), stride=2, transposed=True),
            FixedConv(filters, bias, slope=SLOPE, padding=1, depthwise=True),
        )
    if conv.kind == "simulated":
        step = conv.dilation // 2
        filters = conv.blur_weight.expand(channels[1], -1, -1, -1)
        return nn.Sequential(
            FixedConv(filters, padding=2 * step, dilation=step, depthwise=True),
            FixedConv(kernels.flip(2, 3), bias, slope=SLOPE, dilation=step),
        )
    return FixedConv(kernels, bias, slope=SLOPE, padding=conv.dilation, dilation=conv.dilation)


def fold_to_rgb(layer: ToRGB, code: Float[Tensor, "1 s"]) -> FixedConv:
    """The 1x1 convolution of ``layers.ToRGB``, modulated by ``code``."""
    return FixedConv(layer.conv.kernels(code)[0], layer.bias.flatten())
