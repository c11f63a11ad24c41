"""Where details of the input enter the decoder: one fusion layer before each of its first levels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toonifygb.stylize.styleganex.layers import SLOPE
from toonifygb.stylize.styleganex.variants import STYLE_WIDTH

if TYPE_CHECKING:
    from jaxtyping import Float

    from toonifygb.stylize.styleganex.variants import Variant

FUSION_CHANNELS = ((256, 512), (256, 512), (256, 512), (256, 512), (128, 512), (64, 256), (64, 128))
"""Channels of the skip feature and of the decoder, level by level."""
SKIP_SLOPE = 0.01
"""Slope below zero of the encoder's own leaky ReLUs."""


class AdaptiveNorm(nn.Module):
    """Instance normalisation with scale and shift from a label: γ·(z - mean)/σ + β, [γ, β] = linear(label)."""

    def __init__(self, channels: int, label_width: int) -> None:
        super().__init__()
        self.style = nn.Linear(label_width, 2 * channels)

    def forward(self, z: Float[Tensor, "n c h w"], label: Float[Tensor, "n l"]) -> Float[Tensor, "n c h w"]:
        """The normalised map."""
        gain, shift = self.style(label)[:, :, None, None].chunk(2, 1)
        return gain * F.instance_norm(z) + shift


class Fusion(nn.Module):
    """Skip feature and decoder state to the state the level begins with.

    x = lrelu_0.01(transform(skip)); out' = fusion_out([out, x]); rgb' = fusion_skip([rgb, x]).

    In edit networks, given an editing vector, x is first multiplied by an attention map in 0..1 that says where
    details of the input may stay: tanh(relu(conv(norm([out, |out - x|], label)))), label = MLP(vector).

    Args:
        level: 0..6.
        variant: of the network.
    """

    def __init__(self, level: int, variant: Variant) -> None:
        super().__init__()
        n_in, n_out = (variant.channels(published) for published in FUSION_CHANNELS[level])
        self.transform = nn.Sequential(nn.Conv2d(n_in, n_out, 3, padding=1), nn.LeakyReLU(SKIP_SLOPE))
        self.fusion_out = nn.Conv2d(2 * n_out, n_out, 3, padding=1)
        self.fuse_rgb, self.has_attention = variant.fuse_rgb, variant.attention > 0
        if self.fuse_rgb:
            self.fusion_skip = nn.Conv2d(3 + n_out, 3, 3, padding=1)
        if self.has_attention:
            layers: list[nn.Module] = [nn.Linear(variant.channels(STYLE_WIDTH), n_out), nn.LeakyReLU(SLOPE)]
            for _ in range(variant.attention):
                layers += [nn.Linear(n_out, n_out), nn.LeakyReLU(SLOPE)]
            self.linear = nn.Sequential(*layers)
            self.norm = AdaptiveNorm(2 * n_out, n_out)
            self.conv = nn.Conv2d(2 * n_out, 1, 3, padding=1)

    def forward(
        self, skip: Tensor, out: Tensor, rgb: Tensor, vector: Float[Tensor, "n 512"] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Features and image for the level to begin with.

        Args:
            skip: the encoder's feature.
            out: the decoder's features, same size.
            rgb: the image so far, same size.
            vector: the level's row of the editing vector; without it there is no attention.
        """
        x = self.transform(skip)
        if self.has_attention and vector is not None:
            x = x * self.attention(out, x, self.linear(vector))
        fused = self.fusion_out(torch.cat((out, x), 1))
        return fused, self.fusion_skip(torch.cat((rgb, x), 1)) if self.fuse_rgb else rgb

    def attention(self, out: Tensor, x: Tensor, label: Float[Tensor, "n l"]) -> Float[Tensor, "n 1 h w"]:
        """How much of the skip feature may pass, 0..1."""
        z = torch.cat((out, (out - x).abs()), 1)
        return torch.tanh(torch.relu(self.conv(self.norm(z, label))))
