"""Rendering one image, and rendering plus its backward pass, per stage and against the torch reference."""

from __future__ import annotations

import ctypes
import time
from typing import TYPE_CHECKING

import torch

from benchmarks import limits, scenes
from benchmarks.harness import Figure, cpu_seconds, wall_seconds
from toonifygb import render
from toonifygb.render import library
from toonifygb.render.native import available_threads

if TYPE_CHECKING:
    from collections.abc import Callable

    from toonifygb.structures import Camera, Splats

FORWARD_FLOPS, BACKWARD_FLOPS = 35, 75
"""Floating-point operations per pixel and Gaussian of the compositing loops, fused multiply-adds counted twice."""
LANES = 16
"""Pixels per block of the engine."""


def _blocks(splats: Splats, camera: Camera) -> int:
    """Blocks of 4 × 4 px that the engine composites for this image."""
    leaves = splats.map(lambda tensor: tensor.clone().requires_grad_())
    node = render.get("native", 1).render(leaves, camera).color.grad_fn
    counts = (ctypes.c_int32 * 4)()
    library.load().tgb_raster_counts(node.frame.handle, counts)  # type: ignore[union-attr]
    return counts[3]


def _jobs(renderer: render.Renderer, splats: Splats, camera: Camera) -> tuple:
    """Rendering, and rendering with its backward pass."""
    leaves = splats.map(lambda tensor: tensor.clone().requires_grad_())
    v_color, v_alpha = torch.randn(camera.height, camera.width, 3), torch.randn(camera.height, camera.width)

    def both() -> None:
        rendering = renderer.render(leaves, camera)
        inputs = [leaves.means, leaves.quats, leaves.scales, leaves.opacities, leaves.sh]
        torch.autograd.grad([rendering.color, rendering.alpha], inputs, [v_color, v_alpha])

    return lambda: renderer.render(splats, camera), both


def _scene_figures(size: int, n_head: int, n_mouth: int, degree: int, *, repeats: int) -> list[Figure]:
    splats, camera = scenes.head(n_head, n_mouth, degree), scenes.camera(size)
    name = f"{(n_head + n_mouth) // 1000}k Gaussians, {size} px, SH {degree}"
    forward, both = _jobs(render.get("native", 1), splats, camera)
    plain = [1e3 * _shortest(job, repeats) for job in _jobs(render.get("reference"), splats, camera)]
    lanes = _blocks(splats, camera) * LANES
    floors = [1e3 * lanes * count / limits.flops() for count in (FORWARD_FLOPS, FORWARD_FLOPS + BACKWARD_FLOPS)]
    figures = [
        Figure(f"{name}: forward, 1 thread", 1e3 * cpu_seconds(forward), "ms", plain[0], floors[0]),
        Figure(f"{name}: forward + backward, 1 thread", 1e3 * cpu_seconds(both), "ms", plain[1], floors[1]),
    ]
    threads = available_threads()
    forward, both = _jobs(render.get("native", threads), splats, camera)
    for what, job in (("forward", forward), ("forward + backward", both)):
        figures.append(Figure(f"{name}: {what}, {threads} threads, wall", 1e3 * wall_seconds(job), "ms"))
    return figures


def _shortest(job: Callable[[], object], repeats: int) -> float:
    """Shortest processor time of the slow reference, s; no warm-up."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        job()
        times.append(time.process_time() - start)
    return min(times)


def run() -> list[Figure]:
    """Figures of the draft and the paper setting; the reference takes about a minute for the latter."""
    torch.set_num_threads(1)
    draft = _scene_figures(256, 12_000, 3_000, 1, repeats=3)
    return draft + _scene_figures(512, 50_000, 14_000, 3, repeats=1)
