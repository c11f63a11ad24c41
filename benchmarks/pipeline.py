"""The whole way: wall time of every stage from a clip to an avatar, draft quality, and how good the avatar is.

The clip is a synthetic subject, 512 px, so no file is needed and the true motion is known. Stages use all cores;
figures are wall time, so they mean something on an idle machine only.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from benchmarks.harness import Figure
from toonifygb.cli.main import run as command

N_FRAMES = 150
PER_FRAME = ("landmarks", "stylize", "source", "track", "dataset", "preview")


def run() -> list[Figure]:
    """Seconds of each stage and the held-out scores."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "demo"
        code = command(["demo", "--out", str(out), "--n-frames", str(N_FRAMES)])
        if code != 0:
            raise RuntimeError(f"the demo ended with exit code {code}")
        values = json.loads((out / "metrics.json").read_text())
    seconds = values["seconds"]
    figures = [Figure(f"{name}, a frame", 1000 * seconds[name] / N_FRAMES, "ms") for name in PER_FRAME]
    figures.append(Figure(f"training, {values['n_gaussians']} Gaussians, 256 px", seconds["train"], "s"))
    figures.append(Figure(f"everything, {N_FRAMES} frames", sum(seconds.values()), "s"))
    figures.append(Figure("PSNR, held out", values["psnr"], "dB"))
    figures.append(Figure("SSIM, held out", values["ssim"], "1"))
    figures.append(Figure("landmark error", values["landmark_error_px"], "px"))
    truth = values["ground_truth"]
    figures.append(Figure("head rotation against the truth", truth["rotation_deg"], "deg"))
    figures.append(Figure("jaw against the truth", truth["jaw_deg"], "deg"))
    figures.append(Figure("face against the truth", truth["face_mm"], "mm"))
    return figures
