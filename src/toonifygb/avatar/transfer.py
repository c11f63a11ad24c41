"""From a head mesh to the Gaussians on it: displacements, turns, and how much each blendshape may change.

Every function is small and literal, after 3D Gaussian Blendshapes (3DGB); where upstream does something this house
does not, the difference is an argument.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch

from toonifygb.geometry.align import kabsch
from toonifygb.geometry.meshes import barycentric, deformation_gradient
from toonifygb.geometry.rotations import matrix_to_quat, polar_factor, quat_multiply

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

FULL_DISPLACEMENT = 0.005703532602638
"""Displacement that earns the full learning rate, m: the largest of FLAME's first expression component."""
NO_DISPLACEMENT = 0.1 * 0.000237277025008
"""Displacement below which a blendshape leaves a Gaussian alone, m."""
Mix = Literal["barycentric", "corner_sum", "corner_mean"]


def mix_vertices(
    values: Float[Tensor, "*b v c"],
    faces: Int[Tensor, "f 3"],
    face_ids: Int[Tensor, " n"],
    weights: Float[Tensor, "n 3"],
    how: Mix = "barycentric",
) -> Float[Tensor, "*b n c"]:
    """Vertex values at surface points.

    Args:
        values: one row per vertex.
        faces: vertex ids of the corners.
        face_ids: face of each point.
        weights: barycentric coordinates of each point.
        how: upstream adds up the three corners' pose correctives (``corner_sum``, three times FLAME's) and
            averages the corners' eyelid offsets (``corner_mean``); barycentric is what both should be.
    """
    if how == "barycentric":
        return barycentric(values, faces, face_ids, weights)
    corners = values[..., faces[face_ids], :]
    return corners.sum(-2) if how == "corner_sum" else corners.mean(-2)


def turns(
    rest: Float[Tensor, "v 3"],
    deformed: Float[Tensor, "*e v 3"],
    faces: Int[Tensor, "f 3"],
    face_ids: Int[Tensor, " n"],
    quats: Float[Tensor, "n 4"],
) -> Float[Tensor, "*e n 4"]:
    """Quaternion deltas (q_k - 1) ⊗ q0 by which Gaussians follow the turning of their face.

    q_k is the rotation factor of the face's deformation gradient; faces without area give no turn.
    """
    wanted, slot = face_ids.unique(return_inverse=True)
    gradient = deformation_gradient(rest, deformed, faces[wanted])
    turn = matrix_to_quat(polar_factor(gradient, iterations=3))
    turn = torch.where(turn.isfinite().all(-1, keepdim=True), turn, turn.new_tensor([1.0, 0.0, 0.0, 0.0]))
    change = turn - turn.new_tensor([1.0, 0.0, 0.0, 0.0])
    return quat_multiply(change[..., slot, :], quats)


def consistency(displacement: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Blendshape consistency scale: 0 where a unit blendshape hardly moves the surface, 1 where it moves fully.

    Not limited above. The floor inside the root keeps the gradient finite at zero displacement.
    """
    length = displacement.square().sum(-1).clamp_min(1e-18).sqrt()
    return ((length - NO_DISPLACEMENT) / (FULL_DISPLACEMENT - NO_DISPLACEMENT)).clamp_min(0.0)


def face_consistency(
    rest: Float[Tensor, "v 3"],
    deformed: Float[Tensor, "e v 3"],
    faces: Int[Tensor, "f 3"],
    rigid_ids: Int[Tensor, " r"],
    excluded_ids: Int[Tensor, " x"],
) -> Float[Tensor, "e f"]:
    """Consistency scale of each face for each blendshape.

    Args:
        rest: mesh without expression, m.
        deformed: the mesh with each blendshape at 1.
        faces: vertex ids of the corners.
        rigid_ids: back-of-head vertices; each deformed mesh is first aligned rigidly on them.
        excluded_ids: neck vertices; their displacement counts as zero.
    """
    rotation, translation = kabsch(deformed[:, rigid_ids], rest[rigid_ids].expand(len(deformed), -1, -1))
    moved = deformed @ rotation.mT + translation[:, None] - rest
    moved[:, excluded_ids] = 0.0
    return consistency(moved[:, faces].mean(-2))
