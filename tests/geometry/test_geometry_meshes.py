"""Meshes and alignment: normals, areas, deformation, and motions recovered exactly."""

from __future__ import annotations

import math

import pytest
import torch

from toonifygb.geometry import align, meshes
from toonifygb.geometry.rotations import axis_angle_to_matrix, polar_factor


def grid_sphere(rings: int = 24, sectors: int = 48, radius: float = 0.1) -> tuple[torch.Tensor, torch.Tensor]:
    """A globe of quads split in two, with one vertex at each pole; outward orientation."""
    theta = torch.arange(1, rings, dtype=torch.float64) * math.pi / rings
    phi = torch.arange(sectors, dtype=torch.float64) * 2 * math.pi / sectors
    ring = torch.stack(
        (
            theta.sin()[:, None] * phi.cos(),
            theta.sin()[:, None] * phi.sin(),
            theta.cos()[:, None].expand(-1, sectors),
        ),
        -1,
    )
    poles = torch.tensor([[0.0, 0, 1], [0, 0, -1]], dtype=torch.float64)
    vertices = torch.cat((ring.reshape(-1, 3), poles)) * radius
    north, south = len(vertices) - 2, len(vertices) - 1
    faces = []
    for s in range(sectors):
        t = (s + 1) % sectors
        faces.append((north, s, t))
        for r in range(rings - 2):
            a, b, c, d = (r * sectors + s, r * sectors + t, (r + 1) * sectors + s, (r + 1) * sectors + t)
            faces += [(a, c, d), (a, d, b)]
        last = (rings - 2) * sectors
        faces.append((last + s, south, last + t))
    return vertices, torch.tensor(faces)


def test_normals_point_outwards_and_areas_sum_up():
    vertices, faces = grid_sphere()
    assert meshes.face_areas(vertices, faces).sum() == pytest.approx(4 * math.pi * 0.1**2, rel=0.01)
    normals = meshes.face_normals(vertices, faces)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(faces), dtype=torch.float64))
    centres = vertices[faces].mean(1)
    assert ((normals * centres).sum(-1) > 0).all()
    at_vertices = meshes.vertex_normals(vertices, faces)
    torch.testing.assert_close(at_vertices, vertices / 0.1, atol=0.03, rtol=0)


def test_vertex_normal_is_the_area_weighted_mean_of_its_faces():
    vertices, faces = torch.randn(6, 3, dtype=torch.float64), torch.tensor([[0, 1, 2], [0, 2, 3], [4, 3, 0]])
    normals, areas = meshes.face_normals(vertices, faces), meshes.face_areas(vertices, faces)
    for vertex in range(6):
        total = torch.zeros(3, dtype=torch.float64)
        for face, normal, area in zip(faces.tolist(), normals, areas, strict=True):
            if vertex in face:
                total = total + area * normal
        expected = total / total.norm() if total.norm() > 0 else total
        torch.testing.assert_close(meshes.vertex_normals(vertices, faces)[vertex], expected)


def test_batched_meshes_equal_single_ones():
    vertices, faces = grid_sphere(6, 8)
    many = torch.stack((vertices, vertices * 1.5 + 0.01 * torch.randn_like(vertices)))
    for function in (meshes.face_normals, meshes.face_areas, meshes.vertex_normals):
        torch.testing.assert_close(function(many, faces)[1], function(many[1], faces))


def test_barycentric_mixes_corners():
    values, faces = torch.randn(2, 5, 7, dtype=torch.float64), torch.tensor([[0, 1, 2], [2, 3, 4]])
    ids, weights = torch.tensor([1, 0, 1]), torch.tensor([[1.0, 0, 0], [0.2, 0.3, 0.5], [0, 0.5, 0.5]]).double()
    mixed = meshes.barycentric(values, faces, ids, weights)
    assert mixed.shape == (2, 3, 7)
    torch.testing.assert_close(mixed[:, 0], values[:, 2])
    torch.testing.assert_close(mixed[1, 1], 0.2 * values[1, 0] + 0.3 * values[1, 1] + 0.5 * values[1, 2])


