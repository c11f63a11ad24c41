"""The neck: a head turns on a body that stays, so the turn belongs to the neck joint.

The tracker sees a face and knows its pose alone. How the neck gets there is the head model's to say: with the body
facing where the head faces on average, the turn relative to it goes to the neck, whose skinning leaves the
shoulders where they are. The head itself is not moved by this.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from toonifygb.head import NECK, ROOT

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.head import HeadModel
    from toonifygb.structures import HeadMotion


def on_a_neck(motion: HeadMotion, head: HeadModel, shape: Float[Tensor, " s"]) -> HeadMotion:
    """The same heads with the root held in the clip's mean direction and the rest of the turn in the neck.

    Args:
        motion: of n frames, all of it in the root; the neck's rotation is zero.
        head: the head model.
        shape: identity.
    """
    turn = axis_angle_to_matrix(motion.joints[:, ROOT])
    body = _mean_rotation(turn)
    rest = head.joints(shape, motion.expression)
    arm = rest[:, NECK] - rest[:, ROOT]
    joints = motion.joints.clone()
    joints[:, ROOT] = matrix_to_axis_angle(body)
    joints[:, NECK] = matrix_to_axis_angle(body.mT @ turn)
    # The neck joint carries the head, so it must stay where it is in the world.
    translation = motion.translation + torch.einsum("nab,nb->na", turn - body, arm)
    return replace(motion, joints=joints, translation=translation)


def _mean_rotation(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "3 3"]:
    """Rotation nearest to the mean of the matrices."""
    left, _, right = torch.linalg.svd(rotations.double().mean(0))
    sign = torch.ones(3, dtype=left.dtype)
    sign[2] = torch.linalg.det(left @ right)
    return (left @ torch.diag(sign) @ right).to(rotations.dtype)
