"""Pure image maths; the only SSIM in the house."""

from toonifygb.metrics.similarity import psnr, psnr_per_channel, ssim
from toonifygb.metrics.stability import Stability, isi, itf, stability

__all__ = ["Stability", "isi", "itf", "psnr", "psnr_per_channel", "ssim", "stability"]
