"""Memory of Stage 2 on a long clip: 4000 frames of 1920 × 1080 px cut into crops, then steps of the paper's size.

Counted is what the process holds by itself (``RssAnon``); crops on disk are mapped, and the system may drop them at
any moment. Takes some minutes and 4 GB of disk, which it gives back.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from benchmarks.gpu import scene
from benchmarks.harness import Figure
from toonifygb import head, train
from toonifygb.avatar.fields import each
from toonifygb.config import PAPER
from toonifygb.geometry.cameras import tracked_camera
from toonifygb.structures import Landmarks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from toonifygb.structures import TrackedSequence

FRAMES, WIDTH, HEIGHT, STEPS = 4000, 1920, 1080, 100
FACE = 400
"""Size of the face in the frames, px."""
LIMIT_GB = 4.0


def run() -> list[Figure]:
    """Peaks while crops are cut and while the avatar is trained, and what of it are parameters and moments."""
    model, long = head.load("open"), _long_sequence()
    peaks = _Peaks()
    with tempfile.TemporaryDirectory() as folder:
        peaks.phase = "cutting"
        crops = train.build_dataset(_clip(), long, model, PAPER, Path(folder) / "dataset", progress=peaks)
        peaks.phase = "training"
        config = replace(PAPER, sh_degree=1, steps=STEPS)
        avatar = train.train(crops, long, model, config, Path(folder) / "training", progress=peaks)
    per_row = sum(tensor.numel() for _, tensor in each(avatar.deltas))
    parameters = 12 * (per_row + 2 * sum(tensor.numel() for _, tensor in each(avatar.neutral))) / 1e9
    return [
        Figure(f"{FRAMES} frames of {WIDTH} x {HEIGHT} px: cutting crops", peaks.gb["cutting"], "GB", LIMIT_GB),
        Figure(f"{FRAMES} crops of {PAPER.resolution} px: training 64k", peaks.gb["training"], "GB", LIMIT_GB),
        Figure("of it deltas, neutral and their moments, at most", parameters, "GB"),
    ]


class _Peaks:
    """Progress that looks at the process's memory."""

    def __init__(self) -> None:
        self.phase = ""
        self.gb: dict[str, float] = {}

    def update(self, done: int, total: int | None, **figures: float) -> None:
        self.gb[self.phase] = max(self.gb.get(self.phase, 0.0), _held_gb())


def _held_gb() -> float:
    """Memory of the process that is not backed by a file, GB."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("RssAnon:")) * 1024 / 1e9


def _long_sequence() -> TrackedSequence:
    sequence = scene.sequence(head.load("open"), FRAMES, HEIGHT)
    camera = tracked_camera(scene.FOCAL_SIZES * HEIGHT, WIDTH, HEIGHT)
    points = FACE * torch.rand(sequence.landmarks.points.shape) + 0.5 * torch.tensor([WIDTH - FACE, HEIGHT - FACE])
    landmarks = Landmarks(points, sequence.landmarks.score, WIDTH, HEIGHT)
    return replace(sequence, camera=camera, landmarks=landmarks)


def _clip() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Frames of noise and soft mattes, made one at a time."""
    random = np.random.default_rng(0)
    noise = random.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    matte = random.random((HEIGHT, WIDTH), np.float32)
    for index in range(FRAMES):
        yield np.roll(noise, index, axis=1), matte
