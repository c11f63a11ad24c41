"""StyleGANEX at full width: cost of a frame, plain and specialised to a clip, and what shortcuts cost in quality.

Part of ``python -m benchmarks stylize``, and to be had alone. Takes about half an hour, most of it for compiling.

Weights come from a seeded generator (``tests/stylize/styleganex_weights.py``), so no file is needed; the arithmetic
does not depend on what they are. Decibels are those of clamped images in -1..1 against the plain network.
"""

from __future__ import annotations

import math
import runpy
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.harness import ROOT, Figure, cpu_seconds
from toonifygb.stylize.styleganex import PUBLISHED
from toonifygb.stylize.styleganex.fast import compile_clip
from toonifygb.threads import one_torch_thread

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from toonifygb.stylize.styleganex import StyleGANEX

SIZES = (352, 512)
"""Sides of square network inputs: a face of a typical 512 px clip, and the largest that the procedure makes."""
NAMES = {torch.float32: "float32", torch.bfloat16: "bfloat16"}
MATRIX = 2048
CORES = 2
"""Threads of the figures in wall time."""


def run() -> list[Figure]:
    """Seconds of one core per frame, dB, GB, and multiply-adds per second beside a large matrix product's."""
    with one_torch_thread():
        return measured()


def seeded_network() -> StyleGANEX:
    """The network of full width with weights from a seed."""
    make = runpy.run_path(str(ROOT / "tests" / "stylize" / "styleganex_weights.py"))["make_network"]
    return make(PUBLISHED["toonify"]).requires_grad_(False)


def measured() -> list[Figure]:
    """All figures."""
    network = seeded_network()
    peaks = {dtype: matmul_rate(dtype) for dtype in NAMES}
    rng = torch.Generator().manual_seed(1)
    face = smooth_image(256, rng)
    with torch.inference_mode():
        w_plus = network.codes(face)
        figures = [Figure(f"matrix product, {name}", peaks[dtype] / 1e9, "GMAC/s") for dtype, name in NAMES.items()]
        figures.append(Figure("style codes, once per clip", cpu_seconds(lambda: network.codes(face)), "s"))
        figures.append(Figure("modulating and folding, once per clip", folding(network, w_plus), "s"))
        for side in SIZES:
            figures += frame_figures(network, w_plus, smooth_image(side, rng), peaks)
        if shutil.which("g++"):
            figures += compiled_figures(network, w_plus, smooth_image(SIZES[0], rng))
    return figures


def frame_figures(
    network: StyleGANEX, w_plus: Tensor, frame: Tensor, peaks: dict[torch.dtype, float]
) -> list[Figure]:
    """One size of frame."""
    side = frame.shape[-1]
    plain = observed(lambda: network(frame, w_plus))
    figures = [
        Figure(f"plain, {side} px", plain.seconds, "s"),
        Figure(f"plain, {side} px, memory of a frame", plain.peak_gb, "GB"),
    ]
    for dtype, name in NAMES.items():
        for levels in (8, 7, 6):
            clip = compile_clip(network, w_plus, dtype=dtype, levels=levels)
            found = observed(lambda clip=clip: clip(frame))
            claim = f"{name}, {side} px to {found.image.shape[-1]} px"
            floor = found.macs / peaks[dtype]
            figures.append(Figure(claim, found.seconds, "s", baseline=plain.seconds, floor=floor))
            figures.append(Figure(f"{claim}, wall time on {CORES} cores", on_cores(clip, frame), "s"))
            if levels < 8:
                smaller = torch.nn.functional.avg_pool2d(plain.image.clamp(-1, 1), 2 ** (8 - levels))
                figures.append(Figure(f"{claim}, against all levels", decibels(found.image, smaller), "dB"))
            if levels == 8:
                rate = found.macs / found.seconds / 1e9
                figures += [
                    Figure(f"{claim}, against plain", decibels(found.image, plain.image), "dB"),
                    Figure(f"{claim}, memory of a frame", found.peak_gb, "GB", baseline=plain.peak_gb),
                    Figure(f"{claim}, multiply-adds", found.macs / 1e9, "G", baseline=plain.macs / 1e9),
                    Figure(f"{claim}, rate", rate, "GMAC/s", floor=peaks[dtype] / 1e9),
                ]
    return figures


