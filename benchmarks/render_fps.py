"""Frames per second of an avatar at playback: pose (blend, skin), rasterise, image in memory.

A different pose in every frame, all expression units moving; the baseline is the exact way, ``Poser`` and
``Renderer`` one after the other in float32.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from benchmarks.gpu import scene
from benchmarks.harness import Figure, cpu_seconds, wall_seconds
from toonifygb import head, render
from toonifygb.avatar import Avatar, Player, Poser, init_avatar
from toonifygb.config import DRAFT, PAPER, STANDARD
from toonifygb.render.native import available_threads

FRAMES = 32


def _figures(name: str, avatar: Avatar, size: int) -> list[Figure]:
    motion, camera = scene.motion(head.load("open"), FRAMES), scene.camera(size)
    threads, figures = available_threads(), []
    for count, clock, label in ((1, cpu_seconds, "1 thread"), (threads, wall_seconds, f"{threads} threads, wall")):
        player = Player(avatar, backend="native", threads=count)
        poser, renderer = Poser(avatar, backend="native", threads=count), render.get("native", count)

        def play(player: Player = player) -> None:
            for _ in player.play(motion, [camera] * FRAMES):
                pass

        def exact(poser: Poser = poser, renderer: render.Renderer = renderer) -> None:
            for index in range(FRAMES // 4):
                renderer.render(poser(motion[4 * index]), camera)

        plain = FRAMES / 4 / clock(exact, budget=5.0)
        figures.append(
            Figure(f"{name}, {size} px: animate + render, {label}", FRAMES / clock(play, budget=5.0), "1/s", plain)
        )
        posed = poser(motion[3])
        seconds = clock(lambda posed=posed, renderer=renderer: renderer.render(posed, camera))
        figures.append(Figure(f"{name}, {size} px: render alone, {label}", 1 / seconds, "1/s"))
    return figures


def run() -> list[Figure]:
    """Figures of untrained avatars in the draft and the standard setting, and of a full one in the paper's."""
    torch.set_num_threads(1)
    model, figures = head.load("open"), []
    for name, config in (("draft avatar", DRAFT), ("standard avatar", STANDARD)):
        avatar = init_avatar(model, torch.zeros(model.shape_basis.shape[-1]), config)
        figures += _figures(name, avatar, config.resolution)
    for degree in (1, 3):
        config = replace(PAPER, sh_degree=degree)
        avatar = scene.avatar(config.n_gaussians, config.n_mouth_gaussians, degree, config.resolution, local=True)
        figures += _figures(f"paper avatar, SH {degree}", avatar, config.resolution)
    return figures
