"""The rigid motion or similarity that best carries one set of points onto another."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor


def kabsch(
    a: Float[Tensor, "*b n 3"], b: Float[Tensor, "*b n 3"], weights: Float[Tensor, "*b n"] | None = None
) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    """Rotation R and translation t that minimise Σ w |R a + t - b|²; never a reflection.

    Args:
        a: points to move, at least three that are not on a line.
        b: where each should go.
        weights: importance of each pair, not negative; equal when ``None``.
    """
    mean_a, mean_b, covariance, _ = _moments(a, b, weights)
    rotation, _ = _best_rotation(covariance)
    return rotation, mean_b - _apply(rotation, mean_a)


def umeyama(
    a: Float[Tensor, "*b n 3"], b: Float[Tensor, "*b n 3"], weights: Float[Tensor, "*b n"] | None = None
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    """Scale s, rotation R and translation t that minimise Σ w |s R a + t - b|² (Umeyama 1991, eq. 39-42)."""
    mean_a, mean_b, covariance, variance = _moments(a, b, weights)
    rotation, gain = _best_rotation(covariance)
    scale = gain / variance
    return scale, rotation, mean_b - scale[..., None] * _apply(rotation, mean_a)


def _moments(a: Tensor, b: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weighted means, covariance Σ w (b - b̄)(a - ā)ᵀ and variance Σ w |a - ā|², weights summing to 1."""
    share = torch.ones_like(a[..., 0]) if weights is None else weights.to(a).expand(a.shape[:-1])
    share = (share / share.sum(-1, keepdim=True))[..., None]
    mean_a, mean_b = (share * a).sum(-2), (share * b).sum(-2)
    from_a, from_b = a - mean_a[..., None, :], b - mean_b[..., None, :]
    covariance = (share * from_b).mT @ from_a
    return mean_a, mean_b, covariance, (share * from_a.square()).sum((-2, -1))


def _best_rotation(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation R that maximises trace(Rᵀ C), and that maximum."""
    left, values, right = torch.linalg.svd(covariance)
    # Where the best orthogonal matrix mirrors, the weakest axis is turned the other way.
    sign = torch.ones_like(values)
    sign[..., 2] = torch.linalg.det(left @ right).sign()
    return (left * sign[..., None, :]) @ right, (values * sign).sum(-1)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None]).squeeze(-1)
