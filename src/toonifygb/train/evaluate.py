"""How well an avatar reproduces frames: PSNR and SSIM on black."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from toonifygb import render
from toonifygb.avatar import Poser
from toonifygb.metrics import psnr, psnr_per_channel, ssim
from toonifygb.progress import SILENT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from toonifygb.avatar import Avatar
    from toonifygb.progress import Progress
    from toonifygb.structures import TrackedSequence
    from toonifygb.train.data import Dataset


def evaluate(
    avatar: Avatar,
    dataset: Dataset,
    sequence: TrackedSequence,
    frames: Sequence[int],
    *,
    backend: str = "auto",
    threads: int | None = None,
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Scores of the avatar on the given frames, JSON-able.

    Protocol: render clamped to 0..1 against photo × matte on black, float, the whole training crop. ``psnr`` takes
    one mean over all channels, ``psnr_per_channel`` is 3DGB's variant; every score is the mean over the frames.

    Args:
        avatar: what is judged.
        dataset: its training set, which also holds the held-out frames.
        sequence: the motion of every frame.
        frames: which to judge.
        backend: rasteriser.
        threads: of the native engine.
        progress: told after every frame.
    """
    renderer, poser = render.get(backend, threads), Poser(avatar, backend=backend, threads=threads)
    table: dict[str, list[float]] = {"psnr": [], "psnr_per_channel": [], "ssim": []}
    with torch.no_grad():
        for done, index in enumerate(frames, start=1):
            target, _ = dataset.target(index)
            image = renderer.render(poser(sequence.motion[index]), dataset.camera(index)).color.clamp(0, 1).cpu()
            for name, measure in (("psnr", psnr), ("psnr_per_channel", psnr_per_channel), ("ssim", ssim)):
                table[name].append(float(measure(image, target)))
            progress.update(done, len(frames))
    scores: dict[str, Any] = {"lpips": None, "frames": [int(index) for index in frames]}
    scores |= {name: float(np.mean(values)) if values else None for name, values in table.items()}
    return scores | {f"{name}_per_frame": [round(value, 4) for value in table[name]] for name in table}
