"""The training objective, and the fast way to its gradient.

    L = l1·mean|I - G| + dssim·(1 - SSIM(I, G)) + alpha·mean((A - M)²) + mouth·(mean penalty, upper + lower)

with I the render (not clamped), G = photo × matte on the render's background, A the rendered opacity, M the matte.
The weights of ``3dgb`` are those of 3D Gaussian Blendshapes' code; ``seed`` is the variant ToonifyGB prints: the
photometric weights exchanged, and one mean over both mouth sets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.metrics import ssim

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.avatar import MouthVolume
    from toonifygb.config import TrainConfig
    from toonifygb.render.fused import Kernels
    from toonifygb.structures import Rendering


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms; ``joint_mouth_mean`` averages over both mouth sets at once."""

    l1: float
    dssim: float
    alpha: float
    mouth: float
    joint_mouth_mean: bool

    @classmethod
    def of(cls, config: TrainConfig) -> LossWeights:
        """The weights that a configuration means."""
        seed = config.loss == "seed"
        l1, dssim = (0.2, 0.8) if seed else (config.l1_weight, config.dssim_weight)
        return cls(l1, dssim, config.alpha_weight, config.mouth_weight, joint_mouth_mean=seed)


@dataclass
class LossTerms:
    """Values of one step, already weighted; they add up to ``total``."""

    photo: float
    alpha: float
    mouth: float

    @property
    def total(self) -> float:
        """The objective."""
        return self.photo + self.alpha + self.mouth


def image_loss(
    rendering: Rendering, target: Float[Tensor, "h w 3"], matte: Float[Tensor, "h w"], weights: LossWeights
) -> Float[Tensor, ""]:
    """Photometric and opacity terms, differentiable: the definition of what ``image_gradients`` computes."""
    l1 = (rendering.color - target).abs().mean()
    dssim = 1 - ssim(rendering.color, target)
    alpha = (rendering.alpha - matte).square().mean()
    return weights.l1 * l1 + weights.dssim * dssim + weights.alpha * alpha


def image_gradients(
    rendering: Rendering,
    target: Float[Tensor, "h w 3"],
    matte: Float[Tensor, "h w"],
    weights: LossWeights,
    kernels: Kernels,
) -> tuple[float, float, Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Photometric value, opacity value, and their gradients for the render's colour and opacity."""
    photo, v_color = kernels.l1_dssim(rendering.color.detach(), target, weights.l1, weights.dssim)
    apart = rendering.alpha.detach() - matte
    alpha = weights.alpha * float(apart.square().mean())
    return float(photo), alpha, v_color, apart.mul_(2 * weights.alpha / apart.numel())


def mouth_loss(
    upper: Float[Tensor, "u 3"], lower: Float[Tensor, "w 3"], volume: MouthVolume, weights: LossWeights
) -> Float[Tensor, ""]:
    """Penalty on mouth Gaussians outside the mouth, from their rest-pose centres."""
    penalties = [volume.penalty(upper), volume.penalty(lower)]
    if weights.joint_mouth_mean:
        return weights.mouth * torch.cat(penalties).mean()
    return weights.mouth * (penalties[0].mean() + penalties[1].mean())


def mouth_gradients(
    points: Float[Tensor, "n 3"], n_upper: int, volume: MouthVolume, weights: LossWeights
) -> tuple[float, Float[Tensor, "n 3"]]:
    """``mouth_loss`` of both sets, the upper one first, and its gradient, without autograd, which takes longer."""
    penalties, slopes = volume.penalty_with_gradient(points)
    n_lower, both = len(points) - n_upper, len(points)
    sizes = (both, both) if weights.joint_mouth_mean else (n_upper, n_lower)
    share = penalties.new_tensor([weights.mouth / size for size in sizes])
    share = share.repeat_interleave(torch.tensor([n_upper, n_lower], device=share.device))
    return float(penalties @ share), slopes.mul_(share[:, None])
