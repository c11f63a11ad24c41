"""How far a fitted sequence is from the one its clip was drawn from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.errors import InputError
from toonifygb.geometry.align import umeyama
from toonifygb.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from toonifygb.head import JAW, NECK, PARTS

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.head import HeadModel
    from toonifygb.structures import TrackedSequence

CHUNK = 50
"""Frames posed at once."""


@dataclass(frozen=True)
class FitErrors:
    """Errors of each frame; NaN where the fit does not claim to have tracked it."""

    rotation_deg: Float[Tensor, " t"]
    """Angle between the skulls' orientations in the world; nothing is removed first."""
    jaw_deg: Float[Tensor, " t"]
    """Angle between the jaws' rotations relative to the skull."""
    face_mm: Float[Tensor, " t"]
    """Mean distance of corresponding points of the face after the best similarity transform."""

    def means(self) -> dict[str, float]:
        """Mean of each error over the tracked frames."""
        return {name: float(values.nanmean()) for name, values in vars(self).items()}


def errors(fitted: TrackedSequence, truth: TrackedSequence, head: HeadModel) -> FitErrors:
    """Errors of a fit against the truth, frame by frame.

    Raises:
        InputError: the sequences differ in length.
    """
    if fitted.n_frames != truth.n_frames:
        raise InputError(
            f"the fit has {fitted.n_frames} frames and the truth {truth.n_frames}, they must agree",
            "track the clip that the truth belongs to",
        )
    part_is_skin = head.part == PARTS.index("skin")
    face = head.subset(((head.regions["face"] > 0.5) & part_is_skin).nonzero()[:, 0])
    rotation, jaw, distance = [], [], []
    for first in range(0, truth.n_frames, CHUNK):
        frames = slice(first, first + CHUNK)
        ours, our_turns = face.forward(fitted.shape, fitted.motion[frames])
        true, true_turns = face.forward(truth.shape, truth.motion[frames])
        rotation.append(_angle_deg(our_turns[:, NECK, :3, :3], true_turns[:, NECK, :3, :3]))
        our_jaw, true_jaw = (
            axis_angle_to_matrix(sequence.motion.joints[frames, JAW]) for sequence in (fitted, truth)
        )
        jaw.append(_angle_deg(our_jaw, true_jaw))
        distance.append(_aligned_distance_mm(ours, true))
    known = torch.where(fitted.tracked, 1.0, torch.nan)
    return FitErrors(*(torch.cat(parts) * known for parts in (rotation, jaw, distance)))


def _angle_deg(a: Float[Tensor, "t 3 3"], b: Float[Tensor, "t 3 3"]) -> Float[Tensor, " t"]:
    """Angle of the rotation between two, degrees."""
    return torch.rad2deg(torch.linalg.vector_norm(matrix_to_axis_angle(a @ b.mT), dim=-1))


def _aligned_distance_mm(a: Float[Tensor, "t v 3"], b: Float[Tensor, "t v 3"]) -> Float[Tensor, " t"]:
    """Mean distance after moving, turning and scaling ``a`` onto ``b``, mm."""
    scale, rotation, offset = umeyama(a, b)
    moved = scale[:, None, None] * (a @ rotation.mT) + offset[:, None]
    return 1000 * torch.linalg.vector_norm(moved - b, dim=-1).mean(-1)
