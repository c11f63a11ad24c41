"""Which video to track: the filmed one or the stylised one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch

from toonifygb.track.start import face_size, upright
from toonifygb.track.steadiness import jitter_px

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.structures import Landmarks

DEFORMED = 0.02
"""Lasting displacement of the landmarks by the style, as a share of the face's size, from which a head fitted to
the filmed face visibly misses the drawn one (5 px at 230 px)."""
UNSTEADY = 1.5
"""Ratio of jitter up to which a drawn face is followed all the same."""
LOST_MORE = 0.02
"""Share of frames a style may cost."""


@dataclass(frozen=True)
class Choice:
    """The video to track, and why."""

    on: Literal["original", "stylized"]
    reason: str


def choose_source(original: Landmarks, stylized: Landmarks) -> Choice:
    """The video whose landmarks are steadier, unless the style moves the features of the face.

    A style that only paints leaves the face where it is, and the filmed face is detected more steadily. A style
    that redraws it (larger eyes, another jaw) moves the landmarks for the whole clip; then the drawn face is the
    one to explain, if it can be followed about as steadily.

    Args:
        original: landmarks of the filmed frames.
        stylized: landmarks of the same frames after stylisation; NaN where no face was found.
    """
    lost = float(original.valid.float().mean() - stylized.valid.float().mean())
    if lost > LOST_MORE:
        return Choice("original", f"the style hides the face in {lost:.0%} more of the frames")
    both = original.valid & stylized.valid
    if not bool(both.any()):
        return Choice("original", "no frame shows the face in both videos")
    jitter, jitter_stylized = jitter_px(original.points), jitter_px(stylized.points)
    figures = f"jitter {jitter_stylized:.2f} px against {jitter:.2f} px"
    if jitter_stylized < jitter:
        return Choice("stylized", f"the stylised landmarks are steadier: {figures}")
    moved = lasting_displacement(original.points[both], stylized.points[both])
    if moved > DEFORMED and jitter_stylized <= UNSTEADY * jitter:
        return Choice("stylized", f"the style moves the features by {moved:.1%} of the face; {figures}")
    return Choice("original", f"the filmed landmarks are steadier: {figures}")


def lasting_displacement(original: Float[Tensor, "t l 2"], stylized: Float[Tensor, "t l 2"]) -> float:
    """How far a style moves landmarks for a whole clip, mean over landmarks, as a share of the face's size.

    Taken in axes that follow the filmed face's place, size and roll, as the median over time.
    """
    middle, size = original.mean(1, keepdim=True), face_size(original)[:, None, None]
    moved = (stylized - middle) / size - (original - middle) / size
    # Rows of the levelled frame: the same turn that makes the filmed eyes level.
    turn = torch.linalg.lstsq((original - middle) / size, upright(original)).solution
    return float((moved @ turn).median(0).values.norm(dim=-1).mean())
