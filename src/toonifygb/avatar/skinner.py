"""Fast skinning of a fixed set of Gaussians: forward, and its gradient by hand.

``toonifygb.avatar.skinning`` is the definition. Here everything that does not depend on the frame is prepared
once: most Gaussians hang on a single joint, whose rotation they take as it is; only the others need the rotation
factor of their blended map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.rotations import matrix_to_quat, quat_multiply
from toonifygb.structures import GaussianParams, Splats

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

_RIGID = 1 - 1e-6
"""Weight from which a Gaussian counts as bound to one joint alone."""
_POLAR_STEPS = 3


@dataclass(frozen=True)
class Posed:
    """Splats of one frame with what the backward pass needs again."""

    splats: Splats
    linear: Float[Tensor, "n 3 3"]
    """Linear part of each Gaussian's map from rest to pose."""
    turn: Float[Tensor, "n 4"]
    """Unit quaternion of that map's rotation factor."""
    unit: Float[Tensor, "n 4"]
    """Normalised raw quaternions."""
    length: Float[Tensor, "n 1"]
    """Length of the raw quaternions."""


class Skinner:
    """Skins Gaussians whose binding never changes.

    Args:
        weights: joint weights, rows sum to 1.
        pose_basis: correctives of the first Gaussians (the face set), m per unit of pose feature.
    """

    def __init__(self, weights: Float[Tensor, "n 5"], pose_basis: Float[Tensor, "p f 3"]) -> None:
        self._weights = weights
        self._pose_basis = pose_basis.flatten(1)
        self._n_face = pose_basis.shape[1]
        strongest = weights.max(dim=-1)
        self._joint = strongest.indices
        self._mixed = (strongest.values < _RIGID).nonzero()[:, 0]
        self._mixed_weights = weights[self._mixed].T.contiguous()

    def __call__(
        self, raw: GaussianParams, transforms: Float[Tensor, "5 4 4"], pose_feature: Float[Tensor, " p"]
    ) -> Posed:
        """Blended raw parameters of one frame to world-space splats, without autograd."""
        rest = raw.means.clone()
        rest[: self._n_face].view(-1).add_(pose_feature @ self._pose_basis)
        blended = (self._weights @ transforms[:, :3].reshape(-1, 12)).view(-1, 3, 4)
        linear = blended[:, :, :3]
        rotation, turn = self._turns(transforms)
        length = torch.linalg.vector_norm(raw.quats, dim=-1, keepdim=True).clamp_min(1e-12)
        unit = raw.quats / length
        splats = Splats(
            means=torch.baddbmm(blended[:, :, 3:], linear, rest[..., None])[..., 0],
            quats=quat_multiply(turn, unit),
            scales=raw.log_scales.exp(),
            opacities=raw.opacity_logits.sigmoid(),
            sh=raw.sh,
            sh_frames=rotation,
        )
        return Posed(splats, linear, turn, unit, length)

    def _turns(self, transforms: Float[Tensor, "5 4 4"]) -> tuple[Tensor, Tensor]:
        """Rotation matrix and quaternion of every Gaussian."""
        joints = transforms[:, :3, :3]
        rotation, turn = joints[self._joint], matrix_to_quat(joints)[self._joint]
        if len(self._mixed):
            mixed = polar_columns(joints.reshape(5, 9).T @ self._mixed_weights).T.reshape(-1, 3, 3)
            rotation[self._mixed] = mixed
            turn[self._mixed] = matrix_to_quat(mixed)
        return rotation, turn


def polar_columns(matrices: Float[Tensor, "9 n"]) -> Float[Tensor, "9 n"]:
    """Rotation factor of many matrices, one per column: ``geometry.rotations.polar_factor`` for this layout.

    Each entry is a contiguous row, so the whole iteration runs in cache: ten times faster for some 10 000 matrices.
    """
    rotation = matrices
    for _ in range(_POLAR_STEPS):
        a, b, c, d, e, f, g, h, i = rotation.unbind(0)
        cofactors = torch.stack(
            [
                e * i - f * h,
                f * g - d * i,
                d * h - e * g,
                c * h - b * i,
                a * i - c * g,
                b * g - a * h,
                b * f - c * e,
                c * d - a * f,
                a * e - b * d,
            ]
        )
        determinant = (rotation[:3] * cofactors[:3]).sum(0)
        rotation = 0.5 * (rotation + cofactors / determinant)
    return rotation


def skinning_gradient(posed: Posed, gradient: Splats) -> GaussianParams:
    """Gradient for the blended raw parameters from the gradient for the splats.

    The rotations come from the pose alone, so multiplying a quaternion by one is a constant orthogonal map.
    """
    splats = posed.splats
    back = posed.turn * posed.turn.new_tensor([1.0, -1.0, -1.0, -1.0])
    v_unit = quat_multiply(back, gradient.quats)
    along = (posed.unit * v_unit).sum(-1, keepdim=True)
    return GaussianParams(
        means=torch.bmm(posed.linear.mT, gradient.means[..., None])[..., 0],
        quats=(v_unit - along * posed.unit) / posed.length,
        log_scales=gradient.scales * splats.scales,
        opacity_logits=gradient.opacities * splats.opacities * (1 - splats.opacities),
        sh=gradient.sh,
    )
