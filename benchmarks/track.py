"""The track room: how closely the head model explains landmarks, what that costs, and how far it is from the truth.

The synthetic clip needs no file: its landmarks are true projections with a pixel of noise, so its errors are the
fit's own and not the detector's. The real clips are landmarks in the folder named by ``TOONIFYGB_GOLDEN``, left out
where it is absent; their errors are px with the face scaled to 230 px.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import ROOT, Figure, cpu_seconds
from toonifygb import head as heads
from toonifygb import synthetic, track
from toonifygb.config import TrackConfig
from toonifygb.head import HeadModel
from toonifygb.structures import Landmarks, TrackedSequence
from toonifygb.threads import one_torch_thread

FPS = {"wojtek_1": 25.0, "d0": 25.0, "d9": 30.0, "pexels_8136210": 50.0}
N_SYNTHETIC = 100
NOISE_PX = 1.0
"""About the detector's own scatter at this size."""


def run() -> list[Figure]:
    """Errors in px, degrees and mm; times in ms of processor time per frame on one thread."""
    head = heads.load("open")
    with one_torch_thread():
        return [*synthetic_figures(head), *clip_figures(head)]


def synthetic_figures(head: HeadModel) -> list[Figure]:
    """A made-up person whose parameters are known, and the cost of looking at the result."""
    truth = synthetic.render_clip(synthetic.make_subject(1), n_frames=N_SYNTHETIC).sequence
    noise = NOISE_PX * torch.randn(truth.landmarks.points.shape, generator=torch.Generator().manual_seed(0))
    noisy = Landmarks(truth.landmarks.points + noise, truth.landmarks.score, 512, 512)
    fitted, _ = timed_fit(noisy, head, truth.fps)
    errors = synthetic.errors(fitted, truth, head).means()
    region = track.HeadRegion(truth, head)
    frame = np.zeros((512, 512, 3), np.uint8)
    return [
        Figure("head rotation, 1 px noise", errors["rotation_deg"], "deg"),
        Figure("jaw, 1 px noise", errors["jaw_deg"], "deg"),
        Figure("3-D face, 1 px noise", errors["face_mm"], "mm"),
        Figure("overlay, 512 px frame", 1e3 * cpu_seconds(lambda: track.overlay.draw(frame, truth, 0, head)), "ms"),
        Figure("head region, 512 px frame", 1e3 * cpu_seconds(lambda: region(0)), "ms"),
    ]


def clip_figures(head: HeadModel) -> list[Figure]:
    """Landmark error, jitter and time on the real clips at hand."""
    folder = Path(os.environ.get("TOONIFYGB_GOLDEN", ROOT / "../shared/golden")) / "landmarks"
    figures = []
    for path in sorted(folder.glob("*.npz")):
        arrays = np.load(path)
        points = torch.from_numpy(np.ascontiguousarray(arrays["tracking"][..., :2]))
        landmarks = Landmarks(points, torch.ones(len(points)), int(arrays["width"]), int(arrays["height"]))
        fitted, ms = timed_fit(landmarks, head, FPS.get(path.stem, 25.0))
        figures += [
            Figure(f"landmark error, {path.stem}", float(fitted.error_px.nanmean()), "px"),
            Figure(f"fit, {path.stem} ({len(points)} frames), per frame", ms, "ms"),
        ]
    return figures


def timed_fit(landmarks: Landmarks, head: HeadModel, fps: float) -> tuple[TrackedSequence, float]:
    """The fit and its processor time per frame, ms."""
    start = time.process_time()
    fitted = track.fit(landmarks, head, TrackConfig(), fps=fps, source_sha256="")
    return fitted, 1e3 * (time.process_time() - start) / fitted.n_frames
