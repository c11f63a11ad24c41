"""Heads and faces moved a little: the quantities that photometric tracking fits, and what changing them does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from toonifygb.avatar.model import head_rotation
from toonifygb.geometry.rotations import (
    axis_angle_to_matrix,
    matrix_to_axis_angle,
    matrix_to_quat,
    quat_multiply,
)
from toonifygb.head import JAW, NECK, ROOT

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from toonifygb.avatar import Avatar
    from toonifygb.head import HeadModel
    from toonifygb.structures import HeadMotion, Splats, TrackedSequence

TURN, SHIFT, JAW_TURN = slice(0, 3), slice(3, 6), slice(6, 9)
"""Where a change has its rotation vector of the head (world axes, rad), its translation (world, m) and its jaw
(rotation vector, rad); expression units and eyelids follow, in the order of the avatar's blendshapes."""
RIGID = 6


@dataclass(frozen=True)
class Poses:
    """The poses and expressions of a clip and what changing them needs.

    A change is a row of ``RIGID`` + 3 + blendshapes numbers; it is small.
    """

    avatar: Avatar
    head: HeadModel
    sequence: TrackedSequence

    @property
    def width(self) -> int:
        """Numbers in a change."""
        return JAW_TURN.stop + self.avatar.n_expressions + self.avatar.n_eyelids

    @property
    def pivot(self) -> Float[Tensor, "t 3"]:
        """Middle of the eyes in the world, m: turning about it hardly moves what the landmarks have fixed."""
        eyes = self.avatar.transforms(self.sequence.motion)[:, 3:, :3]
        rest = self.avatar.rest_joints[3:]
        return (torch.einsum("tjab,jb->tja", eyes[..., :3], rest) + eyes[..., 3]).mean(1)

    @property
    def rotation(self) -> Float[Tensor, "t 3 3"]:
        """Head to world."""
        return head_rotation(self.sequence.motion)

    @property
    def jaw(self) -> Float[Tensor, "t 3"]:
        """The jaw's joint in the world, m."""
        placed = self.avatar.transforms(self.sequence.motion)[:, JAW, :3]
        return placed[..., :3] @ self.avatar.rest_joints[JAW] + placed[..., 3]

    def faces(self, index: int, changes: Float[Tensor, "b c"]) -> HeadMotion:
        """One frame with its jaw, expression and lids changed by each row, without limits; heads stay."""
        motion = self.sequence.motion[index].map(lambda value: value.expand(len(changes), *value.shape).clone())
        units, lids = self._units(changes)
        motion.joints[:, JAW] += changes[:, JAW_TURN]
        motion.expression[:, : units.shape[1]] += units
        motion.eyelids[:, : lids.shape[1]] += lids
        return motion

    def without_common(
        self, changes: Float[Tensor, "t c"], earlier: Float[Tensor, "t c"], frames: Int[Tensor, " n"]
    ) -> Float[Tensor, "t c"]:
        """Changes after which all changes together have no mean; that of the pose is taken in the head's axes.

        Args:
            changes: about to be made.
            earlier: made since the landmark track.
            frames: those that count and change.
        """
        turn = self.rotation[frames]
        both = (changes + earlier)[frames]
        common = torch.einsum("nba,nkb->nka", turn, both[:, :RIGID].view(-1, 2, 3)).mean(0)
        left = changes.clone()
        left[frames, :RIGID] -= torch.einsum("nab,kb->nka", turn, common).flatten(1)
        left[frames, RIGID:] -= both[:, RIGID:].mean(0)
        return left

    def moved(self, changes: Float[Tensor, "t c"]) -> TrackedSequence:
        """The track with every head turned about its pivot and shifted, and faces changed within their limits."""
        motion, pivot = self.sequence.motion, self.pivot
        turn = axis_angle_to_matrix(changes[:, TURN])
        body = axis_angle_to_matrix(motion.joints[:, ROOT])
        joints = motion.joints.clone()
        joints[:, NECK] = matrix_to_axis_angle(body.mT @ turn @ self.rotation)
        joints[:, JAW] += changes[:, JAW_TURN]
        # The head hangs on the neck joint: the body goes where that joint has to go.
        placed = self.avatar.transforms(motion)[:, ROOT]
        rest = self.avatar.rest_joints[NECK] + motion.expression @ self.avatar.joint_expression_basis[NECK].T
        neck = torch.einsum("tab,tb->ta", placed[:, :3, :3], rest) + placed[:, :3, 3]
        arm = neck - pivot
        units, lids = self._units(changes)
        translation = motion.translation + torch.einsum("tab,tb->ta", turn, arm) - arm + changes[:, SHIFT]
        moved = replace(
            motion,
            expression=_limited(motion.expression, units, self.head.expression_lower, self.head.expression_upper),
            joints=joints,
            translation=translation,
            eyelids=_limited(motion.eyelids, lids, torch.zeros(2), torch.ones(2)),
        )
        return replace(self.sequence, motion=moved)

    def _units(self, changes: Float[Tensor, "b c"]) -> tuple[Float[Tensor, "b e"], Float[Tensor, "b l"]]:
        """Changes of the expression units and of the lids, as many as the head model has."""
        units, lids = changes[:, JAW_TURN.stop :].split([self.avatar.n_expressions, self.avatar.n_eyelids], 1)
        return units, lids


def _limited(
    values: Float[Tensor, "t c"],
    changes: Float[Tensor, "t d"],
    lower: Float[Tensor, " c"],
    upper: Float[Tensor, " c"],
) -> Float[Tensor, "t c"]:
    """The first d values changed within limits; one that is beyond already may stay and never goes further."""
    wanted = values.clone()
    wanted[:, : changes.shape[1]] += changes
    return wanted.clamp(torch.minimum(lower, values), torch.maximum(upper, values))


def carried(
    splats: Splats, twist: Float[Tensor, " 6"], pivot: Float[Tensor, " 3"], which: Bool[Tensor, " n"]
) -> Splats:
    """Splats of which some are turned about the pivot by a rotation vector, then shifted."""
    rotation = axis_angle_to_matrix(twist[:3])
    turn = matrix_to_quat(rotation).expand_as(splats.quats)
    some = which[:, None]
    frames = splats.sh_frames
    return replace(
        splats,
        means=torch.where(some, (splats.means - pivot) @ rotation.T + pivot + twist[3:], splats.means),
        quats=torch.where(some, quat_multiply(turn, splats.quats), splats.quats),
        sh_frames=None if frames is None else torch.where(some[..., None], rotation @ frames, frames),
    )
