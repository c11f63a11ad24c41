"""The head model: FLAME's function of shape, expression and pose, for any rig with its five joints.

    v = skin(template + shape_basis·β + expression_basis·ψ + eyelid_basis·ε + pose_basis·(R(Θ) - I), weights, A(Θ))

Head frame: metres, y up, z out of the face, +x towards the subject's left. Joints are root, neck, jaw, left eye,
right eye; the neck joint carries the skull.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import linear

from toonifygb.geometry import meshes, rotations, skinning
from toonifygb.structures import TensorRecord

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, Int

    from toonifygb.structures import HeadMotion

JOINTS = ("root", "neck", "jaw", "eye_left", "eye_right")
ROOT, NECK, JAW, EYE_LEFT, EYE_RIGHT = range(5)
"""Places in ``JOINTS``."""
PARENTS = (-1, 0, 1, 1, 1)
"""Parent of each of ``JOINTS``."""
PARTS = (
    "skin",
    "tongue",
    "teeth_upper",
    "teeth_lower",
    "eye_left",
    "eye_right",
    "gums_upper",
    "gums_lower",
)
"""Names of the values of ``HeadModel.part``."""


@dataclass(frozen=True)
class HeadModel(TensorRecord):
    """A linear head: template, bases and skinning weights of its v vertices.

    A model may also stand for loose surface points (``at``, ``subset``): then it has few or no faces and no
    landmarks, and everything else works alike.
    """

    name: str
    template: Float[Tensor, "v 3"]
    """Vertices of the mean identity, neutral and unposed, m."""
    faces: Int[Tensor, "f 3"]
    """Vertex ids, counter-clockwise seen from outside."""
    shape_basis: Float[Tensor, "v 3 s"]
    """m per standard deviation of each identity coefficient."""
    expression_basis: Float[Tensor, "v 3 e"]
    """m per unit of each expression coefficient."""
    expression_names: tuple[str, ...]
    expression_sigma: Float[Tensor, " e"]
    """Usual size of each expression coefficient, for priors."""
    expression_lower: Float[Tensor, " e"]
    expression_upper: Float[Tensor, " e"]
    eyelid_basis: Float[Tensor, "v 3 2"] | None
    """m per unit closure of the left and right lid; at 1 the lids just meet."""
    pose_basis: Float[Tensor, "p v 3"]
    """Pose correctives, m per unit of the chosen pose features."""
    pose_features: Int[Tensor, " p"]
    """Which of FLAME's 36 features (row-major R - I of neck, jaw, eyes) drive ``pose_basis``."""
    rest_joints: Float[Tensor, "5 3"]
    """Joint positions of the mean identity, m."""
    joint_shape_basis: Float[Tensor, "5 3 s"]
    joint_expression_basis: Float[Tensor, "5 3 e"]
    skin_weights: Float[Tensor, "v 5"]
    """Share of each joint in a vertex's motion; rows sum to 1."""
    part: Int[Tensor, " v"]
    """Index into ``PARTS``."""
    regions: dict[str, Float[Tensor, " v"]]
    """Soft vertex masks 0..1 by name: face, lips, eyelids, ears, scalp, neck, …"""
    landmark_faces: Int[Tensor, " l"]
    """Face that carries each of MediaPipe's 478 landmarks; l = 0 for loose points."""
    landmark_bary: Float[Tensor, "l 3"]
    landmark_offset: Float[Tensor, "l 3"]
    """Where the detector sees each landmark beside its surface point, head axes, m."""
    landmark_sigma: Float[Tensor, " l"]
    """How far the detector wanders on the surface at each landmark, median, m."""
    landmark_mirror: Int[Tensor, " l"]
    """Landmark on the other side of the face; a midline landmark is its own mirror."""
    uv: Float[Tensor, "f 3 2"] | None = None
    """Texture coordinates of each face's corners, 0..1, v up; NaN where a part has none."""
    parents: tuple[int, ...] = PARENTS
    n_blendshapes: int | None = None
    """How many of the expression coefficients, from the first on, Gaussians get blendshapes for where no setting
    says so; all when ``None``."""

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return self.template.shape[0]

    @property
    def n_shape(self) -> int:
        """Number of identity coefficients."""
        return self.shape_basis.shape[-1]

    @property
    def n_expression(self) -> int:
        """Number of expression coefficients."""
        return self.expression_basis.shape[-1]

    def map(self, function: Callable[[Tensor], Tensor]) -> HeadModel:
        """Model with ``function`` applied to every tensor, the region masks included."""
        regions = {name: function(mask) for name, mask in self.regions.items()}
        return replace(super().map(function), regions=regions)

    def to(self, *args: torch.device | torch.dtype | str) -> HeadModel:
        """Model on a device or in a precision; whole numbers keep their type."""
        devices = [arg for arg in args if not isinstance(arg, torch.dtype)]
        return self.map(lambda tensor: tensor.to(*(args if tensor.is_floating_point() else devices)))  # type: ignore[arg-type]

    def joints(
        self, shape: Float[Tensor, "*b s"], expression: Float[Tensor, "*b e"] | None = None
    ) -> Float[Tensor, "*b 5 3"]:
        """Rest positions of the joints of one identity, m."""
        joints = self.rest_joints + _mix(self.joint_shape_basis, shape)
        if expression is not None:
            joints = joints + _mix(self.joint_expression_basis, expression)
        return joints

    def rest(
        self,
        shape: Float[Tensor, "*b s"],
        expression: Float[Tensor, "*b e"] | None = None,
        eyelids: Float[Tensor, "*b 2"] | None = None,
        pose_feature: Float[Tensor, "*b 36"] | None = None,
    ) -> Float[Tensor, "*b v 3"]:
        """Vertices before skinning, m; what is left out is neutral.

        Args:
            shape: β, standard deviations.
            expression: ψ.
            eyelids: closure of left and right lid; ignored by a head without eyelid basis.
            pose_feature: ``geometry.skinning.pose_feature`` of the joints' rotations.
        """
        vertices = self.template + _mix(self.shape_basis, shape)
        if expression is not None:
            vertices = vertices + _mix(self.expression_basis, expression)
        if eyelids is not None and self.eyelid_basis is not None:
            vertices = vertices + _mix(self.eyelid_basis, eyelids)
        if pose_feature is not None:
            chosen = pose_feature[..., self.pose_features]
            vertices = vertices + torch.einsum("...p,pvc->...vc", chosen, self.pose_basis)
        return vertices

    def forward(
        self, shape: Float[Tensor, "*b s"], motion: HeadMotion
    ) -> tuple[Float[Tensor, "*b v 3"], Float[Tensor, "*b 5 4 4"]]:
        """Vertices in the world and the joint transforms that took them from rest to pose.

        The root turns about its own rest position; ``motion.translation`` is added last and is not part of the
        returned transforms: world = A·rest + translation, as in FLAME.
        """
        turns = rotations.axis_angle_to_matrix(motion.joints)
        rest = self.rest(shape, motion.expression, motion.eyelids, skinning.pose_feature(turns))
        joints = self.joints(shape, motion.expression)
        transforms = skinning.joint_transforms(turns, joints, self.parents)
        posed = skinning.skin(rest, self.skin_weights, transforms)
        return posed + motion.translation[..., None, :], transforms

    def at(self, face_ids: Int[Tensor, " n"], bary: Float[Tensor, "n 3"]) -> HeadModel:
        """Model of n points of the surface: every per-vertex quantity mixed barycentrically.

        Rest positions are exactly the mix of the mesh's. Posed ones differ from it where the skinning weights
        vary within a face, by the product of two small differences (hundredths of a millimetre).

        Args:
            face_ids: face of each point.
            bary: barycentric coordinates, rows sum to 1.
        """
        corners = self.faces[face_ids]

        def mix(values: Tensor) -> Tensor:
            flat = values.flatten(1) if values.ndim > 1 else values[:, None]
            mixed = meshes.barycentric(flat, self.faces, face_ids, bary.to(flat))
            return mixed.reshape(face_ids.shape[0], *values.shape[1:])

        # A face lies within one part, so any corner tells it.
        return self._resampled(mix, self.part[corners[:, 0]], self.faces[:0])

    def subset(self, vertex_ids: Int[Tensor, " n"]) -> HeadModel:
        """Model of some vertices, in the given order, with the faces that keep all their corners."""
        new_id = torch.full((self.n_vertices,), -1, dtype=torch.int64, device=self.faces.device)
        new_id[vertex_ids] = torch.arange(vertex_ids.shape[0], device=new_id.device)
        faces = new_id[self.faces]
        kept = (faces >= 0).all(-1)
        model = self._resampled(lambda values: values[vertex_ids], self.part[vertex_ids], faces[kept])
        return model if self.uv is None else replace(model, uv=self.uv[kept])

    def landmarks(self) -> HeadModel:
        """Model of the landmark points alone, in MediaPipe's order, where the detector sees them."""
        points = self.at(self.landmark_faces, self.landmark_bary)
        return replace(points, template=points.template + self.landmark_offset)

    def _resampled(
        self, pick: Callable[[Tensor], Tensor], part: Int[Tensor, " n"], faces: Int[Tensor, "f 3"]
    ) -> HeadModel:
        """Model whose per-vertex quantities are ``pick`` (vertex axis first) of this one's."""
        empty = {
            field.name: getattr(self, field.name)[:0]
            for field in fields(self)
            if field.name.startswith("landmark_")
        }
        return replace(
            self,
            template=pick(self.template),
            faces=faces,
            shape_basis=pick(self.shape_basis),
            expression_basis=pick(self.expression_basis),
            eyelid_basis=None if self.eyelid_basis is None else pick(self.eyelid_basis),
            pose_basis=pick(self.pose_basis.transpose(0, 1)).transpose(0, 1),
            skin_weights=pick(self.skin_weights),
            part=part,
            regions={name: pick(mask) for name, mask in self.regions.items()},
            uv=None,
            **empty,
        )


def _mix(basis: Float[Tensor, "n 3 k"], coefficients: Float[Tensor, "*b k"]) -> Float[Tensor, "*b n 3"]:
    """Σk basis·coefficient, as one matrix product."""
    return linear(coefficients, basis.flatten(0, 1)).unflatten(-1, basis.shape[:2])
