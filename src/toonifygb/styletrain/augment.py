"""Adaptive augmentation (ADA, Karras et al. 2020b): what lets a discriminator learn from a few pictures.

Both real and drawn pictures are augmented before the discriminator sees them, each augmentation with the same
probability p. Up to p of about 0.8 none of them leaks into what is drawn. p follows how far the discriminator has
begun to learn the real pictures by heart.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

MAX_SHIFT = 0.125
"""Farthest translation, in sides of the picture."""
BRIGHTNESS, CONTRAST, SATURATION = 0.2, 0.5 * math.log(2.0), math.log(2.0)
"""Standard deviations of the shift, and of the logarithms of the factors."""
MOST = 0.8
"""Largest probability; beyond it augmentations begin to show in what is drawn."""
INTERVAL = 4
"""Batches between two changes of the probability."""


class Controller:
    """Keeps r = mean sign(D(real)) at a target by moving the probability of augmentations.

    Args:
        target: of r; higher values mean that the discriminator may know the pictures better.
        n_images: real pictures shown while the probability may move by 1.
    """

    def __init__(self, target: float, n_images: int) -> None:
        self.target, self.n_images = target, n_images
        self.p = 0.0
        """Probability of each augmentation."""
        self.sum, self.count, self.batches = 0.0, 0, 0

    def observe(self, real: Float[Tensor, " n"]) -> None:
        """Takes in the discriminator's answers to a batch of real pictures."""
        self.sum += float(real.sign().sum())
        self.count += len(real)
        self.batches += 1
        if self.batches == INTERVAL:
            step = math.copysign(self.count / self.n_images, self.sum / self.count - self.target)
            self.p = min(max(self.p + step, 0.0), MOST)
            self.sum, self.count, self.batches = 0.0, 0, 0

    def state(self) -> dict[str, float]:
        """Everything ``restore`` needs."""
        return {"p": self.p, "sum": self.sum, "count": self.count, "batches": self.batches}

    def restore(self, state: dict[str, float]) -> None:
        """Goes on from a ``state``."""
        self.p, self.sum = float(state["p"]), float(state["sum"])
        self.count, self.batches = int(state["count"]), int(state["batches"])


def augment(images: Float[Tensor, "n 3 s s"], p: float) -> Float[Tensor, "n 3 s s"]:
    """The pictures, each augmentation applied to each of them with probability ``p``; differentiable.

    Args:
        images: RGB in -1..1.
        p: 0 gives the pictures as they are.
    """
    return images if p <= 0 else _colored(_shifted(_flipped(images, p), p), p)


def _chosen(images: Tensor, p: float) -> Tensor:
    """1.0 for the pictures an augmentation is applied to."""
    return (torch.rand(len(images), device=images.device) < p).to(images)


def _flipped(images: Tensor, p: float) -> Tensor:
    """Mirrored left to right, half of those chosen."""
    turned = _chosen(images, p / 2)[:, None, None, None]
    return torch.where(turned > 0, images.flip(3), images)


def _shifted(images: Tensor, p: float) -> Tensor:
    """Moved by whole px in x and y; what comes in is the mirror image."""
    n, _, height, width = images.shape
    reach = round(MAX_SHIFT * width)
    shift = torch.rand(2, n, device=images.device).mul(2 * reach + 1).floor().sub(reach) * _chosen(images, p)
    wide = F.pad(images, (reach,) * 4, mode="reflect")
    rows = (torch.arange(height, device=images.device) + reach - shift[0, :, None]).long()
    columns = (torch.arange(width, device=images.device) + reach - shift[1, :, None]).long()
    index = torch.arange(n, device=images.device)[:, None, None]
    return wide.permute(0, 2, 3, 1)[index, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


def _colored(images: Tensor, p: float) -> Tensor:
    """Brightness, contrast, hue and saturation, as one affine map of RGB per picture."""
    n, like = len(images), images

    def normal(deviation: float) -> Tensor:
        return torch.randn(n, device=like.device, dtype=like.dtype) * deviation * _chosen(like, p)

    offset = normal(BRIGHTNESS)
    contrast, saturation = normal(CONTRAST).exp(), normal(SATURATION).exp()
    angle = (torch.rand(n, device=like.device, dtype=like.dtype) * 2 - 1) * math.pi * _chosen(like, p)
    matrix = hue_and_saturation(angle, saturation) * contrast[:, None, None]
    return torch.einsum("nij,njhw->nihw", matrix, images) + (offset * contrast)[:, None, None, None]


def hue_and_saturation(angle: Float[Tensor, " n"], saturation: Float[Tensor, " n"]) -> Float[Tensor, "n 3 3"]:
    """Matrices that turn colours about the grey axis and stretch them away from it (Rodrigues' formula)."""
    axis = torch.full((3,), 1 / math.sqrt(3.0), device=angle.device, dtype=angle.dtype)
    grey = torch.outer(axis, axis)
    x, y, z = axis.tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], device=angle.device, dtype=angle.dtype)
    identity = torch.eye(3, device=angle.device, dtype=angle.dtype)
    colors = angle.cos()[:, None, None] * (identity - grey) + angle.sin()[:, None, None] * cross
    return grey + saturation[:, None, None] * colors
