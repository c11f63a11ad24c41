"""The encoder: an IR-SE50 trunk with heads for style codes (pSp), a first-layer feature and skip features.

The input is H x W, both multiples of 8. The trunk is an input layer and 24 residual units, tapped at seven places
(``Taps``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toonifygb.stylize.styleganex.fusion import SKIP_SLOPE, Fusion
from toonifygb.stylize.styleganex.layers import EqualLinear
from toonifygb.stylize.styleganex.variants import N_CODES, STYLE_WIDTH

if TYPE_CHECKING:
    from jaxtyping import Float

    from toonifygb.stylize.styleganex.variants import Variant

STAGES = ((64, 3), (128, 4), (256, 14), (512, 3))
"""Channels and number of units; the first unit of each halves the size."""
TAPPED_UNITS = (2, 6, 10, 15, 20)
LAST_FEATURE_UNIT = TAPPED_UNITS[-1]
"""Units beyond it serve the style codes alone."""
SE_REDUCTION = 16
COARSE, MIDDLE = 3, 7
"""Codes below 3 are read at 1/16 of the input's size, below 7 at 1/8, the others at 1/4."""
LABEL_WIDTH = 16


class Taps(NamedTuple):
    """Features of the trunk, named as in the pSp paper where it names them."""

    c256: Float[Tensor, "n 64 h w"]
    c128: Float[Tensor, "n 64 h2 w2"]
    c1: Float[Tensor, "n 128 h4 w4"]
    c21: Float[Tensor, "n 256 h8 w8"]
    c22: Float[Tensor, "n 256 h8 w8"]
    c2: Float[Tensor, "n 256 h8 w8"]
    c3: Float[Tensor, "n 512 h16 w16"] | None
    """Absent where only features were asked for."""

    @classmethod
    def of(cls, maps: list[Tensor]) -> Taps:
        """The taps among the maps after the input layer and after each unit."""
        c128, c1, c21, c22, c2 = (maps[1 + unit] for unit in TAPPED_UNITS)
        return cls(maps[0], c128, c1, c21, c22, c2, maps[-1] if len(maps) > 2 + LAST_FEATURE_UNIT else None)

    def skips(self) -> tuple[Tensor, ...]:
        """Skip feature of each fusion layer."""
        return (self.c2, self.c2, self.c22, self.c21, self.c1, self.c128, self.c256)


class SqueezeExcite(nn.Module):
    """x · sigmoid(fc2(relu(fc1(mean x)))): channels weighed by what the whole map holds."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = max(channels // SE_REDUCTION, 1)
        self.fc1 = nn.Conv2d(channels, hidden, 1, bias=False)
        self.fc2 = nn.Conv2d(hidden, channels, 1, bias=False)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """The weighed map."""
        return x * torch.sigmoid(self.fc2(torch.relu(self.fc1(x.mean((2, 3), keepdim=True)))))


class Unit(nn.Module):
    """Residual unit: SE(BN(conv_s(PReLU(conv(BN(x)))))) + shortcut(x)."""

    def __init__(self, n_in: int, n_out: int, stride: int, *, widens: bool) -> None:
        super().__init__()
        self.stride = stride
        self.res_layer = nn.Sequential(
            nn.BatchNorm2d(n_in),
            nn.Conv2d(n_in, n_out, 3, padding=1, bias=False),
            nn.PReLU(n_out),
            nn.Conv2d(n_out, n_out, 3, stride, padding=1, bias=False),
            nn.BatchNorm2d(n_out),
            SqueezeExcite(n_out),
        )
        self.widens = widens
        if widens:
            self.shortcut_layer = nn.Sequential(
                nn.Conv2d(n_in, n_out, 1, stride, bias=False), nn.BatchNorm2d(n_out)
            )

    def forward(self, x: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h2 w2"]:
        """The unit's map, smaller by the stride (rounded up)."""
        shortcut = self.shortcut_layer(x) if self.widens else x[:, :, :: self.stride, :: self.stride]
        return self.res_layer(x) + shortcut


class StyleHead(nn.Module):
    """One style code: convolutions of stride 2, the mean (or maximum) over what is left, a linear layer."""

    def __init__(self, channels: int, n_convs: int, *, max_pooling: bool) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for _ in range(n_convs):
            layers += [nn.Conv2d(channels, channels, 3, 2, padding=1), nn.LeakyReLU(SKIP_SLOPE)]
        self.convs = nn.Sequential(*layers)
        self.linear = EqualLinear(channels, channels)
        self.max_pooling = max_pooling

    def forward(self, feature: Float[Tensor, "n 512 h w"]) -> Float[Tensor, "n 512"]:
        """The code, without the average latent."""
        x = self.convs(feature)
        return self.linear(x.amax((2, 3)) if self.max_pooling else x.mean((2, 3)))


