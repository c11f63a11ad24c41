"""FLAME-like rigs: a head model from the arrays that FLAME's own files hold.

FLAME itself is licensed to its users and never ships here; this takes its arrays once they are read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.head.base import HeadModel

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

SIGMAS = 3.0
"""FLAME's expression coefficients are standard deviations; beyond this many they leave its training set."""


def from_arrays(
    template: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    shape_basis: Float[Tensor, "v 3 s"],
    expression_basis: Float[Tensor, "v 3 e"],
    pose_basis: Float[Tensor, "36 v 3"],
    joint_regressor: Float[Tensor, "5 v"],
    skin_weights: Float[Tensor, "v 5"],
    *,
    name: str = "flame",
    eyelid_basis: Float[Tensor, "v 3 2"] | None = None,
    part: Int[Tensor, " v"] | None = None,
    regions: dict[str, Float[Tensor, " v"]] | None = None,
) -> HeadModel:
    """Head model of a FLAME-like rig; precision follows ``template``.

    Joints are linear in the vertices, so the regressor is folded into the joints' own bases. Eyelids move the
    rest pose here, before skinning; 3DGB adds them after it, which is the same while the head itself is unturned.
    Such a rig knows no landmarks: it carries none.

    Args:
        template: mean vertices, m.
        faces: counter-clockwise seen from outside.
        shape_basis: m per standard deviation.
        expression_basis: m per standard deviation.
        pose_basis: correctives of all 36 pose features, m.
        joint_regressor: joints as weighted means of vertices.
        skin_weights: rows sum to 1.
        name: stored in the model and in what is tracked with it.
        eyelid_basis: left and right lid, m per unit closure.
        part: index into ``PARTS``; all skin when absent.
        regions: soft vertex masks by name.
    """
    n_vertices, n_expression = template.shape[0], expression_basis.shape[-1]
    ones = template.new_ones(n_expression)
    return HeadModel(
        name=name,
        template=template,
        faces=faces,
        shape_basis=shape_basis,
        expression_basis=expression_basis,
        expression_names=tuple(f"expression_{index:03d}" for index in range(n_expression)),
        expression_sigma=ones,
        expression_lower=-SIGMAS * ones,
        expression_upper=SIGMAS * ones,
        eyelid_basis=eyelid_basis,
        pose_basis=pose_basis,
        pose_features=torch.arange(36),
        rest_joints=joint_regressor @ template,
        joint_shape_basis=torch.einsum("jv,vcs->jcs", joint_regressor, shape_basis),
        joint_expression_basis=torch.einsum("jv,vce->jce", joint_regressor, expression_basis),
        skin_weights=skin_weights,
        part=torch.zeros(n_vertices, dtype=torch.int64) if part is None else part,
        regions=regions or {},
        landmark_faces=torch.zeros(0, dtype=torch.int64),
        landmark_bary=template.new_zeros(0, 3),
        landmark_offset=template.new_zeros(0, 3),
        landmark_sigma=template.new_zeros(0),
        landmark_mirror=torch.zeros(0, dtype=torch.int64),
    )
