"""How steady landmarks and tracks are, and what a person should be told about a track."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.track.fitting import ERROR_FACE_PX
from toonifygb.track.start import face_size

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.structures import TrackedSequence


def jitter_px(points: Float[Tensor, "t l 2"]) -> float:
    """Mean length of the landmarks' second difference in time, px with the face scaled to 230 px.

    Steady motion gives 0, independent noise of σ px per axis about 3.1 σ. Frames without three found neighbours
    are left out; NaN where none remain.
    """
    if points.shape[0] < 3:
        return float("nan")
    bend = points.diff(n=2, dim=0).norm(dim=-1).mean(-1)
    return float((bend * ERROR_FACE_PX / face_size(points)[1:-1]).nanmean())


@dataclass(frozen=True)
class Report:
    """A track in figures and sentences."""

    tracked_share: float
    """Share of the frames with a trusted face."""
    error_px: float
    """Mean landmark error at 230 px face size."""
    problems: tuple[str, ...]
    """What a person should know, one sentence each."""


POOR_ERROR_PX = 2.5
"""Mean error beyond which a track shows: the mesh visibly leaves lips or lids."""


def report(sequence: TrackedSequence) -> Report:
    """Figures of a track and sentences about its bridged stretches and poor fit."""
    error = float(sequence.error_px.nanmean())
    problems = [f"{_stretch(run)} no usable face; the motion is bridged" for run in _lost(sequence.tracked)]
    if error > POOR_ERROR_PX:
        problems.append(
            f"the mean landmark error is {error:.1f} px at 230 px face size, at most {POOR_ERROR_PX} px is expected"
        )
    return Report(float(sequence.tracked.float().mean()), error, tuple(problems))


def _lost(tracked: Tensor) -> list[tuple[int, int]]:
    """First and last frame of each stretch without a trusted face."""
    edges = torch.nn.functional.pad((~tracked).int(), (1, 1)).diff()
    starts, stops = (edges == 1).nonzero()[:, 0], (edges == -1).nonzero()[:, 0] - 1
    return list(zip(starts.tolist(), stops.tolist(), strict=True))


def _stretch(run: tuple[int, int]) -> str:
    return f"frame {run[0]} has" if run[0] == run[1] else f"frames {run[0]} to {run[1]} have"
