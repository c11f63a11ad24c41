"""Nearest points of meshes: against a dense search, and on the right side of thin things."""

from __future__ import annotations

import pytest
import torch
from make import icosphere

from toonifygb.geometry.closest import Surface, closest_on_triangle


def test_nearest_point_of_a_triangle_beats_a_dense_search() -> None:
    corners = torch.randn(200, 3, 3, dtype=torch.float64)
    points = 2 * torch.randn(200, 3, dtype=torch.float64)
    mix = closest_on_triangle(points, corners)
    assert (mix.sum(-1) - 1).abs().max() < 1e-12 and mix.min() >= -1e-12
    found = (torch.einsum("nc,ncx->nx", mix, corners) - points).norm(dim=-1)
    steps = torch.arange(41) / 40
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), -1).flatten(0, 1)
    grid = torch.cat([1 - grid.sum(-1, keepdim=True), grid], -1)[grid.sum(-1) <= 1].double()
    searched = (torch.einsum("kc,ncx->nkx", grid, corners) - points[:, None]).norm(dim=-1).amin(-1)
    size = (corners[:, 1:] - corners[:, :1]).norm(dim=-1).amax(-1)
    assert (found <= searched + 1e-12).all() and (searched - found <= 0.05 * size).all()


def test_triangles_without_area_are_edges() -> None:
    corners = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[1.0, 1, 1], [1, 1, 1], [1, 1, 1]]])
    points = torch.tensor([[1.5, 1, 0], [0.0, 0, 0]])
    found = torch.einsum("nc,ncx->nx", closest_on_triangle(points, corners), corners)
    assert torch.allclose(found, torch.tensor([[1.5, 0, 0], [1.0, 1, 1]]))


def test_points_around_a_ball_find_their_foot() -> None:
    vertices, faces = icosphere(3)
    directions = torch.nn.functional.normalize(torch.randn(300, 3), dim=-1)
    surface = Surface(vertices, faces, 0.01)
    face_ids, mix = surface.closest(1.3 * directions, directions)
    # Facets of an icosphere of 642 vertices are inclined to the ball by up to 5 degrees, over which 0.3 slides.
    assert (surface.at(face_ids, mix) - directions).norm(dim=-1).max() < 0.03


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_normals_tell_the_sides_of_a_sheet(side: float) -> None:
    """Two layers 1 apart, facing away from each other: a point goes to the one it faces like, though further."""
    x, y = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
    flat = torch.stack([x, y, torch.zeros_like(x)], -1).flatten(0, 1)
    first = (torch.arange(7)[:, None] * 8 + torch.arange(7)).flatten()
    sheet = torch.cat(
        [torch.stack([first, first + 8, first + 1], -1), torch.stack([first + 1, first + 8, first + 9], -1)]
    )
    vertices = torch.cat([flat, flat + torch.tensor([0.0, 0, -1])])
    surface = Surface(vertices, torch.cat([sheet, sheet.flip(-1) + 64]), reach=3.0)
    points = torch.tensor([[3.3, 3.2, -0.5 - 0.4 * side]])
    face_ids, mix = surface.closest(points, torch.tensor([[0.0, 0, side]]))
    assert float(surface.at(face_ids, mix)[0, 2]) == (0 if side > 0 else -1)
