"""What one core of this machine can do at most: the floors under the figures."""

from __future__ import annotations

from functools import cache

import torch

from benchmarks.harness import cpu_seconds
from toonifygb.render import library


@cache
def flops() -> float:
    """Fused multiply-adds in registers with the widest vectors, floating-point operations per second."""
    engine = library.load()
    operations = 0.0

    def spin() -> None:
        nonlocal operations
        operations = engine.tgb_measure_flops()

    seconds = cpu_seconds(spin)
    return operations / seconds


@cache
def bandwidth() -> float:
    """Reading and writing memory far larger than the caches with a fused add, bytes per second."""
    x = torch.zeros(16_000_000)
    return 2 * x.numel() * 4 / cpu_seconds(lambda: x.add_(1.0))
