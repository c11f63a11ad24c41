"""Frames per second at 512 px with the animation inside the loop.

Each frame has a new expression and pose: coefficients → blend → skin → rasterise → image on the device; 512 frames,
three rounds, one wait at the end of each. Beside it each part alone, and a face that stands still.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from benchmarks.gpu import machine, scene
from benchmarks.harness import Figure
from toonifygb import head, render
from toonifygb.avatar import Player, Poser

if TYPE_CHECKING:
    from benchmarks.gpu.machine import Bench

PAPER_FPS = 135.0
"""ToonifyGB and 3DGB on an RTX 4090: 127 to 143."""


def run(bench: Bench) -> list[Figure]:
    """Figures for 50k + 14k Gaussians and SH degree 1 and 3."""
    return [figure for degree in (1, 3) for figure in _figures(bench, degree)]


def _figures(bench: Bench, degree: int) -> list[Figure]:
    size, n_face, n_mouth = bench.pick(512, 48), bench.pick(50_000, 320), bench.pick(14_000, 80)
    avatar, camera = scene.avatar(n_face, n_mouth, degree, size), scene.camera(size)
    n = bench.pick(64, 4)
    motions = scene.motion(head.load("open"), n)
    poser, renderer = Poser(avatar, backend=bench.backend), render.get(bench.backend)
    player = Player(avatar, backend=bench.backend)
    shown = 0

    def play():
        for _ in player.play(motions, [camera] * n):
            pass

    def pose():
        nonlocal shown
        shown += 1
        return poser(motions[shown % n])

    k = len(avatar.blendshape_names)
    floats = 11 + 3 * (degree + 1) ** 2
    floor = machine.bandwidth(bench) / (4 * floats * n_face * (k + 2)) if bench.device.type == "cuda" else None
    posed = pose()
    jobs = (
        ("animate + render", play, n, PAPER_FPS, floor),
        ("the same, pose by pose", lambda: renderer.render(pose(), camera), 1, PAPER_FPS, floor),
        ("pose", pose, 1, None, floor),
        ("render, standing still", lambda: renderer.render(posed, camera), 1, None, None),
    )
    name = f"{(n_face + n_mouth) // 1000}k, K={k}, SH {degree}, {size} px"
    with torch.no_grad():
        return [
            Figure(f"{name}: {what}", frames / bench.seconds(job, repeats=512 // frames), "1/s", baseline, bound)
            for what, job, frames, baseline, bound in jobs
        ]
