"""Triangle meshes: normals, areas, points on the surface, and how each face deforms.

Vertices are metres, faces counter-clockwise seen from outside.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.rotations import inverse_transpose
from toonifygb.geometry.sampling import sample_surface

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

__all__ = [
    "barycentric",
    "deformation_gradient",
    "face_areas",
    "face_normals",
    "sample_surface",
    "vertex_normals",
]


def face_normals(vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "*b f 3"]:
    """Unit outward normal of each face; zero for a face without area."""
    return torch.nn.functional.normalize(_double_area_vectors(vertices, faces), dim=-1)


def face_areas(vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "*b f"]:
    """Area of each face, m²."""
    return 0.5 * torch.linalg.vector_norm(_double_area_vectors(vertices, faces), dim=-1)


def vertex_normals(vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "*b v 3"]:
    """Unit normal of each vertex: mean of its faces' normals weighted by area; zero for a vertex without faces."""
    weighted = _double_area_vectors(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(-2, faces[:, corner], weighted)
    return torch.nn.functional.normalize(total, dim=-1)


def barycentric(
    values: Float[Tensor, "*b v c"],
    faces: Int[Tensor, "f 3"],
    face_ids: Int[Tensor, " n"],
    weights: Float[Tensor, "n 3"],
) -> Float[Tensor, "*b n c"]:
    """Vertex values mixed at points of the surface.

    Args:
        values: one row per vertex: positions, colours, weights, anything linear.
        faces: vertex ids of the corners.
        face_ids: face of each point.
        weights: barycentric coordinates of each point, rows sum to 1.
    """
    corners = faces[face_ids]
    result = values[..., corners[:, 0], :] * weights[:, :1]
    for corner in (1, 2):
        result = result + values[..., corners[:, corner], :] * weights[:, corner : corner + 1]
    return result


def deformation_gradient(
    rest: Float[Tensor, "v 3"], deformed: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]
) -> Float[Tensor, "*b f 3 3"]:
    """Linear map Q of each face from rest to deformed, its normal direction scaling with √area.

    The face's frame is [e₁ e₂ p₄ - p₁] with p₄ = centroid + n/√|n|, n = e₁ × e₂ (Sumner and Popović 2004);
    Q = S S₀⁻¹. Faces without area in the rest pose have no frame and give non-finite values.
    """
    # S S₀⁻¹ = S (S₀⁻ᵀ)ᵀ
    return _face_frames(deformed, faces) @ inverse_transpose(_face_frames(rest, faces)).mT


def _face_frames(vertices: Tensor, faces: Tensor) -> Tensor:
    edge_1, edge_2 = _edges(vertices, faces)
    normal = torch.linalg.cross(edge_1, edge_2)
    height = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True).sqrt()
    return torch.stack((edge_1, edge_2, (edge_1 + edge_2) / 3 + height), -1)


def _double_area_vectors(vertices: Tensor, faces: Tensor) -> Tensor:
    """Outward normal of each face with twice its area as length."""
    edge_1, edge_2 = _edges(vertices, faces)
    return torch.linalg.cross(edge_1, edge_2)


def _edges(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    first, second, third = vertices[..., faces, :].unbind(-2)
    return second - first, third - first
