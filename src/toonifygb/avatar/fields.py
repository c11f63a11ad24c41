"""Doing one thing to every field of ``GaussianParams``: join, cut, flatten."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.structures import GaussianParams

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Float
    from torch import Tensor

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")
WIDTHS = {"means": 3, "quats": 4, "log_scales": 3, "opacity_logits": 1}
"""Floats per Gaussian; ``sh`` has 3 per coefficient."""


def each(params: GaussianParams) -> Iterator[tuple[str, Tensor]]:
    """Names and tensors in the order of ``FIELDS``."""
    for name in FIELDS:
        yield name, getattr(params, name)


def width(name: str, n_coefficients: int) -> int:
    """Floats per Gaussian of a field."""
    return 3 * n_coefficients if name == "sh" else WIDTHS[name]


def join(parts: list[GaussianParams], axis: int = 0) -> GaussianParams:
    """Sets behind one another: axis 0 joins neutral sets or rows of deltas, axis 1 the Gaussians of deltas."""
    return GaussianParams(**{name: torch.cat([getattr(part, name) for part in parts], axis) for name in FIELDS})


def cut(params: GaussianParams, start: int, stop: int) -> GaussianParams:
    """Gaussians ``start`` to ``stop`` of a neutral set, as views."""
    return params.map(lambda tensor: tensor[start:stop])


def cut_deltas(deltas: GaussianParams, start: int, stop: int) -> GaussianParams:
    """Gaussians ``start`` to ``stop`` of deltas, as views."""
    return deltas.map(lambda tensor: tensor[:, start:stop])


def extended(deltas: GaussianParams, n: int) -> GaussianParams:
    """Deltas with zeros for further Gaussians, up to ``n``."""

    def extend(delta: Tensor) -> Tensor:
        return torch.cat([delta, delta.new_zeros(delta.shape[0], n - delta.shape[1], *delta.shape[2:])], dim=1)

    return deltas.map(extend)


def rows(tensor: Float[Tensor, "k n *c"]) -> Float[Tensor, "k p"]:
    """Deltas of one field as the matrix that the kernels stream through; a view."""
    return tensor.flatten(1)


def last_changed(deltas: GaussianParams) -> int:
    """Number of the first Gaussians after which no delta changes anything."""
    changes = torch.zeros(deltas.opacity_logits.shape[1], dtype=torch.bool)
    for _, delta in each(deltas):
        changes |= (delta != 0).flatten(2).any(-1).any(0) if delta.ndim > 2 else (delta != 0).any(0)
    return int(changes.nonzero().max()) + 1 if bool(changes.any()) else 0