def test_deformation_gradient_recovers_rotations_and_in_plane_stretch():
    vertices, faces = grid_sphere(8, 10)
    rotation = axis_angle_to_matrix(torch.tensor([0.4, -0.2, 0.3], dtype=torch.float64))
    moved = vertices @ rotation.T + 0.3
    torch.testing.assert_close(
        meshes.deformation_gradient(vertices, moved, faces), rotation.expand(len(faces), 3, 3)
    )
    # Twice as large: edges double, and so does √area, along which the normal is scaled.
    twice = meshes.deformation_gradient(vertices, 2 * moved, faces)
    torch.testing.assert_close(twice, 2 * rotation.expand(len(faces), 3, 3))
    torch.testing.assert_close(polar_factor(1.2 * rotation), rotation, atol=1e-6, rtol=0)


def test_deformation_gradient_maps_edges():
    vertices, faces = grid_sphere(6, 8)
    moved = vertices + 0.01 * torch.randn(3, *vertices.shape, dtype=torch.float64)
    gradient = meshes.deformation_gradient(vertices, moved, faces)
    assert gradient.shape == (3, len(faces), 3, 3)
    for corner in (1, 2):
        before = vertices[faces[:, corner]] - vertices[faces[:, 0]]
        after = moved[:, faces[:, corner]] - moved[:, faces[:, 0]]
        torch.testing.assert_close((gradient @ before[..., None]).squeeze(-1), after)


def test_kabsch_recovers_a_rigid_motion():
    a = torch.randn(2, 30, 3, dtype=torch.float64)
    rotation, shift = (
        axis_angle_to_matrix(torch.randn(2, 3, dtype=torch.float64)),
        torch.randn(2, 3, dtype=torch.float64),
    )
    found_rotation, found_shift = align.kabsch(a, a @ rotation.mT + shift[:, None])
    torch.testing.assert_close(found_rotation, rotation)
    torch.testing.assert_close(found_shift, shift)


def test_umeyama_recovers_a_similarity():
    a = torch.randn(30, 3, dtype=torch.float64)
    rotation, shift = axis_angle_to_matrix(torch.randn(3, dtype=torch.float64)), torch.randn(3, dtype=torch.float64)
    scale, found_rotation, found_shift = align.umeyama(a, 2.5 * a @ rotation.T + shift)
    assert scale == pytest.approx(2.5)
    torch.testing.assert_close(found_rotation, rotation)
    torch.testing.assert_close(found_shift, shift)


def test_alignment_never_mirrors():
    a = torch.randn(30, 3, dtype=torch.float64)
    mirrored = a * torch.tensor([-1.0, 1, 1], dtype=torch.float64)
    for rotation in (align.kabsch(a, mirrored)[0], align.umeyama(a, mirrored)[1]):
        assert torch.linalg.det(rotation) == pytest.approx(1.0)


def test_weights_decide_between_disagreeing_points():
    a = torch.randn(20, 3, dtype=torch.float64)
    rotation = axis_angle_to_matrix(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))
    b = a @ rotation.T
    b[10:] += torch.randn(10, 3, dtype=torch.float64)
    weights = torch.cat((torch.ones(10), torch.zeros(10))).double()
    torch.testing.assert_close(align.kabsch(a, b, weights)[0], rotation)
    torch.testing.assert_close(align.kabsch(a, b, weights)[0], align.kabsch(a[:10], b[:10])[0])


def test_alignment_is_a_minimum():
    a, b = torch.randn(2, 20, 3, dtype=torch.float64)
    weights = torch.rand(20, dtype=torch.float64)
    scale, rotation, shift = align.umeyama(a, b, weights)

    def cost(s: torch.Tensor, r: torch.Tensor, t: torch.Tensor) -> float:
        return float((weights * (s * a @ r.T + t - b).square().sum(-1)).sum())

    best = cost(scale, rotation, shift)
    for _ in range(20):
        nudge = axis_angle_to_matrix(0.02 * torch.randn(3, dtype=torch.float64))
        assert cost(scale * 1.01, rotation, shift) > best
        assert cost(scale, nudge @ rotation, shift) > best
        assert cost(scale, rotation, shift + 0.01 * torch.randn(3, dtype=torch.float64)) > best
