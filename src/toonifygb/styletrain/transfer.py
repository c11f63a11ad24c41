"""First stage: the base's generator is taught to draw the pictures' style (Sec. 4 of Pinkney & Adler 2020; ADA).

Generator and discriminator play StyleGAN2's game: non-saturating logistic loss, R1 every 16th step, augmentation by
``augment``. The mapping network stays as it is, so that one code means the same face in both generators: that is
what pairs are made of.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F

from toonifygb.styletrain.augment import Controller, augment
from toonifygb.styletrain.foundation import LEVELS, codes_of, draw
from toonifygb.styletrain.state import (
    module_tensors,
    optimizer_tensors,
    restore_module,
    restore_optimizer,
)

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8
    from torch import Tensor, nn

    from toonifygb.config import StyleTrainConfig
    from toonifygb.styletrain.discriminator import Discriminator
    from toonifygb.styletrain.state import Tensors
    from toonifygb.stylize.styleganex.network import StyleGANEX

R1_EVERY, PATH_EVERY = 16, 4
"""Steps between two regularisations; weights and learning rates make up for the pause (StyleGAN2, Sec. 3.1)."""
PATH_DECAY = 0.01
EMA_RAMP = 0.05
"""Half-life of the averaged generator, in shares of the pictures shown so far, while that is less than its own."""


class Transfer:
    """The state of the first stage, and one step of it.

    Args:
        base: the base network, on the device; stays as it is.
        discriminator: new or stored, on the device; is trained.
        images: the aligned pictures.
        config: settings.
    """

    def __init__(
        self,
        base: StyleGANEX,
        discriminator: Discriminator,
        images: UInt8[Tensor, "n 3 s s"],
        config: StyleTrainConfig,
    ) -> None:
        self.config, self.images, self.levels = config, images, LEVELS[config.resolution]
        self.base, self.discriminator = base, discriminator
        self.generator = copy.deepcopy(base.decoder)
        self.average = copy.deepcopy(base.decoder)
        self.generator.requires_grad_(True)
        self.generator.style.requires_grad_(False)
        self.controller = Controller(config.ada_target, config.ada_images)
        self.path_length = torch.zeros((), device=base.latent_avg.device)
        trained = [parameter for parameter in self.generator.parameters() if parameter.requires_grad]
        lazy = PATH_EVERY / (PATH_EVERY + 1) if config.path_weight else 1.0
        self.generator_optimizer = adam(trained, config.generator_rate, lazy)
        self.discriminator_optimizer = discriminator_adam(discriminator, config.generator_rate)

    def step(self, step: int) -> dict[str, float]:
        """One step of both players; ``step`` counts from 0. Draws from torch's global random state.

        Returns:
            losses, and the probability of augmentations.
        """
        real = self._real()
        with torch.no_grad():
            fake = self._drawn(self._codes())
        loss_d, answers = judge(
            self.discriminator, augment(real, self.controller.p), augment(fake, self.controller.p)
        )
        advance(self.discriminator_optimizer, loss_d)
        self.controller.observe(answers)
        if step % R1_EVERY == 0:
            penalty = r1(self.discriminator, real, self.controller.p)
            advance(self.discriminator_optimizer, penalty * (self.config.r1_weight / 2 * R1_EVERY))

        self.discriminator.requires_grad_(False)
        fake = self._drawn(self._codes())
        loss_g = F.softplus(-self.discriminator(augment(fake, self.controller.p))).mean()
        advance(self.generator_optimizer, loss_g)
        self.discriminator.requires_grad_(True)
        if self.config.path_weight and step % PATH_EVERY == 0:
            advance(self.generator_optimizer, self._path_penalty() * (self.config.path_weight * PATH_EVERY))
        self._average(step)
        return {"loss_d": float(loss_d.detach()), "loss_g": float(loss_g.detach()), "ada": self.controller.p}

    def tensors(self) -> Tensors:
        """Everything ``restore`` needs beside the notes."""
        return (
            module_tensors("generator", self.generator)
            | module_tensors("average", self.average)
            | module_tensors("discriminator", self.discriminator)
            | optimizer_tensors("generator_optimizer", self.generator_optimizer)
            | optimizer_tensors("discriminator_optimizer", self.discriminator_optimizer)
            | {"path_length": self.path_length}
        )

    def notes(self) -> dict[str, Any]:
        """What is no tensor."""
        return {"ada": self.controller.state()}

    def restore(self, tensors: Tensors, notes: dict[str, Any]) -> None:
        """Goes on from a checkpoint."""
        restore_module("generator", self.generator, tensors)
        restore_module("average", self.average, tensors)
        restore_module("discriminator", self.discriminator, tensors)
        restore_optimizer("generator_optimizer", self.generator_optimizer, tensors)
        restore_optimizer("discriminator_optimizer", self.discriminator_optimizer, tensors)
        self.path_length = tensors["path_length"].to(self.path_length.device)
        self.controller.restore(notes["ada"])

    def _real(self) -> Float[Tensor, "b 3 s s"]:
        """A random batch of pictures in -1..1."""
        n = self.config.generator_batch
        batch = self.images[torch.randint(len(self.images), (n,))]
        if self.config.mirror:
            batch = torch.where(torch.rand(n)[:, None, None, None] < 0.5, batch.flip(3), batch)
        return batch.to(self.base.latent_avg.device).float() / 127.5 - 1

    def _codes(self) -> Float[Tensor, "b 18 c"]:
        """Random codes; a share of them takes its fine layers from another face (style mixing)."""
        average = self.base.latent_avg
        n, n_codes, width = self.config.generator_batch, *average.shape
        z = torch.randn(2, n, width, device=average.device)
        with torch.no_grad():
            coarse, fine = (codes_of(self.base.decoder, part, average) for part in z)
        first = torch.randint(1, n_codes, (n,), device=average.device)
        first[torch.rand(n, device=average.device) >= self.config.mixing] = n_codes
        is_fine = torch.arange(n_codes, device=average.device) >= first[:, None]
        return torch.where(is_fine[..., None], fine, coarse)

    def _drawn(self, codes: Float[Tensor, "b 18 c"]) -> Float[Tensor, "b 3 s s"]:
        return draw(self.generator, codes, levels=self.levels, noise="random")

    def _path_penalty(self) -> Tensor:
        """Squared deviation of |∂(image·noise)/∂w| from its running mean (StyleGAN2, Eq. 4)."""
        codes = self._codes()[: max(self.config.generator_batch // 2, 1)].requires_grad_(True)
        image = self._drawn(codes)
        noise = torch.randn_like(image) / math.sqrt(image.shape[2] * image.shape[3])
        (gradient,) = torch.autograd.grad((image * noise).sum(), codes, create_graph=True)
        length = gradient.square().sum(2).mean(1).sqrt()
        self.path_length = self.path_length.lerp(length.detach().mean(), PATH_DECAY)
        return (length - self.path_length).square().mean()

    @torch.no_grad()
    def _average(self, step: int) -> None:
        """Moves the averaged generator towards the trained one."""
        shown = (step + 1) * self.config.generator_batch
        half_life = max(min(self.config.ema_images, EMA_RAMP * shown), 1e-8)
        keep = 0.5 ** (self.config.generator_batch / half_life)
        pairs = zip(self.average.parameters(), self.generator.parameters(), strict=True)
        for mean, value in pairs:
            mean.lerp_(value, 1 - keep)


def adam(parameters: list[nn.Parameter], rate: float, lazy: float) -> torch.optim.Adam:
    """Adam as of StyleGAN2; ``lazy`` is the share of the steps that are no regularisation."""
    return torch.optim.Adam(parameters, lr=rate * lazy, betas=(0.0, 0.99**lazy))


def discriminator_adam(discriminator: Discriminator, rate: float) -> torch.optim.Adam:
    """The discriminator's optimiser, in both stages."""
    return adam(list(discriminator.parameters()), rate, R1_EVERY / (R1_EVERY + 1))


def judge(
    discriminator: Discriminator, real: Float[Tensor, "n 3 s s"], fake: Float[Tensor, "m 3 s s"]
) -> tuple[Tensor, Float[Tensor, " n"]]:
    """The discriminator's loss, and its answers to the real pictures."""
    answers = discriminator(real)
    return F.softplus(-answers).mean() + F.softplus(discriminator(fake)).mean(), answers.detach()


def r1(discriminator: Discriminator, real: Float[Tensor, "n 3 s s"], p: float = 0.0) -> Tensor:
    """Mean squared gradient of the discriminator at real pictures (Mescheder et al. 2018, R1)."""
    real = real.detach().requires_grad_(True)
    (gradient,) = torch.autograd.grad(discriminator(augment(real, p)).sum(), real, create_graph=True)
    return gradient.square().sum((1, 2, 3)).mean()


def advance(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    """One step of an optimiser down the gradient of a loss."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()
