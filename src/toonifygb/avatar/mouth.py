"""The inside of the mouth: where its Gaussians start and the volume that holds them.

A head model with teeth, gums and tongue gives their surfaces; one without (FLAME) gets two curved strips behind the
lips, as in 3D Gaussian Blendshapes. Upper teeth move with the skull, lower teeth and tongue with the jaw.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.meshes import barycentric, sample_surface
from toonifygb.head import PARTS
from toonifygb.structures import TensorRecord

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.head import HeadModel

UPPER_PARTS = ("teeth_upper", "gums_upper")
LOWER_PARTS = ("teeth_lower", "gums_lower", "tongue")
_VOLUME_MARGIN = 0.004
"""Room around the first positions, m."""
_ARCH_INSET, _ARCH_DEPTH, _TOOTH_HEIGHT = 0.008, 0.020, 0.011
"""A dental arch behind the lips: how far behind, how deep from incisors to molars, how tall, m."""
_ARCH_COLUMNS = 9


@dataclass(frozen=True)
class MouthVolume(TensorRecord):
    """An upright solid cylinder (axis y) in the rest pose that mouth Gaussians should stay in."""

    centre: Float[Tensor, " 3"]
    radius: float
    half_height: float

    @classmethod
    def around(cls, points: Float[Tensor, "n 3"]) -> MouthVolume:
        """The cylinder that holds the given points with a little room."""
        centre = 0.5 * (points.amin(0) + points.amax(0))
        apart = points - centre
        radius = float(apart[:, [0, 2]].norm(dim=-1).amax()) + _VOLUME_MARGIN
        return cls(centre, radius, float(apart[:, 1].abs().amax()) + _VOLUME_MARGIN)

    def distance(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Signed distance to the cylinder, m; negative inside."""
        radial, axial = self._excess(points)
        outside = (radial.clamp_min(0).square() + axial.clamp_min(0).square()).sqrt()
        return outside + radial.maximum(axial).clamp_max(0)

    def penalty(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Squared distance outside the cylinder, m²; zero and without gradient inside."""
        radial, axial = self._excess(points)
        return radial.clamp_min(0).square() + axial.clamp_min(0).square()

    def penalty_with_gradient(
        self, points: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
        """Penalty of each point, m², and its derivative by the point's position, m."""
        x, y, z = (points - self.centre).T.contiguous()
        distance = (x * x + z * z).clamp_min(1e-24).sqrt()
        radial, axial = (distance - self.radius).clamp_min(0), (y.abs() - self.half_height).clamp_min(0)
        outward = 2 * radial / distance
        return radial * radial + axial * axial, torch.stack([outward * x, 2 * axial * y.sign(), outward * z], -1)

    def _excess(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        apart = points - self.centre
        # The floor keeps the root's gradient finite on the axis, where the penalty is zero anyway.
        radial = (apart[:, 0].square() + apart[:, 2].square()).clamp_min(1e-24).sqrt() - self.radius
        return radial, apart[:, 1].abs() - self.half_height


def mouth_points(
    head: HeadModel, rest: Float[Tensor, "v 3"], n: int, seed: int
) -> tuple[Float[Tensor, "u 3"], Float[Tensor, "w 3"]]:
    """First positions of the upper and the lower set, m, rest pose; ``n`` together, split evenly."""
    n_upper = n // 2
    meshes = [_part_mesh(head, rest, parts) for parts in (UPPER_PARTS, LOWER_PARTS)]
    if any(len(faces) == 0 for _, faces in meshes):
        meshes = _arches(head, rest)
    points = []
    for (vertices, faces), count in zip(meshes, (n_upper, n - n_upper), strict=True):
        face_ids, weights = sample_surface(vertices, faces, count, seed)
        points.append(barycentric(vertices, faces, face_ids, weights))
    return points[0], points[1]


def _part_mesh(head: HeadModel, rest: Float[Tensor, "v 3"], parts: tuple[str, ...]) -> tuple[Tensor, Tensor]:
    wanted = torch.tensor([PARTS.index(name) for name in parts])
    return rest, head.faces[torch.isin(head.part[head.faces], wanted).all(-1)]


def _arches(head: HeadModel, rest: Float[Tensor, "v 3"]) -> list[tuple[Tensor, Tensor]]:
    """Two strips bent like dental arches, one above and one below the line between the lips."""
    lips = rest[head.regions["lips"] > 0.5]
    middle = 0.5 * (lips.amin(0) + lips.amax(0))
    half_width = 0.45 * float(lips[:, 0].amax() - lips[:, 0].amin())
    angle = torch.linspace(-torch.pi / 2, torch.pi / 2, _ARCH_COLUMNS, dtype=rest.dtype)
    front = float(lips[:, 2].amax()) - _ARCH_INSET
    column = torch.stack(
        [
            middle[0] + half_width * angle.sin(),
            torch.full_like(angle, float(middle[1])),
            front - _ARCH_DEPTH * (1 - angle.cos()),
        ],
        dim=-1,
    )
    up = torch.tensor([0.0, _TOOTH_HEIGHT, 0.0], dtype=rest.dtype)
    first = torch.arange(_ARCH_COLUMNS - 1)
    edge, across = first + 1, first + _ARCH_COLUMNS
    faces = torch.cat(
        [torch.stack([first, edge, across], -1), torch.stack([edge, edge + _ARCH_COLUMNS, across], -1)]
    )
    return [(torch.cat([column, column + up]), faces), (torch.cat([column - up, column]), faces)]
