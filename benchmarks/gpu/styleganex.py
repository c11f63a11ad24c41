"""StyleGANEX frames per second for 512 px inputs: fp32, tf32, bf16, compiled; to 4 times the size, to the same.

Weights come from a seeded generator of the right layout; the arithmetic does not depend on what they are.
"""

from __future__ import annotations

import dataclasses
import runpy
import shutil
from typing import TYPE_CHECKING

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.gpu import machine
from benchmarks.harness import ROOT, Figure
from benchmarks.styleganex import decibels, smooth_image
from toonifygb.stylize.styleganex import PUBLISHED
from toonifygb.stylize.styleganex.fast import compile_clip

if TYPE_CHECKING:
    from torch import Tensor

    from benchmarks.gpu.machine import Bench
    from toonifygb.stylize.styleganex import StyleGANEX

PAPER_FPS = 11.0
"""The paper, RTX 4090, about."""
BATCH = 4
COMPILE_SECONDS = 150.0
"""Left before the deadline that a compilation is started with."""


def run(bench: Bench) -> list[Figure]:
    """Frames per second with the arithmetic floor, and what the precision costs in dB."""
    source = runpy.run_path(str(ROOT / "tests" / "stylize" / "styleganex_weights.py"))
    variant = PUBLISHED["toonify"]
    if bench.small:
        variant = dataclasses.replace(variant, width=source["NARROW"])
    network: StyleGANEX = source["make_network"](variant).requires_grad_(False).to(bench.device)
    random = torch.Generator().manual_seed(1)
    side = bench.pick(512, 64)
    frames = smooth_image(side, random).to(bench.device).repeat(bench.pick(BATCH, 1), 1, 1, 1)
    figures: list[Figure] = []
    with torch.inference_mode():
        codes = network.codes(smooth_image(256, random).to(bench.device))
        exact = _precise(network, frames, codes)
        for levels in (8, 6):
            for precision in ("float32", "tf32", "bfloat16"):
                figures += _measured(bench, network, codes, frames, precision, levels, exact)
        for precision in ("tf32", "bfloat16"):
            if not bench.small and (bench.left < COMPILE_SECONDS or not shutil.which("g++")):
                print(
                    f"styleganex: {precision} is not compiled: {bench.left:.0f} s left, g++ {shutil.which('g++')}"
                )
            elif not bench.small:
                figures += _measured(bench, network, codes, frames, precision, 8, exact, compiled=True)
    return figures


def _allow_tf32(allowed: bool) -> None:
    torch.backends.cuda.matmul.allow_tf32 = allowed
    torch.backends.cudnn.allow_tf32 = allowed


def _precise(network: StyleGANEX, frames: Tensor, codes: Tensor) -> Tensor:
    """The definition's image of one frame, float32."""
    _allow_tf32(False)
    return network(frames[:1], codes)


def _measured(
    bench: Bench, network: StyleGANEX, codes: Tensor, frames: Tensor, precision: str, levels: int, exact: Tensor,
    *, compiled: bool = False,
) -> list[Figure]:  # fmt: skip
    _allow_tf32(precision == "tf32")
    try:
        dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
        clip = compile_clip(network, codes, dtype=dtype, levels=levels, compiled=compiled)
        image = clip(frames)
        seconds = bench.seconds(lambda: clip(frames), repeats=10) / len(frames)
    finally:
        _allow_tf32(False)
    name = f"{precision}{', compiled' if compiled else ''}, {frames.shape[-1]} to {image.shape[-1]} px"
    floor = None
    if bench.device.type == "cuda" and not compiled:
        with FlopCounterMode(display=False) as counter:
            clip(frames[:1])
        floor = machine.matmul_rate(bench, precision) / (counter.get_total_flops() / 2)
    figures = [Figure(f"StyleGANEX {name}", 1 / seconds, "1/s", PAPER_FPS, floor)]
    if image.shape[-1] == exact.shape[-1]:
        figures.append(Figure(f"StyleGANEX {name}: against fp32", decibels(image[:1], exact), "dB"))
    return figures
