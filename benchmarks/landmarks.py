"""The face room: cost of detection, landmarks and mattes, and agreement with MediaPipe where its output is at hand.

The subject is a drawn face, so the times need no file. The agreement is measured on clips in the folder named by
``TOONIFYGB_VIDEOS`` against arrays in ``TOONIFYGB_GOLDEN``, and left out where those are absent.
"""

from __future__ import annotations

import os
import runpy
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks import limits
from benchmarks.harness import ROOT, Figure, cpu_seconds
from toonifygb import face, video
from toonifygb.config import FaceConfig
from toonifygb.face.detect import FaceFinder
from toonifygb.face.networks import load_network

if TYPE_CHECKING:
    from collections.abc import Callable

    from toonifygb.face.networks import Name

GOLDEN_FRAMES = 60


def run() -> list[Figure]:
    """Times in ms of one core, and distances in px of a face 200 px wide."""
    frame = runpy.run_path(str(ROOT / "tests" / "face" / "drawn_face.py"))["draw_face"](512)
    follower = face.Follower(FaceConfig())
    follower.step(frame)
    finder = FaceFinder()
    figures = [*network_figures("landmarks"), *network_figures("person")]
    figures += [
        Figure("following a face, per 512 px frame", _ms(lambda: follower.step(frame)), "ms"),
        Figure("detecting on a whole 512 px frame", _ms(lambda: next(finder.levels(frame, thorough=False))), "ms"),
    ]
    keep = np.ones(frame.shape[:2], np.float32)
    person = face.PersonSegmenter().segment(frame[None])[0]
    matte = face.head_matte(frame, person, keep)
    figures += [
        Figure("head matte, 512 px", _ms(lambda: face.head_matte(frame, person, keep)), "ms"),
        Figure("foreground colours, 512 px", _ms(lambda: face.foreground(frame, matte)), "ms"),
    ]
    return figures + agreement()


def network_figures(name: Name) -> list[Figure]:
    """One network on single images and on batches of 8, whose baseline is the single image."""
    network = load_network(name)
    images = torch.rand(8, 3, network.height, network.width)
    with FlopCounterMode(display=False) as counter:
        network(images[:1])
    floor = 1e3 * counter.get_total_flops() / limits.flops()
    single, batched = _ms(lambda: network(images[:1])), _ms(lambda: network(images)) / 8
    return [
        Figure(f"network '{name}', one image", single, "ms", floor=floor),
        Figure(f"network '{name}', per image of 8", batched, "ms", baseline=single, floor=floor),
    ]


def agreement() -> list[Figure]:
    """Mean distance to MediaPipe 0.10.21 in tracking mode over the first frames of each clip at hand."""
    golden = Path(os.environ.get("TOONIFYGB_GOLDEN", ROOT / "../shared/golden")) / "landmarks"
    videos = Path(os.environ.get("TOONIFYGB_VIDEOS", ROOT / "../shared/data/videos"))
    figures = []
    for reference in sorted(golden.glob("*.npz")):
        clip = videos / f"{reference.stem}.mp4"
        if clip.is_file():
            expected = np.load(reference)["tracking"][:GOLDEN_FRAMES, :, :2]
            landmarks, _ = face.find_landmarks(video.read(clip, max_frames=GOLDEN_FRAMES), FaceConfig())
            scale = 200 / np.ptp(expected[..., 0], axis=1)[:, None]
            error = np.linalg.norm(landmarks.points.numpy() - expected, axis=-1) * scale
            figures.append(Figure(f"distance to MediaPipe, {reference.stem}", float(error.mean()), "px"))
    return figures


def _ms(job: Callable[[], object]) -> float:
    return 1e3 * cpu_seconds(job)
