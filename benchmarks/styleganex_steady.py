"""How steady StyleGANEX is on a real clip beside the source and a drawn style, and what was tried to make it
steadier or to compute fewer frames.

The first frames of the close-up of ``styleganex_clip`` run through a network of full width that stops at its
input's size. Its weights come from a seed and are no style that anyone would want: the figures rank procedures, not
styles. ITF and ISI count the subject's motion too; the flow-warped error takes it out.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from benchmarks.harness import Figure
from benchmarks.styleganex import seeded_network
from benchmarks.styleganex_clip import squares
from benchmarks.stylize import styled, warped_error
from toonifygb import face, stylize
from toonifygb.config import FaceConfig, StyleganexConfig
from toonifygb.metrics import psnr, stability
from toonifygb.stylize import filters, steady
from toonifygb.stylize.styleganex.aligned import AlignedStylizer
from toonifygb.stylize.styleganex.engine import Engine
from toonifygb.stylize.styleganex.fast import compile_clip
from toonifygb.stylize.styleganex.stylizer import StyleganexStylizer
from toonifygb.threads import one_torch_thread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from toonifygb.structures import Landmarks
    from toonifygb.stylize.styleganex import StyleGANEX

FRAMES = 24
PLAIN = StyleganexConfig(levels=6, calm=False)
VERSIONS = {
    "StyleGANEX": PLAIN,
    "calmed source": replace(PLAIN, calm=True),
    "aligned": replace(PLAIN, framing="aligned"),
}
NETWORK_SIDE = 160
"""Side of the network's input for this clip, px."""
CELL = 8
"""Side of what the network's deepest map has one value for, px of its input."""
SAME = 2
"""Largest difference in 8-bit levels at which a cell counts as unchanged."""


def run() -> list[Figure]:
    """ITF in dB, ISI, flow-warped error in levels; baselines are the source's."""
    with one_torch_thread():
        return measured()


def measured() -> list[Figure]:
    """All figures."""
    clip = list(islice(squares(), FRAMES))
    marks, _ = face.find_landmarks(clip, FaceConfig())
    network = seeded_network()
    toon = stylize.get("toon")
    drawn = {"source": clip, "toon": styled(clip, marks, toon, stylize.prepare(iter(clip), marks, toon))}
    for name, config in VERSIONS.items():
        drawn[name] = through(network, config, clip, marks)
    drawn["every second frame moved"] = half_moved(clip, drawn["calmed source"])
    base = stability(clip)
    figures = []
    for name, frames in drawn.items():
        found = stability(frames)
        figures += [
            Figure(f"ITF, {name}", found.itf, "dB", baseline=base.itf),
            Figure(f"ISI, {name}", found.isi, "", baseline=base.isi),
            Figure(f"flow-warped error, {name}", warped_error(clip, frames), "levels"),
        ]
    for name in ("toon", "calmed source"):
        figures += moved_figures(clip, drawn[name], name)
    return figures + unchanged(clip)


def through(
    network: StyleGANEX, config: StyleganexConfig, clip: Sequence[np.ndarray], marks: Landmarks
) -> list[np.ndarray]:
    """The clip through the network."""
    engine = Engine(lambda: network, compile_clip, config)
    kind = AlignedStylizer if config.framing == "aligned" else StyleganexStylizer
    style = kind("seeded", "a network of random weights", engine)
    return styled(clip, marks, style, stylize.prepare(iter(clip), marks, style))


def moved_figures(clip: Sequence[np.ndarray], drawn: Sequence[np.ndarray], name: str) -> list[Figure]:
    """What a frame is that its neighbours make, beside the computed one: dB, and share of its sharpness."""
    moved = half_moved(clip, drawn)
    odd = range(1, len(clip) - 1, 2)
    error = np.mean([float(psnr(unit(moved[now]), unit(drawn[now]))) for now in odd])
    kept = np.mean([sharpness(moved[now]) / sharpness(drawn[now]) for now in odd])
    return [
        Figure(f"moved frames against computed ones, {name}", float(error), "dB"),
        Figure(f"sharpness of moved frames, {name}", 100 * float(kept), "%"),
    ]


def sharpness(frame: np.ndarray) -> float:
    """Variance of the Laplacian."""
    return float(cv2.Laplacian(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), cv2.CV_64F).var())


def unit(frame: np.ndarray) -> torch.Tensor:
    """The frame in 0..1."""
    return torch.from_numpy(frame).float() / 255


def half_moved(source: Sequence[np.ndarray], drawn: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Every second frame replaced by the mean of its neighbours, moved onto it along the source's optical flow."""
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in source]
    frames = list(drawn)
    for now in range(1, len(source) - 1, 2):
        moved = [
            filters.sample(drawn[near], filters.pixel_grid(*grey[now].shape) + steady.motion(grey[now], grey[near]))
            for near in (now - 1, now + 1)
        ]
        frames[now] = np.rint((moved[0].astype(np.float32) + moved[1]) / 2).astype(np.uint8)
    return frames


def unchanged(clip: Sequence[np.ndarray]) -> list[Figure]:
    """Share of the network's cells in which the next frame is the same, also with a margin of such cells around."""
    size = NETWORK_SIDE // CELL
    shares: dict[int, list[float]] = {0: [], 2: [], 4: []}
    for before, now in pairwise(clip):
        change = np.abs(before.astype(np.int16) - now).max(-1)
        side = change.shape[0] // size * size
        cells = change[:side, :side].reshape(size, side // size, size, side // size).max((1, 3)) > SAME
        for margin, found in shares.items():
            reach = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
            found.append(1.0 - float(cv2.dilate(cells.astype(np.uint8), reach).mean()))
    return [
        Figure(f"cells unchanged, and {margin} around them", 100 * float(np.mean(found)), "%")
        for margin, found in shares.items()
    ]
