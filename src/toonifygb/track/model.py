"""The head model seen by the tracker: 478 surface points, their motion, and its exact derivatives.

A head pose of the tracker is a world rotation R and position p of the head about a pivot c inside the face, and a
vector of everything else. With the rest point v (identity, expression, lids, pose correctives) and the rotations
R_j of jaw and eyes about their rest joints J_j, a landmark sits at

    X = R (v + Σ_j w_j (R_j − I)(v − J_j) − c) + p,

which is FLAME's skinning with root and neck merged into one rotation. Jaw and eyes turn by two angles each,
R_j = R_y(b) R_x(a): opening and sideways for the jaw, pitch and yaw for an eye.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from toonifygb.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from toonifygb.head import EYE_LEFT, EYE_RIGHT, JAW, ROOT
from toonifygb.structures import HeadMotion, TensorRecord

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from toonifygb.head import HeadModel

HINGES = (JAW, EYE_LEFT, EYE_RIGHT)
N_ANGLES = 2 * len(HINGES)
N_EYELIDS = 2

# Columns of PoseState.values; an update has the rotation's three in front of them.
POSITION = slice(0, 3)
ANGLES = slice(3, 3 + N_ANGLES)
EYELIDS = slice(ANGLES.stop, ANGLES.stop + N_EYELIDS)
EXPRESSION = slice(EYELIDS.stop, None)
SURFACE = slice(EYELIDS.start, None)
"""Eyelids and expression together: everything that moves the rest points linearly."""

NORMAL_RADIUS = 0.02
"""Size of the patch that defines which way a landmark faces, m: larger than lids and lips, whose own normals
would hide them when they matter most (a closing eye), smaller than the curvature of the face."""


@dataclass(frozen=True)
class PoseState(TensorRecord):
    """Poses of the head in n frames, as the solver moves them."""

    rotation: Float[Tensor, "n 3 3"]
    """Head to world."""
    values: Float[Tensor, "n q"]
    """Position of the pivot (m), angles of jaw, left eye, right eye (rad), left and right lid, expression."""

    @property
    def n(self) -> int:
        """Number of frames."""
        return self.values.shape[0]

    def __getitem__(self, index: slice | Int[Tensor, " i"]) -> PoseState:
        return self.map(lambda tensor: tensor[index])

    def moved(self, update: Float[Tensor, "n p"]) -> PoseState:
        """State after a step; the rotation's part is a world-axes rotation vector applied on the left."""
        turn = axis_angle_to_matrix(update[:, :3])
        return PoseState(turn @ self.rotation, self.values + update[:, 3:])


@dataclass(frozen=True)
class Posed(TensorRecord):
    """Landmark positions of n frames with what their derivatives need."""

    points: Float[Tensor, "n l 3"]
    """World, m."""
    rest: Float[Tensor, "n l 3"]
    """Before skinning, head frame, m."""
    joints: Float[Tensor, "n 3 3"]
    """Rest positions of the hinges, m."""
    hinges: Float[Tensor, "n 3 3 3"]
    """Rotations of the hinges minus identity."""
    linear: Float[Tensor, "n l 3 3"]
    """Linear part of the skinning, head frame to head frame."""

    def __getitem__(self, index: slice) -> Posed:
        return self.map(lambda tensor: tensor[index])


