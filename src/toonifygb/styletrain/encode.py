"""Second stage: an encoder learns to draw frames as the taught generator would (StyleGANEX, Sec. 3.3).

Pairs come from one code: x is the base generator's photograph of a face, y the taught generator's picture of it.
The network, which sees x alone, shall draw y. Encoder and fusion layers are trained; the generator is not.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import torch.nn.functional as F

from toonifygb.styletrain.foundation import LEVELS, codes_of, draw
from toonifygb.styletrain.ranger import Ranger
from toonifygb.styletrain.state import (
    module_tensors,
    optimizer_tensors,
    restore_module,
    restore_optimizer,
)
from toonifygb.styletrain.transfer import R1_EVERY, advance, discriminator_adam, judge, r1

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from torch import Tensor

    from toonifygb.config import StyleTrainConfig
    from toonifygb.styletrain.discriminator import Discriminator
    from toonifygb.styletrain.perceptual import Perceptual
    from toonifygb.styletrain.state import Tensors
    from toonifygb.stylize.styleganex.network import StyleGANEX

INPUT_SIZE = 256
"""Side of the network's input, px; its output has the training's resolution."""
MAX_TURN_DEG, MAX_SCALE, MAX_SHIFT = 10.0, 1.1, 0.1
"""Random motion: rotation to each side, factor and its inverse, translation in sides of the picture."""
EDGE = 0.05
"""Rim of the picture, in half sides, where moved pictures are not compared: both show continuations there."""


class Pair(NamedTuple):
    """Photographs and what is to be made of them."""

    x: Float[Tensor, "n 3 256 256"]
    y: Float[Tensor, "n 3 s s"]


class Encode:
    """The state of the second stage, and one step of it.

    Args:
        base: the base network, on the device; draws the photographs.
        network: what is trained, on the device; its generator draws the targets.
        discriminator: of the first stage, on the device; is trained on.
        perceptual: distance of pictures.
        config: settings.
    """

    def __init__(
        self,
        base: StyleGANEX,
        network: StyleGANEX,
        discriminator: Discriminator,
        perceptual: Perceptual,
        config: StyleTrainConfig,
    ) -> None:
        self.config, self.levels = config, LEVELS[config.resolution]
        self.base, self.network, self.perceptual = base, network, perceptual
        self.discriminator = copy.deepcopy(discriminator).requires_grad_(True)
        network.encoder.requires_grad_(True)
        self.optimizer = Ranger(network.encoder.parameters(), config.encoder_rate)
        self.discriminator_optimizer = discriminator_adam(self.discriminator, config.encoder_rate)

    def step(self, step: int) -> dict[str, float]:
        """One step; ``step`` counts from 0. Draws from torch's global random state.

        Returns:
            the losses, without their weights.
        """
        config = self.config
        pair = self.pair(config.encoder_batch, config.truncation)
        codes = self.network.codes(pair.x)
        output = self._drawn(pair.x, codes)
        loss_d, _ = judge(self.discriminator, pair.y, output.detach())
        advance(self.discriminator_optimizer, loss_d)
        if step % R1_EVERY == 0:
            advance(
                self.discriminator_optimizer,
                r1(self.discriminator, pair.y) * (config.encoder_r1_weight / 2 * R1_EVERY),
            )
        self.discriminator.requires_grad_(False)
        l2 = F.mse_loss(output, pair.y)
        perceptual = self.perceptual(output, pair.y)
        adversarial = F.softplus(-self.discriminator(output)).mean()
        self.discriminator.requires_grad_(True)
        loss = config.l2_weight * l2 + config.perceptual_weight * perceptual
        loss = loss + config.adversarial_weight * adversarial
        terms = {"l2": l2, "perceptual": perceptual, "loss_g": adversarial}
        weight = config.flicker_weight * flicker_ramp(step, config.encoder_steps)
        if weight > 0:
            terms["flicker"] = self._flicker(pair.x, codes, output)
            loss = loss + weight * terms["flicker"]
        advance(self.optimizer, loss)
        return {name: float(term.detach()) for name, term in terms.items()}

    @torch.no_grad()
    def pair(self, n: int, truncation: float, generator: torch.Generator | None = None) -> Pair:
        """Random pairs. Photographs have random noise, which the target does not show and must not need."""
        average = self.base.latent_avg
        z = torch.randn(n, average.shape[1], generator=generator).to(average.device)
        codes = codes_of(self.base.decoder, z, average, truncation)
        photograph = draw(self.base.decoder, codes, levels=self.levels, noise="random")
        x = F.adaptive_avg_pool2d(photograph, INPUT_SIZE).clamp(-1, 1)
        return Pair(x, draw(self.network.decoder, codes, levels=self.levels))

    def tensors(self) -> Tensors:
        """Everything ``restore`` needs beside the notes."""
        return (
            module_tensors("encoder", self.network.encoder)
            | module_tensors("discriminator", self.discriminator)
            | optimizer_tensors("optimizer", self.optimizer)
            | optimizer_tensors("discriminator_optimizer", self.discriminator_optimizer)
        )

    def notes(self) -> dict[str, Any]:
        """What is no tensor."""
        return {}

    def restore(self, tensors: Tensors, notes: dict[str, Any]) -> None:
        """Goes on from a checkpoint."""
        restore_module("encoder", self.network.encoder, tensors)
        restore_module("discriminator", self.discriminator, tensors)
        restore_optimizer("optimizer", self.optimizer, tensors)
        restore_optimizer("discriminator_optimizer", self.discriminator_optimizer, tensors)

    def _drawn(self, x: Tensor, codes: Tensor) -> Float[Tensor, "n 3 s s"]:
        return self.network.synthesize(*self.network.features(x), codes, levels=self.levels)

    def _flicker(self, x: Tensor, codes: Tensor, output: Tensor) -> Tensor:
        """‖G(T(x)) - T(G(x))‖² where both are known; the codes stay those of the picture at rest."""
        motion = random_motion(len(x)).to(x)
        moved, _ = move(x, motion)
        expected, known = move(output, motion)
        difference = (self._drawn(moved, codes) - expected).square() * known[:, None]
        return difference.sum() / (3 * known.sum()).clamp_min(1)


def flicker_ramp(step: int, n_steps: int) -> float:
    """Share of the flicker term: 0 in the first half, then min(1, 4·(t/T - ½))."""
    return min(max(4 * (step / n_steps - 0.5), 0.0), 1.0)


def random_motion(n: int) -> Float[Tensor, "n 2 3"]:
    """Random similarities: output place to input place, both in -1..1."""
    angle = (torch.rand(n) * 2 - 1) * math.radians(MAX_TURN_DEG)
    scale = ((torch.rand(n) * 2 - 1) * math.log(MAX_SCALE)).exp()
    shift = (torch.rand(n, 2, 1) * 2 - 1) * (2 * MAX_SHIFT)
    cos, sin = angle.cos() * scale, angle.sin() * scale
    turn = torch.stack((torch.stack((cos, -sin), -1), torch.stack((sin, cos), -1)), 1)
    return torch.cat((turn, shift), 2)


def move(
    images: Float[Tensor, "n c h w"], motion: Float[Tensor, "n 2 3"]
) -> tuple[Float[Tensor, "n c h w"], Bool[Tensor, "n h w"]]:
    """The pictures moved, continued by their mirror image, and where that was not needed."""
    grid = F.affine_grid(motion, list(images.shape), align_corners=False)
    known = grid.abs().amax(3) < 1 - EDGE
    return F.grid_sample(images, grid, padding_mode="reflection", align_corners=False), known
