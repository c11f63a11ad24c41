"""Linear blend skinning of a joint tree, as in FLAME.

Joint transforms A carry rest positions to posed ones; a point moves by its weighted mean of them. Positions are
metres, rotations relative to the parent joint.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float
    from torch import Tensor


def joint_transforms(
    rotations: Float[Tensor, "*b j 3 3"], rest_joints: Float[Tensor, "*b j 3"], parents: Sequence[int]
) -> Float[Tensor, "*b j 4 4"]:
    """Transforms from rest to posed space, one per joint.

    Each joint turns about its own rest position, then moves with its parent; the root turns about the root's
    rest position and stays there.

    Args:
        rotations: each joint's rotation relative to its parent.
        rest_joints: joint positions in the rest pose, m.
        parents: index of each joint's parent, -1 for a root; parents come before their children.
    """
    assert all(parent < joint for joint, parent in enumerate(parents)), f"parents {parents} are not sorted"
    turn: list[Tensor] = []
    move: list[Tensor] = []
    for joint, parent in enumerate(parents):
        # x ↦ R (x - p) + p, the joint's own motion in the parent's rest frame.
        own_turn = rotations[..., joint, :, :]
        pivot = rest_joints[..., joint, :]
        own_move = pivot - _apply(own_turn, pivot)
        if parent >= 0:
            own_move = _apply(turn[parent], own_move) + move[parent]
            own_turn = turn[parent] @ own_turn
        turn.append(own_turn)
        move.append(own_move)
    return affine(torch.stack(turn, -3), torch.stack(move, -2))


def affine(linear: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """Homogeneous matrix of ``x ↦ linear x + translation``."""
    upper = torch.cat((linear, translation[..., None].to(linear)), -1)
    last = upper.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*upper.shape[:-2], 1, 4)
    return torch.cat((upper, last), -2)


def blend_transforms(
    weights: Float[Tensor, "n j"], transforms: Float[Tensor, "*b j 4 4"]
) -> Float[Tensor, "*b n 4 4"]:
    """Each point's weighted mean of the joint transforms; affine, in general no rigid motion."""
    flat = weights @ transforms.flatten(-2)
    return flat.unflatten(-1, (4, 4))


def skin(
    points: Float[Tensor, "*b n 3"], weights: Float[Tensor, "n j"], transforms: Float[Tensor, "*b j 4 4"]
) -> Float[Tensor, "*b n 3"]:
    """Points moved from rest to posed space, m.

    Args:
        points: rest positions; may lack the transforms' leading axes.
        weights: share of each joint, rows sum to 1.
        transforms: from ``joint_transforms``.
    """
    blended = blend_transforms(weights, transforms)
    return _apply(blended[..., :3, :3], points) + blended[..., :3, 3]


def pose_feature(rotations: Float[Tensor, "*b 5 3 3"]) -> Float[Tensor, "*b 36"]:
    """What drives FLAME's pose correctives: row-major R - I of every joint but the root."""
    identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
    return (rotations[..., 1:, :, :] - identity).flatten(-3)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None]).squeeze(-1)
