"""How steadily a style draws what moves: the warping error.

ITF and ISI compare a frame with the next as it is, and so count the subject's motion. The warping error (Lai et
al. 2018, Eq. 7, here as a mean absolute difference) first moves the next frame back along the motion, and leaves
out what is hidden in one of the two. The motion is that of the *filmed* frames: it is the same for every style, and
a style cannot look steady by drawing what is easily followed.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.errors import InputError
from toonifygb.stylize.filters import dot, pixel_grid, resize, sample
from toonifygb.stylize.steady import motion

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jaxtyping import Bool, Float, UInt8

    Frame = UInt8[np.ndarray, "h w 3"]
    Field = Float[np.ndarray, "h w 2"]

LONGEST_SIDE = 512
"""Larger frames are compared at this size: the motion is no finer, and the cost stays bounded."""
_PART, _FLOOR = 0.01, 0.5
"""Where the way there and back does not return by this share of its squared length plus this many px², something
is hidden (Sundaram et al. 2010, Eq. 5)."""


def warping_error(filmed: Iterable[Frame], styled: Iterable[Frame]) -> float:
    """Mean absolute difference, 0..1, of consecutive stylised frames after the motion between them is undone.

    Args:
        filmed: the source frames.
        styled: the same frames in their style; another size is brought to the source's.

    Raises:
        InputError: fewer than two frames.
    """
    errors = [_step_error(*first, *second) for first, second in pairwise(_small_pairs(filmed, styled))]
    if not errors:
        raise InputError("the warping error compares consecutive frames and needs at least 2", "give a longer clip")
    return float(np.mean(errors))


def _small_pairs(filmed: Iterable[Frame], styled: Iterable[Frame]) -> Iterable[tuple[np.ndarray, Frame]]:
    """Grey source and stylised frame at the size they are compared at; streaming."""
    for source, drawn in zip(filmed, styled, strict=False):
        height, width = source.shape[:2]
        scale = min(1.0, LONGEST_SIDE / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        yield cv2.cvtColor(resize(source, *size), cv2.COLOR_RGB2GRAY), resize(drawn, *size)


def _step_error(grey: np.ndarray, drawn: Frame, next_grey: np.ndarray, next_drawn: Frame) -> float:
    """Mean absolute difference where both frames show the same; 0 where nothing can be compared."""
    there, back = motion(grey, next_grey), motion(next_grey, grey)
    seen = visible(there, back)
    moved = sample(next_drawn, pixel_grid(*grey.shape) + there)
    difference = cv2.absdiff(moved, drawn).astype(np.float32).mean(axis=2)
    return float(difference[seen].mean() / 255.0) if seen.any() else 0.0


def visible(there: Field, back: Field) -> Bool[np.ndarray, "h w"]:
    """Which pixels of a frame are also in the next: those from which the way there and back returns.

    Args:
        there: displacement to the next frame, px.
        back: displacement from it, px.
    """
    height, width = there.shape[:2]
    landing = pixel_grid(height, width) + there
    returned = sample(back, landing)
    astray = there + returned
    allowed = _PART * (dot(there, there) + dot(returned, returned)) + _FLOOR
    inside = ((landing >= 0) & (landing <= [width - 1, height - 1])).all(axis=2)
    return (dot(astray, astray) <= allowed) & inside
