"""The avatar: neutral Gaussians, blendshape deltas, skinning and two mouth sets, posed by a ``HeadMotion``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from toonifygb.avatar.bases import Mixer
from toonifygb.avatar.skinning import activate, blend_parameters, concatenate, pose_offsets, skin_splats
from toonifygb.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from toonifygb.geometry.skinning import blend_transforms, joint_transforms, pose_feature
from toonifygb.head import JAW, NECK, ROOT
from toonifygb.structures import Camera, GaussianParams, HeadMotion, Splats, TensorRecord

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

POSE_DRIVERS = ("jaw_open", "head_pitch", "head_yaw", "head_roll", "head_x", "head_y", "head_z")
"""Quantities of the pose that drive blendshapes of their own: skin folds and light change with them."""


@dataclass(frozen=True)
class PoseDrivers(TensorRecord):
    """How the pose becomes blendshape coefficients: (quantity - centre) / scale, kept within the trained range.

    Keeping the range makes a pose that training never saw look like the nearest one it saw.
    """

    centre: Float[Tensor, " d"]
    """Mean over the training frames: rad for jaw_open, pitch, yaw, roll; m for x, y, z."""
    scale: Float[Tensor, " d"]
    """Standard deviation over the training frames, same units."""
    lower: Float[Tensor, " d"]
    """Least coefficient seen in training."""
    upper: Float[Tensor, " d"]
    """Greatest coefficient seen in training."""

    def coefficients(self, motion: HeadMotion) -> Float[Tensor, "*b d"]:
        """Coefficients of the pose-driven blendshapes, in the order of ``POSE_DRIVERS``."""
        return ((pose_quantities(motion) - self.centre) / self.scale).clamp(self.lower, self.upper)


def pose_quantities(motion: HeadMotion) -> Float[Tensor, "*b d"]:
    """The pose quantities of ``POSE_DRIVERS``: jaw opening, head rotation vector (x, y, z), translation."""
    head = matrix_to_axis_angle(head_rotation(motion))
    return torch.cat([motion.joints[..., JAW, :1], head, motion.translation], dim=-1)


def head_rotation(motion: HeadMotion) -> Float[Tensor, "*b 3 3"]:
    """Head to world: the root's turn, then the neck's."""
    turns = axis_angle_to_matrix(motion.joints[..., : NECK + 1, :])
    return turns[..., ROOT, :, :] @ turns[..., NECK, :, :]


@dataclass(frozen=True)
class Avatar(TensorRecord):
    """A trained head: self-contained, drivable by any ``HeadMotion`` of its head model."""

    neutral: GaussianParams
    """B0, face set, rest pose, m."""
    deltas: GaussianParams
    """ΔBk; leading axis = ``blendshape_names``, or the bases of ``mixer``, then the pose drivers."""
    blendshape_names: tuple[str, ...]
    """Expression units of the head model, then eyelids (where it has them), then ``POSE_DRIVERS``."""
    n_expressions: int
    """How many of them are the head model's expression units."""
    n_eyelids: int
    """2 where eyelids are blendshapes of their own, else 0."""
    drivers: PoseDrivers | None
    """Pose-driven blendshapes; ``None`` for an avatar without them."""
    skin_weights: Float[Tensor, "n 5"]
    """Rows sum to 1."""
    pose_basis: Float[Tensor, "p n 3"]
    """Pose correctives of the face set, m per unit of pose feature."""
    pose_features: tuple[int, ...]
    """Which of the 36 pose features (row-major R - I of the non-root joints) each corrective follows."""
    rest_joints: Float[Tensor, "5 3"]
    """Joints of this subject with zero expression, m."""
    joint_expression_basis: Float[Tensor, "5 3 e"]
    """Displacement of the joints per expression unit, m."""
    parents: tuple[int, ...]
    mouth_upper: GaussianParams
    """Upper teeth and gums, moving with the head; no blendshapes."""
    mouth_lower: GaussianParams
    """Lower teeth and tongue, moving with the jaw; no blendshapes."""
    mouth_upper_weights: Float[Tensor, " 5"]
    mouth_lower_weights: Float[Tensor, " 5"]
    motion_lower: HeadMotion
    """Least value of every motion parameter in training; the safe range for driving."""
    motion_upper: HeadMotion
    """Greatest value of every motion parameter in training."""
    motion_mean: HeadMotion
    """Mean motion in training: the subject's own neutral and usual place."""
    camera: Camera
    """Camera of the training crops."""
    full_camera: Camera
    """Camera of the whole clip."""
    head_model: str
    shape: Float[Tensor, " s"]
    """β, identity coefficients of the head model."""
    mixer: Mixer | None = None
    """Weights of few bases from all blendshapes' coefficients; ``None`` where every blendshape has its ΔBk."""
    meta: dict[str, Any] = field(default_factory=dict)
    """JSON-able facts: versions, configuration, scores."""

    @property
    def n(self) -> int:
        """Number of Gaussians, mouth included."""
        return self.neutral.n + self.mouth_upper.n + self.mouth_lower.n

    @property
    def sh_degree(self) -> int:
        """Degree of the view-dependent colour."""
        return round(self.neutral.sh.shape[-2] ** 0.5) - 1

    @property
    def n_bases(self) -> int:
        """Rows of ``deltas`` before those of the pose drivers."""
        return self.n_expressions + self.n_eyelids if self.mixer is None else self.mixer.n_bases

    def coefficients(self, motion: HeadMotion) -> Float[Tensor, "*b r"]:
        """What the rows of ``deltas`` are multiplied with: ψ, or the bases' weights and the pose drivers' ψ."""
        psi = self.signals(motion)
        if self.mixer is None:
            return psi
        return torch.cat([self.mixer(psi), psi[..., self.n_expressions + self.n_eyelids :]], dim=-1)

    def signals(self, motion: HeadMotion) -> Float[Tensor, "*b k"]:
        """ψ, one coefficient per name in ``blendshape_names``: expression, eyelids, pose drivers."""
        parts = [motion.expression[..., : self.n_expressions], motion.eyelids[..., : self.n_eyelids]]
        if self.drivers is not None:
            parts.append(self.drivers.coefficients(motion))
        return torch.cat(parts, dim=-1)

    def transforms(self, motion: HeadMotion) -> Float[Tensor, "*b 5 4 4"]:
        """Joint transforms from the rest pose into the world, the clip's translation included."""
        shift = torch.einsum("jce,...e->...jc", self.joint_expression_basis, motion.expression)
        rotations = axis_angle_to_matrix(motion.joints)
        transforms = joint_transforms(rotations, self.rest_joints + shift, self.parents).clone()
        transforms[..., :3, 3] += motion.translation[..., None, :]
        return transforms

    def pose_feature(self, motion: HeadMotion) -> Float[Tensor, "*b p"]:
        """The pose features that this avatar's correctives follow."""
        return pose_feature(axis_angle_to_matrix(motion.joints))[..., list(self.pose_features)]

    def pose(self, motion: HeadMotion) -> Splats:
        """Splats in the world for one frame's motion: face, upper mouth, lower mouth.

        This is the definition; ``toonifygb.avatar.Poser`` computes the same faster.
        """
        raw = blend_parameters(self.neutral, self.deltas, self.coefficients(motion))
        transforms = self.transforms(motion)
        face = activate(raw)
        face = Splats(
            means=face.means + pose_offsets(self.pose_feature(motion), self.pose_basis),
            quats=face.quats,
            scales=face.scales,
            opacities=face.opacities,
            sh=face.sh,
        )
        return concatenate(
            [
                skin_splats(face, blend_transforms(self.skin_weights, transforms)),
                _skin_rigid(self.mouth_upper, self.mouth_upper_weights, transforms),
                _skin_rigid(self.mouth_lower, self.mouth_lower_weights, transforms),
            ]
        )


def _skin_rigid(params: GaussianParams, weights: Float[Tensor, " 5"], transforms: Float[Tensor, "5 4 4"]) -> Splats:
    """A set without blendshapes, all of it bound to the joints by one row of weights."""
    return skin_splats(activate(params), blend_transforms(weights.expand(params.n, -1), transforms))