@dataclass(frozen=True)
class LandmarkModel(TensorRecord):
    """A head model reduced to its landmarks."""

    template: Float[Tensor, "l 3"]
    shape_basis: Float[Tensor, "l 3 s"]
    surface_basis: Float[Tensor, "l 3 m"]
    """Eyelids, then expression."""
    pose_basis: Float[Tensor, "k l 3"]
    pose_features: Int[Tensor, " k"]
    """Entries of the hinges' (R_j − I), flattened over (hinge, row, column), that drive ``pose_basis``."""
    skin_weights: Float[Tensor, "l 3"]
    """Shares of the hinges; the head itself has the rest."""
    joints: Float[Tensor, "3 3"]
    joint_shape_basis: Float[Tensor, "3 3 s"]
    joint_surface_basis: Float[Tensor, "3 3 m"]
    pivot: Float[Tensor, " 3"]
    root: Float[Tensor, " 3"]
    """Rest position of the root joint for the mean identity."""
    root_shape_basis: Float[Tensor, "3 s"]
    sigma: Float[Tensor, " l"]
    """Expected distance between a detected landmark and its surface point, m."""
    normals: Float[Tensor, "l 3"]

    @classmethod
    def from_head(cls, head: HeadModel, n_shape: int) -> LandmarkModel:
        """Landmark model with the first ``n_shape`` identity coefficients of ``head``."""
        points = head.landmarks()
        n_shape = min(n_shape, points.shape_basis.shape[-1])
        lids = points.eyelid_basis
        if lids is None:  # FLAME without the eyelid add-on: the lids' parameters stay at their prior, open
            lids = points.template.new_zeros((*points.template.shape, N_EYELIDS))
        hinges = list(HINGES)
        joint_expression = points.joint_expression_basis[hinges]
        of_neck = 9  # FLAME's 36 features are (R − I) of neck, jaw and eyes; the tracker's neck never turns
        hinged = points.pose_features >= of_neck
        return cls(
            template=points.template,
            shape_basis=points.shape_basis[..., :n_shape].contiguous(),
            surface_basis=torch.cat([lids, points.expression_basis], -1),
            pose_basis=points.pose_basis[hinged],
            pose_features=points.pose_features[hinged] - of_neck,
            skin_weights=points.skin_weights[:, hinges],
            joints=points.rest_joints[hinges],
            joint_shape_basis=points.joint_shape_basis[hinges][..., :n_shape],
            joint_surface_basis=torch.cat(
                [joint_expression.new_zeros((*joint_expression.shape[:-1], N_EYELIDS)), joint_expression], -1
            ),
            pivot=points.template.mean(0),
            root=points.rest_joints[ROOT],
            root_shape_basis=points.joint_shape_basis[ROOT][:, :n_shape],
            sigma=head.landmark_sigma,
            normals=patch_normals(points.template, NORMAL_RADIUS),
        )

    @property
    def n_shape(self) -> int:
        """Number of identity coefficients."""
        return self.shape_basis.shape[-1]

    @property
    def n_values(self) -> int:
        """Columns of ``PoseState.values``."""
        return SURFACE.start + self.surface_basis.shape[-1]

    def with_identity(self, shape: Float[Tensor, " s"]) -> LandmarkModel:
        """Model whose template is one person, with no identity coefficients left."""
        return replace(
            self,
            template=self.template + self.shape_basis @ shape,
            joints=self.joints + self.joint_shape_basis @ shape,
            root=self.root + self.root_shape_basis @ shape,
            shape_basis=self.shape_basis[..., :0],
            joint_shape_basis=self.joint_shape_basis[..., :0],
            root_shape_basis=self.root_shape_basis[..., :0],
        )

    def pose(self, shape: Float[Tensor, " s"], state: PoseState) -> Posed:
        """World positions of the landmarks."""
        surface = state.values[:, SURFACE]
        identity = torch.eye(3, dtype=surface.dtype, device=surface.device)
        hinges = hinge_rotations(state.values[:, ANGLES]) - identity
        features = hinges.flatten(1)[:, self.pose_features]
        rest = (
            self.template
            + self.shape_basis @ shape
            + torch.einsum("lcm,nm->nlc", self.surface_basis, surface)
            + torch.einsum("nk,klc->nlc", features, self.pose_basis)
        )
        joints = (
            self.joints
            + self.joint_shape_basis @ shape
            + torch.einsum("jcm,nm->njc", self.joint_surface_basis, surface)
        )
        turning = torch.einsum("lj,njab->nlab", self.skin_weights, hinges)
        shift = torch.einsum("lj,nja->nla", self.skin_weights, torch.einsum("njab,njb->nja", hinges, joints))
        local = rest + torch.einsum("nlab,nlb->nla", turning, rest) - shift
        points = (local - self.pivot) @ state.rotation.mT + state.values[:, None, POSITION]
        return Posed(points, rest, joints, hinges, identity + turning)

    def derivatives(
        self, posed: Posed, state: PoseState, image: Float[Tensor, "n l 2 3"]
    ) -> list[Float[Tensor, "n l 2 _"]]:
        """Derivatives of image positions by an update of the state, then by the identity, as blocks of columns.

        Args:
            posed: ``pose(shape, state)``.
            state: the poses.
            image: derivatives of the image position by the world position, px/m.
        """
        arm = posed.points - state.values[:, None, POSITION]
        turn = torch.linalg.cross(arm[:, :, None].expand_as(image), image, dim=-1)
        head = image @ state.rotation[:, None]
        rest = head @ posed.linear
        # How a hinge's rest position moves a landmark: X changes by w_j (I − R_j) dJ_j.
        joint = -torch.einsum("lj,nlab,njbc->nlajc", self.skin_weights, head, posed.hinges).flatten(-2)
        levers = torch.cat([rest, joint], -1)
        linear = torch.einsum("nlac,lcm->nlam", levers, self._lever_basis)
        return [turn, image, self._angle_derivatives(posed, state, head, rest), linear]

    @cached_property
    def _lever_basis(self) -> Float[Tensor, "l 12 m"]:
        """What surface and identity coefficients move: the landmark's rest point, then the hinges'."""
        points = torch.cat([self.surface_basis, self.shape_basis], -1)
        joints = torch.cat([self.joint_surface_basis, self.joint_shape_basis], -1).flatten(0, 1)
        return torch.cat([points, joints.expand(len(points), -1, -1)], 1)

    def _angle_derivatives(
        self, posed: Posed, state: PoseState, head: Float[Tensor, "n l 2 3"], rest: Float[Tensor, "n l 2 3"]
    ) -> Float[Tensor, "n l 2 6"]:
        """Derivatives of image positions by the angles of jaw and eyes: the hinge itself and its correctives."""
        slopes = hinge_slopes(state.values[:, ANGLES])
        arm = posed.rest[:, :, None] - posed.joints[:, None]
        moved = torch.einsum("lj,njkab,nljb->nljka", self.skin_weights, slopes, arm).flatten(2, 3)
        # A feature belongs to one hinge: its slope by that hinge's two angles, zero by the others'.
        n = state.n
        table = slopes.new_zeros((n, len(HINGES), 9, len(HINGES), 2))
        for hinge in range(len(HINGES)):
            table[:, hinge, :, hinge] = slopes[:, hinge].flatten(-2).mT
        features = table.reshape(n, len(HINGES) * 9, N_ANGLES)[:, self.pose_features]
        corrected = torch.einsum("nkt,klc->nltc", features, self.pose_basis)
        return head @ moved.mT + rest @ corrected.mT

    def to_motion(self, shape: Float[Tensor, " s"], state: PoseState) -> HeadMotion:
        """The house's motion record: rotation about the root joint, then translation."""
        root = self.root + self.root_shape_basis @ shape
        joints = state.values.new_zeros((state.n, 5, 3))
        joints[:, ROOT] = matrix_to_axis_angle(state.rotation)
        joints[:, list(HINGES)] = matrix_to_axis_angle(hinge_rotations(state.values[:, ANGLES]))
        translation = state.values[:, POSITION] + (root - self.pivot) @ state.rotation.mT - root
        return HeadMotion(
            expression=state.values[:, EXPRESSION].clone(),
            joints=joints,
            translation=translation,
            eyelids=state.values[:, EYELIDS].clone(),
        )