def on_cores(clip: Callable[[Tensor], Tensor], frame: Tensor) -> float:
    """Wall time of a frame on ``CORES`` threads, s: the shorter of two runs, as somebody else may be at work."""
    torch.set_num_threads(CORES)
    try:
        times = []
        for _ in range(2):
            start = time.perf_counter()
            clip(frame)
            times.append(time.perf_counter() - start)
    finally:
        torch.set_num_threads(1)
    return min(times)


def compiled_figures(network: StyleGANEX, w_plus: Tensor, frame: Tensor) -> list[Figure]:
    """The clip network compiled by torch, and what compiling costs in wall time."""
    figures = []
    for dtype, name in NAMES.items():
        eager_clip = compile_clip(network, w_plus, dtype=dtype)
        eager = observed(lambda clip=eager_clip: clip(frame)).seconds
        clip = compile_clip(network, w_plus, dtype=dtype, compiled=True)
        start = time.perf_counter()
        clip(frame)
        compiling = time.perf_counter() - start
        start = time.process_time()
        clip(frame)
        seconds = time.process_time() - start
        figures += [
            Figure(f"{name} compiled, {frame.shape[-1]} px", seconds, "s", baseline=eager),
            Figure(f"{name}, compiling once, wall time", compiling, "s"),
        ]
    return figures


def folding(network: StyleGANEX, w_plus: Tensor) -> float:
    """Seconds of one core to make a clip network."""
    return cpu_seconds(lambda: compile_clip(network, w_plus))


def matmul_rate(dtype: torch.dtype) -> float:
    """Multiply-adds per second of a large matrix product on one core."""
    a, b = (torch.randn(MATRIX, MATRIX).to(dtype) for _ in range(2))
    return MATRIX**3 / cpu_seconds(lambda: a @ b)


def smooth_image(side: int, rng: torch.Generator) -> Tensor:
    """A picture of soft shapes, -1..1."""
    coarse = torch.rand(1, 3, 12, 12, generator=rng) * 2 - 1
    return torch.nn.functional.interpolate(coarse, size=(side, side), mode="bicubic").clamp(-1, 1)


def decibels(found: Tensor, expected: Tensor) -> float:
    """Peak signal-to-noise ratio of images in -1..1."""
    error = (found.clamp(-1, 1) - expected.clamp(-1, 1)).double().square().mean().item()
    return 10 * math.log10(4 / max(error, 1e-20))


@dataclass(frozen=True)
class Observed:
    """One run of a job that takes seconds, which is a fair sample of its time."""

    image: Tensor
    seconds: float
    """Processor time."""
    peak_gb: float
    """Most memory in use above what was before; 0 where nobody counts it (Linux does)."""
    macs: float
    """Multiply-adds of convolutions and matrix products."""


def observed(job: Callable[[], Tensor]) -> Observed:
    """Runs ``job`` once under all instruments."""
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    counts = status.is_file() and reset.is_file()
    before = _memory(status, "VmRSS") if counts else 0
    if counts:
        reset.write_text("5")  # the high-water mark begins at what is in use now
    with FlopCounterMode(display=False) as counter:
        start = time.process_time()
        image = job()
        seconds = time.process_time() - start
    peak = _memory(status, "VmHWM") - before if counts else 0
    return Observed(image, seconds, peak / 1e9, counter.get_total_flops() / 2)


def _memory(status: Path, field: str) -> int:
    line = next(line for line in status.read_text().splitlines() if line.startswith(f"{field}:"))
    return int(line.split()[1]) * 1024
