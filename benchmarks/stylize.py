"""The stylize room: cost per frame of every style, and how steady its clips are beside their sources.

Drawn styles first, then StyleGANEX (``styleganex``). The subject of the drawn styles' times is a drawn face, so
they need no file. Steadiness is measured on clips in the folder named by ``TOONIFYGB_VIDEOS`` with landmarks from
``TOONIFYGB_GOLDEN``, and left out where those are absent. It is told beside the source clip's; a style that
multiplies contrast, like ``ink``, multiplies the clip's own motion with it.
"""

from __future__ import annotations

import os
import runpy
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch

from benchmarks import styleganex
from benchmarks.harness import ROOT, Figure, cpu_seconds
from toonifygb import stylize, video
from toonifygb.metrics import stability
from toonifygb.structures import Landmarks
from toonifygb.stylize import filters, steady

if TYPE_CHECKING:
    from collections.abc import Sequence

STYLES = [name for name in stylize.available() if name != "none"]
SIZES = ((512, 512), (1080, 1920))
FRAMES = 24
"""Frames of each real clip."""
SAME_SURFACE = 12
"""Largest difference in 8-bit levels between a source frame and its moved neighbour that still counts as the same
surface in the flow-warped error."""


def run() -> list[Figure]:
    """Times of one core per frame; ITF (dB) and ISI above the source's; flow-warped error in levels."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        drawn = times() + steadiness()
    finally:
        cv2.setNumThreads(threads)
    return drawn + styleganex.run()


def times() -> list[Figure]:
    """The whole way of a frame: calming, caricature, style."""
    scene = runpy.run_path(str(ROOT / "tests" / "stylize" / "stylize_scene.py"))
    figures = []
    for width, height in SIZES:
        clip, marks = scene["frames"](4, width, height, noise=3.0), scene["landmarks"](4, width, height)
        for name in STYLES:
            style = stylize.get(name)
            state = stylize.prepare(iter(clip), marks, style)
            seconds = cpu_seconds(lambda s=style, v=state, c=clip, m=marks: styled(c, m, s, v)) / len(clip)
            figures.append(Figure(f"{name}, per {width}x{height} frame", 1e3 * seconds, "ms"))
    return figures


def steadiness() -> list[Figure]:
    """Stability of the first frames of each clip at hand, in every style."""
    golden = Path(os.environ.get("TOONIFYGB_GOLDEN", ROOT / "../shared/golden")) / "landmarks"
    videos = Path(os.environ.get("TOONIFYGB_VIDEOS", ROOT / "../shared/data/videos"))
    figures = []
    for reference in sorted(golden.glob("*.npz")):
        path = videos / f"{reference.stem}.mp4"
        if not path.is_file():
            continue
        clip = list(video.read(path, max_frames=FRAMES))
        points = torch.from_numpy(np.load(reference)["tracking"][: len(clip), :, :2].astype(np.float32))
        marks = Landmarks(points, torch.ones(len(clip)), clip[0].shape[1], clip[0].shape[0])
        source, error = stability(clip), warped_error(clip, clip)
        for name in STYLES:
            style = stylize.get(name)
            out = styled(clip, marks, style, stylize.prepare(iter(clip), marks, style))
            found = stability(out)
            label = f"{name}, {reference.stem}"
            figures += [
                Figure(f"ITF above the source, {label}", found.itf - source.itf, "dB"),
                Figure(f"ISI above the source, {label}", found.isi - source.isi, ""),
                Figure(f"flow-warped error, {label}", warped_error(clip, out), "levels", baseline=error),
            ]
    return figures


def styled(
    clip: Sequence[np.ndarray], marks: Landmarks, style: stylize.Stylizer, state: dict[str, Any]
) -> list[np.ndarray]:
    """The clip in a style."""
    return list(stylize.stylize_frames(iter(clip), marks, style, state))


def warped_error(source: Sequence[np.ndarray], frames: Sequence[np.ndarray]) -> float:
    """RMS difference of consecutive frames after the earlier is moved by the source's optical flow, in levels."""
    errors = []
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in source]
    for now in range(1, len(frames)):
        where = filters.pixel_grid(*grey[now].shape) + steady.motion(grey[now], grey[now - 1])
        moved_source = filters.sample(source[now - 1], where).astype(np.int16)
        same = np.abs(moved_source - source[now]).max(-1) < SAME_SURFACE
        moved = filters.sample(frames[now - 1], where).astype(np.float32)
        errors.append(float(np.sqrt(((moved - frames[now])[same] ** 2).mean())))
    return float(np.mean(errors))