def hinge_rotations(angles: Float[Tensor, "n 6"]) -> Float[Tensor, "n 3 3 3"]:
    """R_y(b) R_x(a) of jaw, left eye and right eye."""
    about_x, about_y = _axis_rotations(angles)
    return about_y @ about_x


def hinge_slopes(angles: Float[Tensor, "n 6"]) -> Float[Tensor, "n 3 2 3 3"]:
    """Derivatives of ``hinge_rotations`` by a and by b."""
    about_x, about_y = _axis_rotations(angles)
    # d/da R_x(a) = [e_x]× R_x(a), and likewise for y.
    cross_x = angles.new_tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    cross_y = angles.new_tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    return torch.stack([about_y @ (cross_x @ about_x), cross_y @ (about_y @ about_x)], 2)


def _axis_rotations(angles: Float[Tensor, "n 6"]) -> tuple[Float[Tensor, "n 3 3 3"], Float[Tensor, "n 3 3 3"]]:
    a, b = angles.reshape(-1, len(HINGES), 2).unbind(-1)
    one, zero = torch.ones_like(a), torch.zeros_like(a)
    about_x = torch.stack([one, zero, zero, zero, a.cos(), -a.sin(), zero, a.sin(), a.cos()], -1)
    about_y = torch.stack([b.cos(), zero, b.sin(), zero, one, zero, -b.sin(), zero, b.cos()], -1)
    return about_x.unflatten(-1, (3, 3)), about_y.unflatten(-1, (3, 3))


def patch_normals(points: Float[Tensor, "l 3"], radius: float) -> Float[Tensor, "l 3"]:
    """Outward normal of the patch around each landmark: the direction in which its neighbours vary least.

    Args:
        points: landmarks of a neutral face, head frame, m.
        radius: standard deviation of the Gaussian that weighs the neighbours, m.
    """
    offsets = points[None] - points[:, None]
    weights = torch.exp(-offsets.square().sum(-1) / (2 * radius**2))
    centred = offsets - (weights[..., None] * offsets).sum(1, keepdim=True) / weights.sum(1)[:, None, None]
    covariance = torch.einsum("lk,lka,lkb->lab", weights, centred, centred)
    normals = torch.linalg.eigh(covariance.double()).eigenvectors[..., 0].to(points.dtype)
    # "Outward" is away from a point behind the face: the face's depth behind its centre.
    centre = points.mean(0) - points.new_tensor([0.0, 0.0, 1.0]) * (points[:, 2].amax() - points[:, 2].amin())
    return normals * torch.where((normals * (points - centre)).sum(-1, keepdim=True) < 0, -1.0, 1.0)
