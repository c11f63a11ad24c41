"""The training kernels on a CUDA device: Triton where memory traffic decides, torch for the rest.

``ReferenceKernels`` is the definition and does what is not overridden here; it is plain torch on any device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.rotations import quat_multiply, quat_normalize
from toonifygb.metrics.similarity import SSIM_C1, SSIM_C2, ssim_window
from toonifygb.render import cuda
from toonifygb.render.fused import BETA1, BETA2, EPS, ReferenceKernels, check_blend_step
from toonifygb.structures import GaussianParams, Splats

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float
    from torch import Tensor

BLOCK = 1024
"""Floats that one program of an elementwise kernel works on."""
SKIN_BLOCK = 128
"""Gaussians that one program skins."""


class CudaKernels(ReferenceKernels):
    """See ``toonifygb.render.fused.Kernels``; all tensors float32, contiguous and on ``device``.

    Raises:
        BackendError: there is no CUDA device or no Triton.
    """

    name = "cuda"

    def __init__(self) -> None:
        cuda.require("cuda")
        super().__init__(cuda.device())
        self._window = torch.tensor(ssim_window(), device=self.device)

    def blend(
        self,
        base: Float[Tensor, " p"],
        deltas: Float[Tensor, "k p"],
        psi: Float[Tensor, " k"],
        *,
        out: Float[Tensor, " p"] | None = None,
    ) -> Float[Tensor, " p"]:
        """See ``Kernels.blend``."""
        k, p = deltas.shape
        out = torch.empty_like(base) if out is None else out
        self._check(p, k, base=base, deltas=deltas, psi=psi, out=out)
        if p:
            cuda.triton_kernels().blend[(-(-p // BLOCK),)](base, deltas, psi, out, k, p, BLOCK=BLOCK)
        return out

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
        psi = torch.ones(1, 1, device=parameters.device)
        state = (parameters[None], first_moment[None], second_moment[None])
        self.blend_adam_step(*state, psi, gradient[None], learning_rates, step, factor=factor, eps=eps)

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
        (k, p), frames = deltas.shape, len(psi)
        state = {"deltas": deltas, "first_moment": first_moment, "second_moment": second_moment}
        self._check(p, k, **state, learning_rates=learning_rates)
        for name, tensor, shape in (("psi", psi, (frames, k)), ("gradient", gradient, (frames, p))):
            self._check_one(name, tensor, shape)
        n, groups = (p, (1,)) if scale is None else (scale.shape[1], tuple(widths))
        start = 0
        for width in groups:
            count = n * width
            if k and count:
                cuda.triton_kernels().adam[(-(-count // BLOCK), k)](
                    *state.values(),
                    psi,
                    gradient,
                    learning_rates,
                    psi if scale is None else scale,
                    p,
                    start,
                    count,
                    n,
                    k,
                    width,
                    factor,
                    eps,
                    1 / (1 - BETA1**step),
                    1 / (1 - BETA2**step),
                    BETA1=BETA1,
                    BETA2=BETA2,
                    SCALED=scale is not None,
                    SKIP=skip_inactive,
                    FRAMES=frames,
                    BLOCK=BLOCK,
                )
            start += count

    def skin(
        self, raw: GaussianParams, weights: Float[Tensor, "n 5"], transforms: Float[Tensor, "5 4 4"]
    ) -> Splats:
        """See ``Kernels.skin``."""
        linear, shift, rotation, turn = self._skin_maps(weights, transforms)
        return Splats(
            means=(linear * raw.means[:, None, :]).sum(-1) + shift,
            quats=quat_multiply(turn, quat_normalize(raw.quats)),
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
        """See ``Kernels.skin_gradient``: products with a constant are undone by its transpose or conjugate."""
        linear, _, _, turn = self._skin_maps(weights, transforms)
        length = raw.quats.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        unit = raw.quats / length
        pull = quat_multiply(turn * turn.new_tensor([1.0, -1.0, -1.0, -1.0]), gradient.quats)
        opacities = raw.opacity_logits.sigmoid()
        return GaussianParams(
            means=(linear * gradient.means[:, :, None]).sum(1),
            quats=(pull - unit * (unit * pull).sum(-1, keepdim=True)) / length,
            log_scales=gradient.scales * raw.log_scales.exp(),
            opacity_logits=gradient.opacities * opacities * (1 - opacities),
            sh=gradient.sh,
        )

    def _skin_maps(self, weights: Tensor, transforms: Tensor) -> list[Tensor]:
        """Each Gaussian's linear map, translation, rotation factor, and that as a quaternion."""
        n, joints = weights.shape
        maps = [weights.new_empty(n, *shape) for shape in ((3, 3), (3,), (3, 3), (4,))]
        if n:
            grid = (-(-n // SKIN_BLOCK),)
            inputs = (weights.contiguous(), transforms.contiguous())
            cuda.triton_kernels().skin_maps[grid](*inputs, *maps, n, JOINTS=joints, BLOCK=SKIN_BLOCK)
        return maps

    def l1_dssim(
        self,
        image: Float[Tensor, "h w 3"],
        target: Float[Tensor, "h w 3"],
        l1_weight: float = 0.8,
        dssim_weight: float = 0.2,
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "h w 3"]]:
        """See ``Kernels.l1_dssim``; the gradient of SSIM is written out, so that nothing is recorded.

        With m = G∗x the smoothed moments and S = A1·A2 / (B1·B2), A1 = 2 mₐm_b + C1, B1 = mₐ² + m_b² + C1,
        A2 = 2 cov + C2, B2 = varₐ + var_b + C2, the adjoint of the symmetric smoothing is the smoothing itself.
        """
        a, b = image.detach(), target
        mean_a, mean_b, square_a, square_b, product = self._smooth(torch.stack([a, b, a * a, b * b, a * b]))
        a1 = 2 * mean_a * mean_b + SSIM_C1
        b1 = mean_a * mean_a + mean_b * mean_b + SSIM_C1
        a2 = 2 * (product - mean_a * mean_b) + SSIM_C2
        b2 = square_a - mean_a * mean_a + square_b - mean_b * mean_b + SSIM_C2
        both = 1 / (b1 * b2)
        ssim = a1 * a2 * both
        by_square = -ssim / b2
        by_product = 2 * a1 * both
        by_mean = 2 * mean_b * (a2 - a1) * both + 2 * mean_a * ssim * (1 / b2 - 1 / b1)
        by_mean, by_square, by_product = self._smooth(torch.stack([by_mean, by_square, by_product]))
        slope = by_mean + 2 * a * by_square + b * by_product
        apart = a - b
        loss = l1_weight * apart.abs().mean() + dssim_weight * (1 - ssim.mean())
        return loss, (l1_weight * apart.sign() - dssim_weight * slope) / a.numel()

    def _smooth(self, images: Float[Tensor, "m h w 3"]) -> Float[Tensor, "m h w 3"]:
        """Images under SSIM's window: two one-dimensional passes, zeros outside."""
        _, height, width, channels = images.shape
        n, grid = images.numel(), (-(-images.numel() // BLOCK),)
        taps = {"TAPS": len(self._window), "BLOCK": BLOCK}
        half, done = torch.empty_like(images), torch.empty_like(images)
        cuda.triton_kernels().smooth[grid](images, self._window, half, n, height, width * channels, **taps)
        cuda.triton_kernels().smooth[grid](half, self._window, done, n, width, channels, **taps)
        return done

    def _check(self, p: int, k: int, **tensors: Tensor) -> None:
        """Makes sure that the kernels can use tensors as they are.

        Raises:
            ValueError: one has another shape, dtype, device or memory layout.
        """
        for name, tensor in tensors.items():
            shape = {"psi": (k,), "base": (p,), "out": (p,), "learning_rates": (p,)}.get(name, (k, p))
            self._check_one(name, tensor, shape)

    def _check_one(self, name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
        dtypes = (torch.float32, torch.bfloat16) if name == "deltas" else (torch.float32,)
        usable = tensor.dtype in dtypes and tensor.device.type == self.device.type and tensor.is_contiguous()
        if not usable or tuple(tensor.shape) != shape:
            found = f"{tensor.dtype} {tuple(tensor.shape)} on {tensor.device}"
            raise ValueError(f"{name} is {found}, expected contiguous {dtypes[0]} {shape} on {self.device}")
