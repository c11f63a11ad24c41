"""How alike two images are: PSNR and SSIM, for losses and for tables.

Images are float, 0..1, channels last. Leading axes are kept: one image gives one number, a clip one per frame.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

PSNR_CAP = 100.0
"""dB given to images that agree to 1e-5 or better, where the true value runs to infinity and would make every
mean infinite. Two different 8-bit images of up to 4 megapixels in colour stay below it."""
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2


def psnr(a: Float[Tensor, "*b h w c"], b: Float[Tensor, "*b h w c"]) -> Float[Tensor, "*b"]:
    """Peak signal-to-noise ratio of each image pair, all channels in one mean; dB, at most ``PSNR_CAP``."""
    return _decibel((a - b).square().mean((-3, -2, -1)))


def psnr_per_channel(a: Float[Tensor, "*b h w c"], b: Float[Tensor, "*b h w c"]) -> Float[Tensor, "*b"]:
    """Mean over the channels of each channel's PSNR, dB: the variant 3DGB reports, some 0.01 dB higher."""
    return _decibel((a - b).square().mean((-3, -2))).mean(-1)


def ssim(a: Float[Tensor, "*b h w c"], b: Float[Tensor, "*b h w c"]) -> Float[Tensor, "*b"]:
    """Structural similarity of each image pair, -1..1, as 3DGS and 3DGB compute it.

    Window 11×11 Gaussian of σ 1.5, borders padded with zeros, biased variances, C1 = 0.01², C2 = 0.03²; mean over
    pixels and channels. Differentiable in both images.
    """
    a, b = a.movedim(-1, -3), b.movedim(-1, -3)
    mean_a, mean_b, square_a, square_b, product = _blur(torch.stack((a, b, a * a, b * b, a * b)))
    variance_a, variance_b = square_a - mean_a * mean_a, square_b - mean_b * mean_b
    covariance = product - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a * mean_a + mean_b * mean_b + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)
    return (luminance * structure).mean((-3, -2, -1))


def _decibel(mean_square: Tensor) -> Tensor:
    return -10 * mean_square.clamp_min(10 ** (-PSNR_CAP / 10)).log10()


def _blur(images: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """Images under the SSIM window: two one-dimensional passes, zeros outside."""
    # All images as channels of one: depthwise convolution is some 25 times faster than as many single channels.
    channels = images.reshape(1, -1, *images.shape[-2:])
    n, half = channels.shape[1], SSIM_WINDOW // 2
    kernel = torch.tensor(ssim_window(), dtype=images.dtype, device=images.device).expand(n, 1, -1)
    channels = torch.nn.functional.conv2d(channels, kernel[..., :, None], padding=(half, 0), groups=n)
    channels = torch.nn.functional.conv2d(channels, kernel[..., None, :], padding=(0, half), groups=n)
    return channels.reshape(images.shape)


@cache
def ssim_window() -> tuple[float, ...]:
    """Weights of the Gaussian that SSIM looks through, summing to 1."""
    half = SSIM_WINDOW // 2
    weights = [math.exp(-(offset**2) / (2 * SSIM_SIGMA**2)) for offset in range(-half, half + 1)]
    return tuple(weight / sum(weights) for weight in weights)
