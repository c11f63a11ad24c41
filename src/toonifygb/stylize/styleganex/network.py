"""StyleGANEX as published (Yang et al. 2023), plain: the definition that ``fast`` is measured against.

    x2, aligned 256 px face ──encoder.codes──▶ + average latent ──▶ w+ ──────────────┐
    x1, frame H x W ──encoder.features──▶ first-layer feature ──▶ decoder levels ──▶ image 4H x 4W
                                     └──▶ skip features ──▶ fusion before the first 7 levels

Images are RGB in -1..1, H and W multiples of 8. The state dict has the keys and shapes of the authors' files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from toonifygb.errors import InputError
from toonifygb.stylize.styleganex.encoder import Encoder
from toonifygb.stylize.styleganex.generator import N_LEVELS, Generator
from toonifygb.stylize.styleganex.variants import N_CODES, PUBLISHED, STYLE_WIDTH, Variant

if TYPE_CHECKING:
    from jaxtyping import Float

    from toonifygb.stylize.styleganex.layers import Noise

MULTIPLE = 8
"""What both sides of the input must be multiples of."""


class StyleGANEX(nn.Module):
    """One network, freshly initialised; ``weights.load`` reads a trained one. Always in evaluation mode.

    Args:
        variant: which of the published networks.
    """

    latent_avg: Float[Tensor, "18 512"]
    """Mean style codes, added to what the encoder says. Not part of the state dict, as in the authors' files."""
    editing_w: Float[Tensor, "k 18 512"]
    """Editing vectors that came with the weights; none in most networks."""

    def __init__(self, variant: Variant = PUBLISHED["toonify"]) -> None:
        super().__init__()
        self.variant = variant
        self.encoder = Encoder(variant)
        self.decoder = Generator(variant)
        code = variant.channels(STYLE_WIDTH)
        self.register_buffer("latent_avg", torch.zeros(N_CODES, code), persistent=False)
        self.register_buffer("editing_w", torch.zeros(0, N_CODES, code), persistent=False)
        self.eval()

    def train(self, mode: bool = True) -> StyleGANEX:
        """Stays in evaluation mode: normalisations use the statistics they were trained with, also in training."""
        return super().train(False)

    def codes(self, x2: Float[Tensor, "n c h w"]) -> Float[Tensor, "n 18 512"]:
        """w+ of an aligned face (256 px as published): E(x2) + average latent."""
        check_image(x2, self.variant.input_channels)
        return self.encoder.codes(x2) + self.latent_avg

    def features(self, x1: Float[Tensor, "n c h w"]) -> tuple[Float[Tensor, "n 512 h8 w8"], tuple[Tensor, ...]]:
        """First-layer feature and skip features of a frame."""
        check_image(x1, self.variant.input_channels)
        return self.encoder.features(x1)

    def synthesize(
        self,
        feature: Float[Tensor, "n 512 h8 w8"] | None,
        skips: tuple[Tensor, ...],
        w_plus: Float[Tensor, "m 18 512"],
        *,
        edit: Float[Tensor, "m2 18 512"] | None = None,
        noise: Noise = "zero",
        levels: int = N_LEVELS,
    ) -> Float[Tensor, "n 3 h4 w4"]:
        """Image from features and codes, from about -1 to 1 and not clamped.

        Args:
            feature: first-layer feature; None for StyleGAN2's own constant, which gives 1024 px.
            skips: skip features; empty for none.
            w_plus: style codes, one set per image or one for all.
            edit: editing vector added to ``w_plus``; in edit networks it also steers what is kept of the input.
            noise: ``zero`` for video; ``fixed`` or ``random``.
            levels: 8 for an image of 4H x 4W, 7 for 2H x 2W, 6 for H x W.
        """
        if feature is None:
            feature = self.decoder.start(len(w_plus))
        n = len(feature)
        if edit is not None:
            w_plus = w_plus + edit
        w_plus = w_plus.expand(n, -1, -1)

        def fuse(level: int, out: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
            if level >= len(skips):
                return out, rgb
            vector = None if edit is None else edit[:, 1 + 2 * level].expand(n, -1)
            return self.encoder.fusion[level](skips[level], out, rgb, vector)

        return self.decoder(feature, w_plus, fuse, noise=noise, levels=levels)

    def forward(
        self,
        x1: Float[Tensor, "n c h w"],
        x2: Tensor | None = None,
        edit: Float[Tensor, "m 18 512"] | None = None,
        *,
        noise: Noise = "zero",
        levels: int = N_LEVELS,
    ) -> Float[Tensor, "n 3 h4 w4"]:
        """Stylised image of a frame, not clamped.

        Args:
            x1: frame.
            x2: aligned face ``m c h w`` whose style is taken, or its codes ``m 18 512``; None for the frame's own.
            edit: see ``synthesize``.
            noise: see ``synthesize``.
            levels: see ``synthesize``.
        """
        w_plus = x2 if x2 is not None and x2.ndim == 3 else self.codes(x1 if x2 is None else x2)
        return self.synthesize(*self.features(x1), w_plus, edit=edit, noise=noise, levels=levels)


def check_image(image: Tensor, channels: int) -> None:
    """Raises InputError where ``image`` is not ``n c h w`` of so many channels and with sides of multiples of 8."""
    if image.ndim != 4 or image.shape[1] != channels or image.shape[2] % MULTIPLE or image.shape[3] % MULTIPLE:
        raise InputError(
            f"the network was given an image of shape {list(image.shape)}; "
            f"expected [n, {channels}, h, w] with h and w multiples of {MULTIPLE}"
        )
