"""Surface sampling: exact count, even cover, reproducible, quick."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
import torch
from test_geometry_meshes import grid_sphere

from toonifygb.geometry import meshes, sampling
from toonifygb.geometry.sampling import curve_order

FLAT = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2], [0, 2, 3]])


def nearest(points: np.ndarray) -> np.ndarray:
    """Distance of each point to its nearest neighbour, the slow way."""
    distances = torch.cdist(torch.from_numpy(points), torch.from_numpy(points))
    distances.fill_diagonal_(math.inf)
    return distances.min(1).values.numpy()


@pytest.mark.parametrize("n", [0, 1, 2, 57, 1000])
def test_count_is_exact_and_points_lie_in_their_faces(n: int):
    vertices, faces = grid_sphere(10, 14)
    ids, weights = meshes.sample_surface(vertices, faces, n, seed=3)
    assert ids.shape == (n,) and weights.shape == (n, 3) and weights.dtype == vertices.dtype
    assert ((ids >= 0) & (ids < len(faces))).all() and (weights >= 0).all()
    torch.testing.assert_close(weights.sum(1), torch.ones(n, dtype=torch.float64))


def test_same_seed_same_points():
    vertices, faces = grid_sphere(10, 14)
    one, two, other = (meshes.sample_surface(vertices, faces, 300, seed=s) for s in (1, 1, 2))
    assert one[0].equal(two[0]) and one[1].equal(two[1])
    assert not one[0].equal(other[0])


@pytest.mark.parametrize("n", [400, 2000])
def test_points_keep_their_distance_and_leave_no_hole(n: int):
    """Random points come as near as 0.02 to each other in these units and leave holes of 1.5."""
    vertices, faces = FLAT
    ids, weights = meshes.sample_surface(vertices, faces, n)
    points = meshes.barycentric(vertices, faces, ids, weights).double().numpy()
    spacing = math.sqrt(1 / n)
    assert nearest(points).min() > 0.6 * spacing
    corners = np.random.default_rng(0).random((2000, 3)) * [1, 1, 0]
    holes = torch.cdist(torch.from_numpy(corners), torch.from_numpy(points)).min(1).values
    assert float(holes.max()) < 1.2 * spacing


def test_share_of_faces_follows_area_and_weight():
    vertices, faces = grid_sphere(20, 30)
    upper = vertices[faces].mean(1)[:, 2] > 0
    areas = meshes.face_areas(vertices, faces)
    weights = torch.where(upper, 4.0, 1.0).double()
    expected = float((areas * weights)[upper].sum() / (areas * weights).sum())
    ids, _ = meshes.sample_surface(vertices, faces, 2000, weights_per_face=weights)
    assert float(upper[ids].double().mean()) == pytest.approx(expected, abs=0.01)
    only, _ = meshes.sample_surface(vertices, faces, 500, weights_per_face=upper.double())
    assert upper[only].all()


def test_two_sides_of_a_thin_sheet_are_both_covered():
    """As far apart as a lip from its neighbour: each side must get its own points."""
    vertices, faces = FLAT
    both = torch.cat((vertices, vertices - torch.tensor([0, 0, 1e-4])))
    sheet = torch.cat((faces, faces.flip(1) + 4))
    ids, weights = meshes.sample_surface(both, sheet, 800)
    points = meshes.barycentric(both, sheet, ids, weights).double().numpy()
    upper = (ids < 2).numpy()
    assert abs(upper.mean() - 0.5) < 0.03
    for side in (upper, ~upper):
        assert nearest(points[side]).min() > 0.6 * math.sqrt(2 / 800)


def test_close_pairs_are_all_close_pairs():
    rng = np.random.default_rng(0)
    n, radius = 300, 0.15
    normals = np.tile([0.0, 0, 1], (n, 1))
    normals[::3] *= -1
    candidates = sampling._Candidates(rng.random((n, 3)), normals, rng.uniform(0.7, 1.4, n))
    first, second, distances = sampling._close_pairs(candidates, radius)
    expected = set()
    for i in range(n):
        for j in range(i + 1, n):
            scale = 0.5 * (candidates.radii[i] + candidates.radii[j])
            apart = np.linalg.norm(candidates.positions[i] - candidates.positions[j]) / scale
            if apart < radius and normals[i] @ normals[j] > 0:
                expected.add((i, j))
    assert set(zip(first.tolist(), second.tolist(), strict=True)) == expected and len(first) == len(expected) > 100
    apart = np.linalg.norm(candidates.positions[first] - candidates.positions[second], axis=1)
    np.testing.assert_allclose(distances, apart / (0.5 * (candidates.radii[first] + candidates.radii[second])))


def test_pieces_of_any_size_give_the_same_pairs(monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(0)
    candidates = sampling._Candidates(rng.random((200, 3)), np.tile([0.0, 0, 1], (200, 1)), np.ones(200))
    whole = sampling._close_pairs(candidates, 0.2)
    monkeypatch.setattr(sampling, "_PAIRS_AT_ONCE", 7)
    pieces = sampling._close_pairs(candidates, 0.2)
    assert all((a == b).all() for a, b in zip(whole, pieces, strict=True))


def test_filling_equals_taking_candidates_in_order():
    rng = np.random.default_rng(0)
    m = 400
    points = rng.random((m, 2))
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    first, second = np.nonzero(np.triu(apart < 0.08, 1))
    kept = np.zeros(m, bool)
    kept[[5, 17]] = True
    slow = kept.copy()
    for i in range(m):
        slow[i] |= not (slow & (apart[i] < 0.08)).any()
    sampling._fill(kept, first, second, m)
    assert (kept == slow).all()


def test_64k_points_take_seconds():
    vertices, faces = grid_sphere(72, 106)
    assert len(faces) > 15_000
    start = time.process_time()
    ids, _ = meshes.sample_surface(vertices, faces, 64_000)
    # Measured 1.6 s; the margin is for slower machines.
    assert len(ids) == 64_000 and time.process_time() - start < 12


def test_a_mesh_without_area_is_refused():
    with pytest.raises(AssertionError, match="without weighted area"):
        meshes.sample_surface(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]), 5)


def test_curve_order_keeps_neighbours_together() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2000, 3, generator=generator)
    order = curve_order(points)
    assert torch.equal(order.sort().values, torch.arange(2000))
    hop = (points[order][1:] - points[order][:-1]).norm(dim=-1).mean()
    assert hop < 0.25 * (points[1:] - points[:-1]).norm(dim=-1).mean()
    assert torch.equal(curve_order(1000 * points - 5), order)
    assert torch.equal(curve_order(torch.zeros(3, 3)), torch.arange(3))
