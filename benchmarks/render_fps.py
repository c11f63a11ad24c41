"""Frames per second of an avatar at playback: pose (blend, skin), rasterise, image in memory."""

from __future__ import annotations

from dataclasses import replace

import torch

from benchmarks import scenes
from benchmarks.gpu import scene
from benchmarks.harness import Figure, cpu_seconds, wall_seconds
from toonifygb import head, render
from toonifygb.avatar import Avatar, Poser, init_avatar
from toonifygb.config import DRAFT, PAPER, STANDARD, TrainConfig
from toonifygb.geometry import cameras
from toonifygb.render.native import available_threads
from toonifygb.structures import Camera, HeadMotion


def _motion(n_expression: int) -> HeadMotion:
    """A smile with the jaw half open, 0.5 m in front of the camera."""
    expression = torch.zeros(n_expression)
    expression[torch.randperm(n_expression)[:8]] = 0.5
    joints = torch.zeros(5, 3)
    joints[2, 0] = 0.2
    return HeadMotion(expression, joints, torch.tensor([0.0, 0.0, -0.5]), torch.tensor([0.1, 0.1]))


def _camera(size: int) -> Camera:
    return cameras.tracked_camera(float(scenes.camera(size).K[0, 0]), size, size)


def _figures(name: str, avatar: Avatar, config: TrainConfig) -> list[Figure]:
    model = head.load("open")
    motion, camera = _motion(model.expression_basis.shape[-1]), _camera(config.resolution)
    threads, figures = available_threads(), []
    for count, clock, label in ((1, cpu_seconds, "1 thread"), (threads, wall_seconds, f"{threads} threads, wall")):
        poser, renderer = Poser(avatar, backend="native", threads=count, half=True), render.get("native", count)
        posed = poser(motion)
        whole = clock(lambda poser=poser, renderer=renderer: renderer.render(poser(motion), camera))
        raster = clock(lambda posed=posed, renderer=renderer: renderer.render(posed, camera))
        pose = clock(lambda poser=poser: poser(motion))
        for what, seconds in (("pose + render", whole), ("render", raster), ("pose", pose)):
            figures.append(Figure(f"{name}, {config.resolution} px: {what}, {label}", 1 / seconds, "1/s"))
    return figures


def run() -> list[Figure]:
    """Figures of untrained avatars in the draft and the standard setting, and of a full one in the paper's."""
    torch.set_num_threads(1)
    model, figures = head.load("open"), []
    for name, config in (("draft avatar", DRAFT), ("standard avatar", STANDARD)):
        avatar = init_avatar(model, torch.zeros(model.shape_basis.shape[-1]), config)
        figures += _figures(name, avatar, config)
    for degree in (1, 3):
        config = replace(PAPER, sh_degree=degree)
        avatar = scene.avatar(config.n_gaussians, config.n_mouth_gaussians, degree, config.resolution)
        figures += _figures(f"paper avatar, SH {degree}", avatar, config)
    return figures
