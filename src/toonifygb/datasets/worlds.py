"""From the cameras and poses of other projects to ours.

Ours: the camera stands still with OpenGL axes and the head moves before it. Others let the head stand and the
camera move, or both; all say the same about where a point of the head is seen from the camera.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from toonifygb.head import NECK, ROOT
from toonifygb.structures import HeadMotion

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.head import HeadModel


def flip(like: Tensor) -> Float[Tensor, "3 3"]:
    """Between OpenCV's camera axes (y down, z forward) and OpenGL's (y up, z backward), either way."""
    return torch.diag(like.new_tensor([1.0, -1.0, -1.0]))


def before_camera(
    head: HeadModel,
    shape: Float[Tensor, " s"],
    motion: HeadMotion,
    rotation: Float[Tensor, "t 3 3"],
    translation: Float[Tensor, "t 3"],
) -> HeadMotion:
    """Motion in front of our camera of a head that moves in a world of its own.

    Args:
        head: the head model.
        shape: β.
        motion: in that world; as in FLAME the root turns about its rest position and the translation comes last.
        rotation: that world to OpenCV's camera, x ↦ R x + t.
        translation: t, m.
    """
    axes = flip(rotation)
    root = head.joints(shape, motion.expression)[..., ROOT, :]
    turn = axes @ rotation @ axis_angle_to_matrix(motion.joints[:, ROOT])
    joints = motion.joints.clone()
    joints[:, ROOT] = matrix_to_axis_angle(turn)
    seen = torch.einsum("tab,tb->ta", rotation, root + motion.translation) + translation
    return HeadMotion(motion.expression, joints, seen @ axes - root, motion.eyelids)


def from_pytorch3d(
    rotation: Float[Tensor, "t 3 3"], translation: Float[Tensor, "t 3"]
) -> tuple[Float[Tensor, "t 3 3"], Float[Tensor, "t 3"]]:
    """PyTorch3D's camera (X_c = X R + T with rows, x left, y up) as OpenCV's x ↦ R x + t."""
    axes = torch.diag(rotation.new_tensor([-1.0, -1.0, 1.0]))
    return (rotation @ axes).mT, translation @ axes


def to_pytorch3d(
    rotation: Float[Tensor, "t 3 3"], translation: Float[Tensor, "t 3"]
) -> tuple[Float[Tensor, "t 3 3"], Float[Tensor, "t 3"]]:
    """The inverse of ``from_pytorch3d``."""
    axes = torch.diag(rotation.new_tensor([-1.0, -1.0, 1.0]))
    return rotation.mT @ axes, translation @ axes


def pytorch3d_intrinsics(
    focal: Float[Tensor, " t"], principal: Float[Tensor, "t 2"], width: int, height: int
) -> Float[Tensor, "t 3 3"]:
    """K of a PyTorch3D camera in normalised device coordinates: units of half the shorter side, x left, y up."""
    half = min(width, height) / 2
    K = torch.zeros(len(focal), 3, 3, dtype=focal.dtype)
    K[:, 0, 0] = K[:, 1, 1] = focal * half
    K[:, :2, 2] = focal.new_tensor([width / 2, height / 2]) - principal * half
    K[:, 2, 2] = 1
    return K


def head_to_camera(
    head: HeadModel, shape: Float[Tensor, " s"], motion: HeadMotion, world_to_camera: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "t 3 3"], Float[Tensor, "t 3"]]:
    """Map x ↦ R x + t from a head that stands still to OpenCV's camera, as trackers with a moving camera have it.

    The turn of the neck goes into it: skull, face, jaw and eyes end up where they were; the neck's own skin,
    which such trackers hold stiff, does not follow.
    """
    # The joints are asked for; of a whole clip's vertices there would be gigabytes.
    _, transforms = head.subset(torch.zeros(1, dtype=torch.int64)).forward(shape, motion)
    skull = transforms[:, NECK]
    camera, place = world_to_camera[:3, :3], world_to_camera[:3, 3]
    rotation = camera @ skull[:, :3, :3]
    translation = (skull[:, :3, 3] + motion.translation) @ camera.T + place
    return rotation, translation
