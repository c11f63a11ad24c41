"""One flat vector for a whole set of Gaussians: the memory layout that blending and its optimiser stream through.

A set of n Gaussians with k SH coefficients is the vector ``[means 3n | quats 4n | log_scales 3n |
opacity_logits n | sh 3kn]``; each part is the C-contiguous array of ``GaussianParams``. Deltas are rows of such
vectors, one row per blendshape, so that ``B0 + Σ ψk ΔBk`` is one matrix-vector product.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.structures import GaussianParams

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")
"""The order of the parts."""


def widths(n_coefficients: int) -> dict[str, int]:
    """Floats per Gaussian of each part."""
    return {"means": 3, "quats": 4, "log_scales": 3, "opacity_logits": 1, "sh": 3 * n_coefficients}


def slices(n: int, n_coefficients: int) -> dict[str, slice]:
    """Where each part of ``n`` Gaussians lies in the flat vector."""
    places, start = {}, 0
    for name, width in widths(n_coefficients).items():
        places[name] = slice(start, start + width * n)
        start += width * n
    return places


def flatten(params: GaussianParams) -> Float[Tensor, "*e p"]:
    """Copy of the parameters in the flat layout; a leading delta axis is kept."""
    lead = params.opacity_logits.shape[:-1]
    return torch.cat([getattr(params, name).reshape(*lead, -1) for name in FIELDS], dim=-1)


def unflatten(flat: Float[Tensor, "*e p"], n: int, n_coefficients: int) -> GaussianParams:
    """View of a flat vector (or of rows of them) as named parameters; nothing is copied."""
    lead = flat.shape[:-1]
    shapes = {
        "means": (n, 3),
        "quats": (n, 4),
        "log_scales": (n, 3),
        "opacity_logits": (n,),
        "sh": (n, n_coefficients, 3),
    }
    parts = slices(n, n_coefficients)
    return GaussianParams(**{name: flat[..., parts[name]].reshape(*lead, *shapes[name]) for name in FIELDS})
