"""PSNR and SSIM against their definitions written as loops."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from toonifygb.metrics import psnr, psnr_per_channel, ssim
from toonifygb.metrics.similarity import PSNR_CAP


def image(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64)


def slow_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Pixel by pixel: weighted moments over an 11x11 window, zeros outside the image."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window /= window.sum()
    a, b = (np.pad(x, ((5, 5), (5, 5), (0, 0))) for x in (a, b))
    values = []
    for row in range(a.shape[0] - 10):
        for column in range(a.shape[1] - 10):
            for channel in range(a.shape[2]):
                x, y = (z[row : row + 11, column : column + 11, channel] for z in (a, b))
                mean_x, mean_y = (window * x).sum(), (window * y).sum()
                variance_x = (window * x * x).sum() - mean_x**2
                variance_y = (window * y * y).sum() - mean_y**2
                covariance = (window * x * y).sum() - mean_x * mean_y
                luminance = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
                values.append(luminance * (2 * covariance + 9e-4) / (variance_x + variance_y + 9e-4))
    return float(np.mean(values))


@pytest.mark.parametrize("shape", [(13, 9, 3), (5, 7, 1)])
def test_ssim_agrees_with_its_definition(shape: tuple[int, int, int]):
    a = image(*shape)
    b = (a + 0.3 * image(*shape)).clamp(0, 1)
    assert float(ssim(a, b)) == pytest.approx(slow_ssim(a.numpy(), b.numpy()), abs=1e-12)


def test_ssim_is_one_for_equal_and_symmetric():
    a, b = image(2, 20, 30, 3)
    assert float(ssim(a, a)) == pytest.approx(1.0, abs=1e-12)
    torch.testing.assert_close(ssim(a, b), ssim(b, a))
    assert abs(float(ssim(a, b))) < 0.4  # unrelated noise
    assert float(ssim(a, 1 - a)) < 0  # anticorrelated


def test_ssim_falls_with_noise():
    a, noise = image(2, 40, 40, 3)
    values = [float(ssim(a, a + level * (noise - 0.5))) for level in (0.0, 0.1, 0.3, 1.0)]
    assert values == sorted(values, reverse=True) and values[-1] < 0.8


def test_clips_give_one_number_per_frame():
    a, b = image(2, 4, 16, 16, 3)
    for metric in (psnr, psnr_per_channel, ssim):
        values = metric(a, b)
        assert values.shape == (4,)
        torch.testing.assert_close(values, torch.stack([metric(x, y) for x, y in zip(a, b, strict=True)]))
        assert metric(a[None], b[None]).shape == (1, 4)


def test_ssim_has_gradients():
    a, b = image(2, 4, 3, 1)
    assert torch.autograd.gradcheck(ssim, (a.requires_grad_(), b.requires_grad_()))


def test_psnr_of_a_known_error():
    a = torch.full((8, 8, 3), 0.5)
    assert float(psnr(a, a + 0.1)) == pytest.approx(20.0, abs=1e-4)
    assert float(psnr(a, a + 1.0)) == pytest.approx(0.0, abs=1e-4)


def test_psnr_per_channel_is_the_mean_over_channels():
    a = torch.full((8, 8, 3), 0.5)
    b = a + torch.tensor([0.1, 0.01, 0.001])
    assert float(psnr_per_channel(a, b)) == pytest.approx((20 + 40 + 60) / 3, abs=1e-2)
    whole = -10 * math.log10((0.1**2 + 0.01**2 + 0.001**2) / 3)
    assert float(psnr(a, b)) == pytest.approx(whole, abs=1e-2)


def test_psnr_of_equal_images_is_the_cap_and_has_a_finite_gradient():
    a = image(8, 8, 3).requires_grad_()
    value = psnr(a, a.detach())
    assert float(value.detach()) == PSNR_CAP
    value.backward()
    assert a.grad is not None and a.grad.isfinite().all()


def test_one_level_in_one_pixel_stays_below_the_cap():
    a = torch.full((1080, 1920, 3), 0.5)
    b = a.clone()
    b[0, 0, 0] += 1 / 255
    assert 90 < float(psnr(a[:512, :512], b[:512, :512])) <= PSNR_CAP
