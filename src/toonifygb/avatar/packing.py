"""Deltas in a tenth of the room: only those that change something, in the fewest bits that do not show.

A blendshape of a local unit moves a part of the face, so most (Gaussian, k) pairs are exactly zero: a bit per pair
says which live, and only their values are kept. Positions are half floats, everything else is a signed byte times a
step of its own for every (blendshape, channel): the step is the largest value over 127. View-dependent colour, most
of an avatar of SH degree 3, has 15 steps and bits of its own: a third of its pairs then live no more. wojtek_1, 50k
+ 14k Gaussians, SH degree 3: 51.1 MB become 38.5, for 0.009 dB.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb.avatar.fields import FIELDS, each
from toonifygb.structures import GaussianParams

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8
    from torch import Tensor

HALF = ("means",)
"""Fields kept as half floats: a byte would move the corners of a smile in visible steps."""
LEVELS, REST_LEVELS = 127, 15
_SHAPES = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh": (-1, 3)}
REST = "sh_rest"
"""Stored beside ``sh``, which then is the base colour alone; avatars written before have all colour in ``sh``."""


def pack(deltas: GaussianParams) -> dict[str, Tensor]:
    """Tensors ``FIELD.live`` (bits), ``FIELD.values`` (pairs, channels) and ``FIELD.steps`` (K, channels).

    Args:
        deltas: of K blendshapes and n Gaussians.
    """
    packed = {}
    for name, delta in each(deltas):
        values = delta.reshape(*delta.shape[:2], -1)
        if name in HALF:
            live = (values != 0).any(-1)
            packed |= {f"{name}.live": _bits(live), f"{name}.values": values[live].half()}
        elif name == "sh":
            packed |= _stepped(name, values[..., :3], LEVELS) | _stepped(REST, values[..., 3:], REST_LEVELS)
        else:
            packed |= _stepped(name, values, LEVELS)
    return packed


def _stepped(name: str, values: Float[Tensor, "k n c"], n_levels: int) -> dict[str, Tensor]:
    """Values as multiples of a step; those of which nothing is left live no more."""
    steps = values.abs().amax(1) / n_levels
    levels = (values / steps.clamp_min(torch.finfo(steps.dtype).tiny)[:, None]).round()
    live = (levels != 0).any(-1)
    return {f"{name}.live": _bits(live), f"{name}.steps": steps, f"{name}.values": levels[live].to(torch.int8)}


def unpack(packed: dict[str, Tensor], n: int) -> GaussianParams:
    """The deltas that ``pack`` was given, to half a step.

    Args:
        packed: its tensors.
        n: Gaussians.

    Raises:
        ValueError: the tensors do not fit together.
    """
    deltas = {name: _dense(packed, name, n) for name in FIELDS}
    if f"{REST}.live" in packed:
        deltas["sh"] = torch.cat([deltas["sh"], _dense(packed, REST, n)], dim=-1)
    return GaussianParams(**{name: dense.view(*dense.shape[:2], *_SHAPES[name]) for name, dense in deltas.items()})


def _dense(packed: dict[str, Tensor], name: str, n: int) -> Float[Tensor, "k n c"]:
    live, values = _truth(packed[f"{name}.live"], n), packed[f"{name}.values"]
    dense = torch.zeros(*live.shape, values.shape[-1])
    if int(live.sum()) != len(values):
        raise ValueError(f"{name} has {len(values)} values for {int(live.sum())} pairs")
    dense[live] = values.float()
    return dense if name in HALF else dense * packed[f"{name}.steps"][:, None]


def names(with_rest: bool) -> set[str]:
    """Names of all tensors of a packed set; those of ``REST`` only where it has them."""
    fields = (*FIELDS, REST) if with_rest else FIELDS
    kinds = {name: ("live", "values") if name in HALF else ("live", "values", "steps") for name in fields}
    return {f"{name}.{kind}" for name, parts in kinds.items() for kind in parts}


def _bits(live: Tensor) -> UInt8[Tensor, "k b"]:
    """Truth values, eight to the byte, the first in the lowest bit."""
    return torch.from_numpy(np.packbits(live.numpy(), axis=1, bitorder="little"))


def _truth(bits: UInt8[Tensor, "k b"], n: int) -> Tensor:
    """The first ``n`` truth values of each row of ``_bits``."""
    return torch.from_numpy(np.unpackbits(bits.numpy(), axis=1, count=n, bitorder="little")).bool()
