"""Agreement with the reference implementation's arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from toonifygb.metrics import isi, itf, psnr, ssim

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.golden
CASES = [(torch.float64, 1e-9), (torch.float32, 1e-5)]
"""Tolerances stated with the arrays; float32 dB carry the logarithm's ten-fold."""


def arrays(folder: Path, suffix: str) -> list[dict[str, np.ndarray]]:
    files = sorted((folder / "gaussian_blendshapes").glob(f"*_{suffix}.npz"))
    if not files:
        pytest.skip(f"no *_{suffix}.npz in {folder / 'gaussian_blendshapes'}")
    return [dict(np.load(file)) for file in files]


@pytest.mark.parametrize(("dtype", "atol"), CASES)
def test_metrics_of_a_tiny_video(golden_dir: Path, dtype: torch.dtype, atol: float):
    for g in arrays(golden_dir, "metrics"):
        frames = torch.from_numpy(g["frames"]).to(dtype)
        assert itf(frames) == pytest.approx(float(g["itf"]), abs=10 * atol)
        assert isi(frames) == pytest.approx(float(g["isi"]), abs=atol)
        assert float(psnr(frames[0], frames[1])) == pytest.approx(float(g["psnr01"]), abs=10 * atol)
        assert float(ssim(frames[0], frames[1])) == pytest.approx(float(g["ssim01"]), abs=atol)
        assert float(ssim(frames[0], frames[0])) == pytest.approx(float(g["ssim_self"]), abs=atol)


@pytest.mark.parametrize(("dtype", "atol"), CASES)
def test_ssim_of_a_rendering(golden_dir: Path, dtype: torch.dtype, atol: float):
    for g in arrays(golden_dir, "render"):
        image = torch.from_numpy(g["image"]).to(dtype)
        target = torch.from_numpy(g["target"] * g["mask"][..., None]).to(dtype)
        assert 1 - float(ssim(image, target)) == pytest.approx(float(g["loss_dssim"]), abs=atol)
