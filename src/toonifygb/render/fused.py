"""Fused pieces of a training step, and their definition in plain torch.

Parameters live in one flat vector of p floats (everything of the neutral Gaussians, activations not yet applied);
the deltas ΔB_k of the K expression blendshapes are a matrix of K such rows. One frame's gradient with respect to
row k is ψ_k·g, g being the gradient of the blended vector, so a step needs g alone and never the K×p gradient.
A step over several frames sums their ψ_k·g.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import torch

from toonifygb import metrics
from toonifygb.geometry import rotations, skinning
from toonifygb.structures import GaussianParams, Splats

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, UInt8
    from torch import Tensor

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15
"""Adam's constants in 3DGS and 3DGB."""


class Kernels(Protocol):
    """What a training step computes besides rendering. Steps change their tensors in place."""

    name: str
    device: torch.device
    """Where the tensors given to it have to be."""

    def blend(
        self,
        base: Float[Tensor, " p"],
        deltas: Float[Tensor, "k p"],
        psi: Float[Tensor, " k"],
        *,
        out: Float[Tensor, " p"] | None = None,
    ) -> Float[Tensor, " p"]:
        """B = B0 + Σ ψ_k ΔB_k (Eq. 2 of ToonifyGB); rows whose ψ_k is 0 are not read.

        Args:
            base: B0.
            deltas: float32, or bfloat16 to halve the memory traffic.
            psi: expression coefficients.
            out: where to put the result; may be ``base``.
        """
        ...

    def add_blends(
        self, out: Float[Tensor, "b q"], deltas: Float[Tensor, "k p"], psi: Float[Tensor, "b k"]
    ) -> None:
        """out_b += Σ_k ψ_bk ΔB_k for several frames at once: the deltas are read only once.

        Args:
            out: changed in place, its first p columns.
            deltas: float32.
            psi: expression coefficients of each frame.
        """
        ...

    def adam_step(
        self,
        parameters: Float[Tensor, " p"],
        first_moment: Float[Tensor, " p"],
        second_moment: Float[Tensor, " p"],
        gradient: Float[Tensor, " p"],
        learning_rates: Float[Tensor, " p"],
        step: int,
        *,
        factor: float = 1.0,
        eps: float = EPS,
    ) -> None:
        """One step of Adam with a learning rate per parameter.

        Args:
            parameters: changed in place, like both moments.
            first_moment: running mean of the gradient.
            second_moment: running mean of its square.
            gradient: of the loss.
            learning_rates: see ``learning_rates``.
            step: number of this step, from 1.
            factor: of all learning rates.
            eps: added to the root of the second moment; gradients well below it hardly move anything.
        """
        ...

    def blend_adam_step(
        self,
        deltas: Float[Tensor, "k p"],
        first_moment: Float[Tensor, "k p"],
        second_moment: Float[Tensor, "k p"],
        psi: Float[Tensor, "b k"],
        gradient: Float[Tensor, "b p"],
        learning_rates: Float[Tensor, " p"],
        step: int,
        *,
        factor: float = 1.0,
        eps: float = EPS,
        scale: Float[Tensor, "k n"] | None = None,
        widths: Sequence[int] = (),
        skip_inactive: bool = False,
    ) -> None:
        """One step of Adam on all deltas with the gradient Σ_b ψ_bk·g_b of row k, over the frames b.

        ``scale`` is 3DGB's blendshape consistency. There the trained tensor is Δ̂_k and the delta applied is
        scale·Δ̂_k; here ``deltas`` are the applied ones. Adam does not feel a constant factor of its gradient (up to
        eps), so its step on Δ̂_k is the plain step, and on the applied delta it is the plain step times scale.

        Args:
            deltas: ΔB_k, changed in place, like both moments.
            first_moment: running mean of Σ_b ψ_bk·g_b.
            second_moment: running mean of its square.
            psi: expression coefficients of each frame.
            gradient: g of each frame, with respect to the blended parameters.
            learning_rates: per parameter.
            step: number of this step, from 1.
            factor: of all learning rates.
            eps: added to the root of the second moment; gradients well below it hardly move anything.
            scale: factor of the step per row and Gaussian; where it is 0 the delta stays as it is, and its moments
                mean nothing.
            widths: floats per Gaussian of each parameter group in the flat vector, in order; needed with ``scale``.
            skip_inactive: leave rows with ψ_k = 0 in all frames as they are, moments included, instead of coasting
                on momentum.
        """
        ...

    def skin(
        self, raw: GaussianParams, weights: Float[Tensor, "n 5"], transforms: Float[Tensor, "5 4 4"]
    ) -> Splats:
        """Splats of raw Gaussians moved by linear blend skinning, without autograd.

        The weighted sum of the joints' maps moves the centre as it is; orientation and harmonics (``sh_frames``)
        are turned by its rotation factor, three Newton steps of the polar decomposition as in 3DGB.

        Args:
            raw: in the rest pose.
            weights: of each Gaussian to the joints, rows sum to 1.
            transforms: rest to pose.
        """
        ...

    def skin_gradient(
        self,
        raw: GaussianParams,
        weights: Float[Tensor, "n 5"],
        transforms: Float[Tensor, "5 4 4"],
        gradient: Splats,
    ) -> GaussianParams:
        """Gradient with respect to ``raw`` from the one with respect to the splats of ``skin``.

        ``weights`` and ``transforms`` are constants; ``gradient.sh_frames`` is therefore not used.
        """
        ...

    def place(
        self,
        frame: UInt8[Tensor, "y x 3"],
        matte: Float[Tensor, "y x"],
        background: Float[Tensor, " 3"],
        factor: int = 1,
    ) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
        """See ``place``."""
        ...

    def l1_dssim(
        self,
        image: Float[Tensor, "h w 3"],
        target: Float[Tensor, "h w 3"],
        l1_weight: float = 0.8,
        dssim_weight: float = 0.2,
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "h w 3"]]:
        """l1_weight·mean|image − target| + dssim_weight·(1 − SSIM), and its gradient with respect to ``image``."""
        ...


