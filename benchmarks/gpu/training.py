"""Training steps per second in the paper's regime: 64k Gaussians, all blendshapes of the open head, 512 px."""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.gpu import machine, scene
from benchmarks.harness import Figure
from toonifygb import head, render
from toonifygb.config import TrainConfig
from toonifygb.threads import one_torch_thread
from toonifygb.train.state import TrainState
from toonifygb.train.step import Stepper

if TYPE_CHECKING:
    from benchmarks.gpu.machine import Bench

PAPER_STEPS = 40_000 / (44 * 60)
"""Steps per second of the paper: 40 000 in 40 to 50 minutes on an RTX 4090."""
ADAM_BYTES = 24
FRAMES = 16


def run(bench: Bench) -> list[Figure]:
    """Figures for SH degree 1 and 3."""
    return [_figure(bench, degree) for degree in (1, 3)]


def _figure(bench: Bench, degree: int) -> Figure:
    size, n_face, n_mouth = bench.pick(512, 48), bench.pick(50_000, 320), bench.pick(14_000, 80)
    avatar = scene.avatar(n_face, n_mouth, degree, size)
    config = TrainConfig(
        n_gaussians=n_face, n_mouth_gaussians=n_mouth, resolution=size, steps=40_000, sh_degree=degree
    )
    renderer, kernels = render.get(bench.backend), render.kernels(bench.backend)
    with one_torch_thread():
        state = TrainState.start(avatar, 0).to(kernels.device)
        state.step = config.steps // 2  # the full SH degree is active
        track = scene.sequence(head.load("open"), FRAMES, size)
        stepper = Stepper(state, avatar, scene.noise_dataset(FRAMES, size), track, config, renderer, kernels)
        seconds = bench.seconds(stepper.step, repeats=50)
    k = len(avatar.blendshape_names)
    moving = (state.expression, state.driver)
    deltas = sum(tensor.numel() for group in moving for tensor in vars(group.values).values())
    floor = machine.bandwidth(bench) / (ADAM_BYTES * deltas) if bench.device.type == "cuda" else None
    name = f"{(n_face + n_mouth) // 1000}k, K={k}, SH {degree}, {size} px: training steps"
    return Figure(name, 1 / seconds, "1/s", PAPER_STEPS, floor)
