"""Frames that cannot be trusted: finding single jumps, and bridging what was lost."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from toonifygb.track.start import face_size

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from toonifygb.structures import HeadMotion

JUMP_LEAST = 0.12
"""A face that leaves the line between its neighbours by less than this share of its size is never a jump. At
``JUMP_FPS`` and above that is an acceleration no neck produces; slower clips are given more, in proportion."""
JUMP_FPS = 25.0
JUMP_RATIO = 2.5
"""... nor one that leaves it by less than this times its neighbours' own distance."""
MISFIT_RATIO = 4.0
"""Frames whose error exceeds this times the clip's median are no face the model can explain ..."""
MISFIT_LEAST_PX = 5.0
"""... unless it is below this, px at 230 px face width."""


def jumps(points: Float[Tensor, "t l 2"], fps: float) -> Bool[Tensor, " t"]:
    """Single frames in which the landmarks leap away and back: another face, or a detector's slip.

    Args:
        points: landmarks, px; NaN where lost. Frames with a lost neighbour are never called jumps.
        fps: frames per second.
    """
    found = torch.zeros(points.shape[0], dtype=torch.bool, device=points.device)
    if points.shape[0] < 3:
        return found
    before, here, after = points[:-2], points[1:-1], points[2:]
    size = torch.minimum(face_size(before), face_size(after))
    away = (here - (before + after) / 2).norm(dim=-1).mean(-1) / size
    apart = (after - before).norm(dim=-1).mean(-1) / size
    least = JUMP_LEAST * max(1.0, JUMP_FPS / fps)
    leap = (away > least) & (away > JUMP_RATIO * apart)
    # The frames beside a leap deviate too, by half as much: only the peak is the culprit.
    padded = torch.nn.functional.pad(away.nan_to_num(0.0), (1, 1))
    peak = (away > padded[:-2]) & (away >= padded[2:])
    found[1:-1] = leap & peak
    return found


def misfits(error_px: Float[Tensor, " t"]) -> Bool[Tensor, " t"]:
    """Frames that the fitted model does not explain."""
    return error_px > max(MISFIT_LEAST_PX, MISFIT_RATIO * float(error_px.nanmedian()))


def bridged(motion: HeadMotion, frames: Int[Tensor, " k"], n_frames: int) -> HeadMotion:
    """Motion of every frame of a clip from that of the trusted ones.

    Between trusted frames, rotations turn at constant speed about one axis (slerp) and everything else moves
    linearly; before the first and after the last the head stands still.

    Args:
        motion: the trusted frames.
        frames: their numbers, ascending, at least one.
        n_frames: number of frames of the clip.
    """
    wanted = torch.arange(n_frames, device=frames.device)
    right = torch.searchsorted(frames, wanted).clamp(max=len(frames) - 1)
    left = torch.where(frames[right] > wanted, right - 1, right).clamp(min=0)
    span = (frames[right] - frames[left]).clamp(min=1)
    share = ((wanted - frames[left]) / span).clamp(0, 1).to(motion.translation)
    first, last = motion[left], motion[right]
    start = axis_angle_to_matrix(first.joints)
    turn = matrix_to_axis_angle(start.mT @ axis_angle_to_matrix(last.joints))
    joints = matrix_to_axis_angle(start @ axis_angle_to_matrix(share[:, None, None] * turn))
    # Trusted frames are handed through bit by bit.
    joints = torch.where((left == right)[:, None, None], first.joints, joints)
    mixed = {
        name: torch.lerp(getattr(first, name), getattr(last, name), share[:, None])
        for name in ("expression", "translation", "eyelids")
    }
    return replace(first, joints=joints, **mixed)