def place(
    frame: UInt8[Tensor, "y x 3"], matte: Float[Tensor, "y x"], background: Float[Tensor, " 3"], factor: int = 1
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """The picture that a rendering is compared with: a frame cut out by its matte, on a background.

    Args:
        frame: sRGB bytes.
        matte: share of each pixel that belongs to the head, 0..1.
        background: RGB 0..1.
        factor: the result is smaller by this whole number, which divides both sides; pixels are averaged.

    Returns:
        Colours and matte, 0..1.
    """
    color = torch.lerp(background.expand(*matte.shape, 3), frame.to(matte.dtype) / 255, matte[..., None])
    if factor == 1:
        return color, matte
    height, width = (side // factor for side in matte.shape)
    squares = (height, factor, width, factor)
    return color.view(*squares, 3).mean((1, 3)), matte.reshape(squares).mean((1, 3))


def learning_rates(widths: Sequence[int], rates: Sequence[float | Sequence[float]], n: int) -> Float[Tensor, " p"]:
    """Learning rate of every parameter of a flat vector of groups.

    Args:
        widths: floats per Gaussian of each group.
        rates: one rate per group, or one per float of the group (SH: the DC trains faster than the rest).
        n: number of Gaussians.
    """
    parts = []
    for width, rate in zip(widths, rates, strict=True):
        parts.append(torch.as_tensor(rate, dtype=torch.float32).expand(width).repeat(n))
    return torch.cat(parts)


def expand_scale(scale: Float[Tensor, "k n"], widths: Sequence[int]) -> Float[Tensor, "k p"]:
    """Scale of every parameter from the scale of every Gaussian."""
    return torch.cat([scale.repeat_interleave(width, dim=1) for width in widths], dim=1)


def check_blend_step(deltas: Tensor, scale: Tensor | None, widths: Sequence[int]) -> None:
    """Makes sure that groups and scale fill the rows of ``deltas``.

    Raises:
        ValueError: they do not.
    """
    if scale is None:
        return
    k, p = deltas.shape
    if scale.shape[0] != k or scale.shape[1] * sum(widths) != p:
        raise ValueError(
            f"scale has shape {tuple(scale.shape)} and widths sum to {sum(widths)}, "
            f"expected ({k}, n) with n · sum(widths) = {p}"
        )


class ReferenceKernels:
    """The definition of every kernel, in plain torch, any floating dtype and on any device.

    Args:
        device: what ``Kernels.device`` says; callers bring their tensors there.
    """

    name = "reference"

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)

    def blend(
        self,
        base: Float[Tensor, " p"],
        deltas: Float[Tensor, "k p"],
        psi: Float[Tensor, " k"],
        *,
        out: Float[Tensor, " p"] | None = None,
    ) -> Float[Tensor, " p"]:
        """See ``Kernels.blend``."""
        active = psi.nonzero()[:, 0]
        blended = base + psi[active] @ deltas[active].to(base.dtype)
        return blended if out is None else out.copy_(blended)

    def add_blends(
        self, out: Float[Tensor, "b q"], deltas: Float[Tensor, "k p"], psi: Float[Tensor, "b k"]
    ) -> None:
        """See ``Kernels.add_blends``."""
        out[:, : deltas.shape[1]].addmm_(psi, deltas)

    def adam_step(
        self,
        parameters: Float[Tensor, " p"],
        first_moment: Float[Tensor, " p"],
        second_moment: Float[Tensor, " p"],
        gradient: Float[Tensor, " p"],
        learning_rates: Float[Tensor, " p"],
        step: int,
        *,
        factor: float = 1.0,
        eps: float = EPS,
    ) -> None:
        """See ``Kernels.adam_step``."""
        first_moment.mul_(BETA1).add_((1 - BETA1) * gradient)
        second_moment.mul_(BETA2).add_((1 - BETA2) * gradient * gradient)
        mean, square = first_moment / (1 - BETA1**step), second_moment / (1 - BETA2**step)
        parameters.sub_(factor * learning_rates * mean / (square.sqrt() + eps))

    def blend_adam_step(
        self,
        deltas: Float[Tensor, "k p"],
        first_moment: Float[Tensor, "k p"],
        second_moment: Float[Tensor, "k p"],
        psi: Float[Tensor, "b k"],
        gradient: Float[Tensor, "b p"],
        learning_rates: Float[Tensor, " p"],
        step: int,
        *,
        factor: float = 1.0,
        eps: float = EPS,
        scale: Float[Tensor, "k n"] | None = None,
        widths: Sequence[int] = (),
        skip_inactive: bool = False,
    ) -> None:
        """See ``Kernels.blend_adam_step``."""
        check_blend_step(deltas, scale, widths)
        for k in range(len(deltas)):
            if skip_inactive and not psi[:, k].any():
                continue
            if scale is None:
                live, rates = torch.ones_like(learning_rates, dtype=torch.bool), learning_rates
            else:
                rates = learning_rates * expand_scale(scale[k : k + 1], widths)[0]
                live = rates != 0
            delta, first, second = deltas[k][live], first_moment[k][live], second_moment[k][live]
            slope = psi[:, k] @ gradient[:, live]
            self.adam_step(delta, first, second, slope, rates[live], step, factor=factor, eps=eps)
            deltas[k, live], first_moment[k, live], second_moment[k, live] = delta, first, second

    def skin(
        self, raw: GaussianParams, weights: Float[Tensor, "n 5"], transforms: Float[Tensor, "5 4 4"]
    ) -> Splats:
        """See ``Kernels.skin``."""
        maps = skinning.blend_transforms(weights, transforms)
        linear, translation = maps[:, :3, :3], maps[:, :3, 3]
        rotation = rotations.polar_factor(linear)
        turn = rotations.matrix_to_quat(rotation)
        return Splats(
            means=torch.einsum("nij,nj->ni", linear, raw.means) + translation,
            quats=rotations.quat_multiply(turn, rotations.quat_normalize(raw.quats)),
            scales=raw.log_scales.exp(),
            opacities=raw.opacity_logits.sigmoid(),
            sh=raw.sh,
            sh_frames=rotation,
        )

    def skin_gradient(
        self,
        raw: GaussianParams,
        weights: Float[Tensor, "n 5"],
        transforms: Float[Tensor, "5 4 4"],
        gradient: Splats,
    ) -> GaussianParams:
        """See ``Kernels.skin_gradient``."""
        with torch.enable_grad():
            variables = raw.map(lambda tensor: tensor.detach().requires_grad_())
            splats = self.skin(variables, weights, transforms)
            inputs = [variables.means, variables.quats, variables.log_scales, variables.opacity_logits]
            outputs = [splats.means, splats.quats, splats.scales, splats.opacities]
            upstream = [gradient.means, gradient.quats, gradient.scales, gradient.opacities]
            found = torch.autograd.grad(outputs, inputs, upstream)
        return GaussianParams(*found, sh=gradient.sh)

    def place(
        self,
        frame: UInt8[Tensor, "y x 3"],
        matte: Float[Tensor, "y x"],
        background: Float[Tensor, " 3"],
        factor: int = 1,
    ) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
        """See ``place``."""
        return place(frame, matte, background, factor)

    def l1_dssim(
        self,
        image: Float[Tensor, "h w 3"],
        target: Float[Tensor, "h w 3"],
        l1_weight: float = 0.8,
        dssim_weight: float = 0.2,
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "h w 3"]]:
        """See ``Kernels.l1_dssim``."""
        with torch.enable_grad():
            variable = image.detach().requires_grad_()
            l1 = (variable - target).abs().mean()
            loss = l1_weight * l1 + dssim_weight * (1 - metrics.ssim(variable, target))
            (gradient,) = torch.autograd.grad(loss, variable)
        return loss.detach(), gradient
