"""How steady a clip is from frame to frame: ITF and ISI.

Both compare consecutive frames and therefore count the subject's own motion too; they rank versions of one clip
and say nothing across clips. Frames are streamed: two are held at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from toonifygb.errors import InputError
from toonifygb.metrics.similarity import psnr, ssim

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from jaxtyping import Float, UInt8
    from torch import Tensor

    Image = (
        Float[Tensor, "h w c"] | Float[np.ndarray, "h w c"] | UInt8[np.ndarray, "h w c"] | UInt8[Tensor, "h w c"]
    )


class Stability(NamedTuple):
    """Both figures of one clip."""

    itf: float
    """Inter-frame transformation fidelity: mean PSNR of consecutive frames, dB."""
    isi: float
    """Inter-frame similarity index: mean SSIM of consecutive frames."""


def itf(frames: Iterable[Image]) -> float:
    """Mean PSNR of consecutive frames, dB; equal frames count as ``similarity.PSNR_CAP``.

    Args:
        frames: at least two images of one size; uint8 0..255 or float 0..1.

    Raises:
        InputError: fewer than two frames.
    """
    return _mean([float(psnr(a, b)) for a, b in _consecutive(frames)], "ITF")


def isi(frames: Iterable[Image]) -> float:
    """Mean SSIM of consecutive frames; arguments as of ``itf``."""
    return _mean([float(ssim(a, b)) for a, b in _consecutive(frames)], "ISI")


def stability(frames: Iterable[Image]) -> Stability:
    """ITF and ISI in one pass; arguments as of ``itf``."""
    values = [(float(psnr(a, b)), float(ssim(a, b))) for a, b in _consecutive(frames)]
    return Stability(
        itf=_mean([value[0] for value in values], "ITF"),
        isi=_mean([value[1] for value in values], "ISI"),
    )


def _consecutive(frames: Iterable[Image]) -> Iterator[tuple[Tensor, Tensor]]:
    previous = None
    for frame in frames:
        current = _to_unit(frame)
        if previous is not None:
            yield previous, current
        previous = current


def _to_unit(image: Image) -> Tensor:
    """The image as floating tensor 0..1."""
    tensor = torch.from_numpy(np.ascontiguousarray(image)) if isinstance(image, np.ndarray) else image
    return tensor if tensor.is_floating_point() else tensor.float() / 255


def _mean(values: list[float], name: str) -> float:
    if not values:
        raise InputError(f"{name} compares consecutive frames and needs at least 2 frames", "give a longer clip")
    return sum(values) / len(values)
