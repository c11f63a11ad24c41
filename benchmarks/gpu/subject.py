"""A whole short training: a synthetic person, true head poses and mattes, scored on frames held out."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.gpu import machine
from benchmarks.harness import Figure
from toonifygb import synthetic, train
from toonifygb.config import TrainConfig

if TYPE_CHECKING:
    from benchmarks.gpu.machine import Bench


def run(bench: Bench) -> list[Figure]:
    """Seconds, steps per second and scores; drawing the clip happens on the processor and is not counted."""
    if not bench.small and (reason := machine.build_native()):
        print(f"subject: frames are drawn slowly, because the native engine is missing: {reason}")
    size, n_frames = bench.pick(256, 64), bench.pick(60, 6)
    config = TrainConfig(
        n_gaussians=bench.pick(16_000, 300),
        n_mouth_gaussians=bench.pick(2_000, 40),
        resolution=size,
        steps=bench.pick(3_000, 6),
    )
    person = synthetic.make_subject(0)
    clip = synthetic.render_clip(person, n_frames=n_frames, size=size)
    pairs = ((frame.image, frame.head) for frame in clip)
    with tempfile.TemporaryDirectory() as folder:
        dataset = train.build_dataset(pairs, clip.sequence, person.head, config, Path(folder) / "dataset")
        untrained = train.first_avatar(dataset, clip.sequence, person.head, config)
        start = time.perf_counter()
        trained = train.train(dataset, clip.sequence, person.head, config, folder, backend=bench.backend)
        seconds = time.perf_counter() - start
        before, after = (
            train.evaluate(model, dataset, clip.sequence, dataset.split.test, backend=bench.backend)
            for model in (untrained, trained)
        )
    name = f"synthetic subject, {config.n_gaussians // 1000}k, {size} px, {config.steps} steps"
    return [
        Figure(f"{name}: initialisation and training", seconds, "s"),
        Figure(f"{name}: PSNR, held out", after["psnr"], "dB"),
        Figure(f"{name}: PSNR, untrained", before["psnr"], "dB"),
        Figure(f"{name}: SSIM, held out", after["ssim"], "1"),
    ]
