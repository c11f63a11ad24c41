"""Room on disk of an avatar of the paper's size, and what compact storage costs: 50k + 14k Gaussians, drawn person.

The training is cut to ``STEPS``; the fewer the steps the less the numbers have grown apart, so the loss is also
taken of avatars of whole trainings in the decisions. Takes some minutes.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from benchmarks.harness import Figure
from toonifygb import avatar as avatars
from toonifygb import head, synthetic, train
from toonifygb.config import PAPER

FRAMES, STEPS = 60, 600
LIMIT_MB, SEED_MB, LIMIT_DB = 45.0, 900.0, 0.1
"""The aim, what 3DGB's point clouds take, and the loss that is allowed."""


def run() -> list[Figure]:
    """Size in both storages, and decibels between them on held-out frames, by SH degree."""
    clip, model = synthetic.render_clip(synthetic.make_subject(0), n_frames=FRAMES), head.load("open")
    figures = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pairs = ((frame.image, frame.head) for frame in clip)
        dataset = train.build_dataset(pairs, clip.sequence, model, PAPER, folder / "dataset")
        for degree in (1, 3):
            config = replace(PAPER, sh_degree=degree, steps=STEPS)
            trained = train.train(dataset, clip.sequence, model, config, folder / f"training {degree}")
            scores = {}
            for storage in ("compact", "full"):
                kept = folder / f"{storage} {degree}"
                avatars.save(trained, kept, storage=storage)
                size = sum(path.stat().st_size for path in kept.iterdir()) / 1e6
                limit = LIMIT_MB if storage == "compact" else SEED_MB
                figures.append(Figure(f"64k, SH {degree}: {storage}", size, "MB", limit))
                loaded = avatars.load(kept)
                scores[storage] = train.evaluate(loaded, dataset, clip.sequence, dataset.split.test)["psnr"]
            lost = scores["full"] - scores["compact"]
            figures.append(Figure(f"64k, SH {degree}: lost of {scores['full']:.2f} dB", lost, "dB", LIMIT_DB))
    return figures
