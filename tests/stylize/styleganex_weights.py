"""Weights by seed, with statistics under which no layer explodes, saturates or dies. For tests and benchmarks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from toonifygb.stylize.styleganex import StyleGANEX

if TYPE_CHECKING:
    from torch import Tensor

    from toonifygb.stylize.styleganex import Variant

NARROW = 16
"""Divisor of channel counts at which the network runs in a fraction of a second."""


def make_network(variant: Variant, seed: int = 0) -> StyleGANEX:
    """A network whose every tensor is random but reasonable."""
    with torch.device("meta"):
        network = StyleGANEX(variant)
    rng = torch.Generator().manual_seed(seed)
    fixed = ("blur.kernel", "upsample.kernel", "blur_weight", "num_batches_tracked")
    norms = {key.rpartition(".")[0] for key in network.state_dict() if key.endswith("running_mean")}
    weights = {}
    for key, tensor in network.state_dict().items():
        if key.endswith(fixed):
            weights[key] = constant(key, tensor)
        else:
            weights[key] = drawn(key, torch.randn(tensor.shape, generator=rng), key.rpartition(".")[0] in norms)
    network.load_state_dict(weights, assign=True)
    shape = network.latent_avg.shape
    network.latent_avg = 0.5 * torch.randn(shape, generator=rng)
    network.editing_w = 0.3 * torch.randn(1, *shape, generator=rng)
    return network


def constant(key: str, like: Tensor) -> Tensor:
    """Filters and counters, which are the same in every checkpoint."""
    if key.endswith("num_batches_tracked"):
        return torch.zeros((), dtype=torch.int64)
    taps = torch.tensor([1.0, 2.0, 1.0] if key.endswith("blur_weight") else [1.0, 3.0, 3.0, 1.0])
    return (torch.outer(taps, taps) / 16).reshape(like.shape)


def drawn(key: str, n: Tensor, is_norm: bool) -> Tensor:
    """Random numbers brought to the scale that belongs to the key."""
    leaf = key.rpartition(".")[2]
    fan = math.prod(n.shape[1:]) if n.ndim > 1 else 1
    if leaf == "running_var":
        return torch.exp(0.1 * n)
    if (is_norm and leaf == "weight") or key.endswith("modulation.bias"):
        return 1.0 + 0.1 * n
    if leaf == "weight" and n.ndim == 1:
        return 0.1 * n if len(n) == 1 and "noise" in key else 0.25 + 0.05 * n
    if "decoder.style." in key:
        return (100.0 if leaf == "weight" else 10.0) * n
    if leaf in ("bias", "running_mean"):
        return 0.05 * n
    if "to_rgb" in key and key.endswith("conv.weight"):
        return 0.12 * n
    if n.ndim == 5 or key.endswith(("modulation.weight", "linear.weight", "input.input")) or "noises" in key:
        return n
    if "styles" in key:
        return n * math.sqrt(2.0 / fan)
    if key.endswith(("fusion_skip.weight", "fusion_out.weight")):
        # Mostly hands on what it is given, as a trained layer does.
        n_kept, gain, noise = (3, 1.0, 0.1) if "skip" in key else (len(n), 0.7, 1.0)
        kept = torch.zeros_like(n)
        kept[range(n_kept), range(n_kept), 1, 1] = gain
        return kept + noise * n / math.sqrt(fan)
    return n / math.sqrt(fan)
