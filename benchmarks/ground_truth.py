"""How far a track is from the truth on people whose parameters are known, with the detector's own landmarks.

The clips are drawn, so the truth is exact; everything else is what ``create --style none`` does up to the training
of the avatar: finding landmarks, fitting the head model to them, and fitting the head's pose to the pixels.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.harness import Figure
from toonifygb import face, synthetic, track, train
from toonifygb import head as heads
from toonifygb.config import FaceConfig, TrackConfig, TrainConfig
from toonifygb.pipeline.create import head_frames
from toonifygb.structures import TrackedSequence

SEEDS = (0, 1, 2)
N_FRAMES = 120
UNITS = {"rotation_deg": "deg", "jaw_deg": "deg", "face_mm": "mm"}
TARGETS = {"rotation_deg": 1.5, "jaw_deg": 1.5, "face_mm": 1.8}


def run() -> list[Figure]:
    """Mean errors over the people, of the landmarks' track and of the final one; baseline: the target."""
    head = heads.load("open")
    tables = {"landmarks alone": [], "final": []}
    for seed in SEEDS:
        clip = synthetic.render_clip(synthetic.make_subject(seed), n_frames=N_FRAMES)
        for name, fitted in tracks_of(np.stack(list(clip.frames)), head, clip.sequence.fps).items():
            tables[name].append(synthetic.errors(fitted, clip.sequence, head).means())
    return [
        Figure(f"{quantity}, {name}", float(np.mean([row[quantity] for row in rows])), unit, TARGETS[quantity])
        for name, rows in tables.items()
        for quantity, unit in UNITS.items()
    ]


def tracks_of(frames: np.ndarray, head: heads.HeadModel, fps: float) -> dict[str, TrackedSequence]:
    """The track before and after the pixels had their say."""
    landmarks, _ = face.find_landmarks(iter(frames), FaceConfig(), n_frames=len(frames))
    fitted = track.fit(landmarks, head, TrackConfig(), fps=fps, source_sha256="")
    with tempfile.TemporaryDirectory() as folder:
        pairs = head_frames(iter(frames), iter(frames), fitted, head)
        dataset = train.build_dataset(pairs, fitted, head, TrainConfig(), Path(folder) / "dataset")
        refined = train.refine_track(dataset, fitted, head, seed=0)
    return {"landmarks alone": fitted, "final": refined}