class LabelBlock(nn.Module):
    """Residual block of the label input layer."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv_block = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.LeakyReLU(SKIP_SLOPE),
            nn.Conv2d(channels, channels, 3, padding=1),
        )

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Input plus correction."""
        return x + self.conv_block(x)


class LabelInput(nn.Module):
    """Input layer for sketches and parsing maps: down to 1/4, residual blocks, up again, then as for RGB.

    Built from a description and the shapes of its tensors; there are no images of the published program to compare.
    """

    def __init__(self, n_in: int, n_out: int, width: int, n_blocks: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for channels in (n_in, width):
            layers += [nn.Conv2d(channels, width, 3, 2, padding=1), nn.LeakyReLU(SKIP_SLOPE)]
        layers += [LabelBlock(width) for _ in range(n_blocks)]
        for _ in range(2):
            layers += [
                nn.ConvTranspose2d(width, width, 3, 2, padding=1, output_padding=1),
                nn.LeakyReLU(SKIP_SLOPE),
            ]
        self.model = nn.Sequential(*layers, *_input_layers(width, n_out))

    def forward(self, x: Float[Tensor, "n i h w"]) -> Float[Tensor, "n 64 h w"]:
        """The trunk's first feature."""
        return self.model(x)


def _input_layers(n_in: int, n_out: int) -> tuple[nn.Module, ...]:
    return nn.Conv2d(n_in, n_out, 3, padding=1, bias=False), nn.BatchNorm2d(n_out), nn.PReLU(n_out)


def _trunk(variant: Variant) -> nn.ModuleList:
    units, before = nn.ModuleList(), STAGES[0][0]
    for published, n_units in STAGES:
        for index in range(n_units):
            n_in, n_out = variant.channels(before), variant.channels(published)
            # The published width decides, so that narrow networks keep the shape of the wide ones.
            units.append(Unit(n_in, n_out, 1 if index else 2, widens=before != published))
            before = published
    return units


class Encoder(nn.Module):
    """Image to style codes, first-layer feature and skip features; holds the fusion layers as checkpoints do."""

    def __init__(self, variant: Variant) -> None:
        super().__init__()
        narrow, wide = variant.channels(STAGES[0][0]), variant.channels(STYLE_WIDTH)
        self.input_layer = nn.Sequential(*_input_layers(3, narrow))
        self.reads_labels = variant.input_channels != 3
        if self.reads_labels:
            width = variant.channels(LABEL_WIDTH)
            self.input_label_layer = LabelInput(variant.input_channels, narrow, width, variant.label_blocks)
        self.body = _trunk(variant)
        depths = [4 if code < COARSE else 5 if code < MIDDLE else 6 for code in range(N_CODES)]
        heads = [StyleHead(wide, depth, max_pooling=variant.max_pooling) for depth in depths]
        self.styles = nn.ModuleList(heads)
        self.latlayer1 = nn.Conv2d(variant.channels(256), wide, 1)
        self.latlayer2 = nn.Conv2d(variant.channels(128), wide, 1)
        self.featlayer = nn.Conv2d(3 * variant.channels(256), wide, 1)
        # An image of 3 channels beside the feature. No published network reads it, all of them store it.
        self.skiplayer = nn.Conv2d(3 * variant.channels(256), 3, 1)
        self.fusion = nn.ModuleList([Fusion(level, variant) for level in range(variant.n_fusion)])

    def trunk(self, x: Float[Tensor, "n c h w"], *, whole: bool) -> Taps:
        """Features of the trunk; its last three units only where the ``whole`` is asked for."""
        maps = [self.input_label_layer(x) if self.reads_labels else self.input_layer(x)]
        for unit in self.body if whole else self.body[: LAST_FEATURE_UNIT + 1]:
            maps.append(unit(maps[-1]))
        return Taps.of(maps)

    def codes(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n 18 512"]:
        """Style codes of an image, without the average latent."""
        taps = self.trunk(x, whole=True)
        c3 = taps.c3
        assert c3 is not None, "the whole trunk ends in this feature"
        p2 = _enlarged(c3, taps.c2) + self.latlayer1(taps.c2)
        p1 = _enlarged(p2, taps.c1) + self.latlayer2(taps.c1)
        sources = [c3 if code < COARSE else p2 if code < MIDDLE else p1 for code in range(N_CODES)]
        return torch.stack([head(source) for head, source in zip(self.styles, sources, strict=True)], 1)

    def features(self, x: Float[Tensor, "n c h w"]) -> tuple[Tensor, tuple[Tensor, ...]]:
        """First-layer feature ``n 512 h/8 w/8`` and one skip feature per fusion layer."""
        taps = self.trunk(x, whole=False)
        feature = self.featlayer(torch.cat((taps.c21, taps.c22, taps.c2), 1))
        return feature, taps.skips()[: len(self.fusion)]


def _enlarged(x: Tensor, target: Tensor) -> Tensor:
    return F.interpolate(x, size=target.shape[2:], mode="bilinear", align_corners=True)
