"""The mesh rasteriser: exact coverage, right depths and weights, clipping, and the native twin."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from toonifygb.geometry import cameras, meshes
from toonifygb.render import library, mesh
from toonifygb.structures import Camera

CAMERA = Camera(
    torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), torch.diag(torch.tensor([1.0, -1, -1, 1])), 64, 48
)
BACKENDS = [
    "reference",
    pytest.param("native", marks=pytest.mark.skipif(bool(library.unavailable()), reason="not built")),
]


def sphere(n: int = 24, radius: float = 0.3, centre: tuple[float, float, float] = (0.0, 0.0, -1.0)):
    """UV sphere; its poles are degenerate faces on purpose."""
    theta, phi = torch.linspace(0, torch.pi, n), torch.linspace(0, 2 * torch.pi, n + 1)[:-1]
    t, p = torch.meshgrid(theta, phi, indexing="ij")
    unit = torch.stack([t.sin() * p.cos(), t.cos(), t.sin() * p.sin()], -1).reshape(-1, 3)
    row, column = torch.arange(n - 1)[:, None] * n, torch.arange(n)[None]
    a, b = row + column, row + (column + 1) % n
    faces = torch.cat(
        [torch.stack([a, b, b + n], -1).reshape(-1, 3), torch.stack([a, b + n, a + n], -1).reshape(-1, 3)]
    )
    return unit * radius + torch.tensor(centre), faces


def quad(z: float = -1.0, half: float = 0.2):
    vertices = torch.tensor([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return vertices, torch.tensor([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_pixel_of_a_split_square_belongs_to_exactly_one_half(backend: str) -> None:
    # 24 px wide and with corners on pixel corners: its diagonal runs through pixel centres.
    vertices, faces = quad()
    both = mesh.rasterize_mesh(vertices, faces, CAMERA, backend=backend).covered
    halves = [mesh.rasterize_mesh(vertices, faces[k : k + 1], CAMERA, backend=backend).covered for k in (0, 1)]
    assert both.sum() == 24 * 24
    assert not (halves[0] & halves[1]).any()
    assert torch.equal(halves[0] | halves[1], both)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_square_whose_edges_pass_through_centres_keeps_left_and_top(backend: str) -> None:
    vertices, faces = quad()
    shifted = vertices + torch.tensor([0.5, -0.5, 0.0]) / 60  # half a pixel right and down
    rows, columns = mesh.rasterize_mesh(shifted, faces, CAMERA, backend=backend).covered.nonzero().T
    assert (columns.min(), columns.max()) == (32 - 12, 32 + 11)
    assert (rows.min(), rows.max()) == (24 - 12, 24 + 11)


@pytest.mark.parametrize("backend", BACKENDS)
def test_hits_lie_on_the_ray_of_their_pixel(backend: str) -> None:
    vertices, faces = sphere()
    hits = mesh.rasterize_mesh(vertices, faces, CAMERA, backend=backend)
    points = mesh.interpolate(hits, faces, vertices)[hits.covered]
    pixels, depth = cameras.project(CAMERA, points)
    rows, columns = hits.covered.nonzero().T
    centres = torch.stack([columns, rows], -1) + 0.5
    # Snapping to 1/4096 px tilts the faces at the rim, where depth changes fast; hence not 1e-5.
    torch.testing.assert_close(pixels, centres, atol=2e-3, rtol=0)
    torch.testing.assert_close(depth, hits.depth[hits.covered], atol=1e-5, rtol=0)
    torch.testing.assert_close(hits.bary[hits.covered].sum(-1), torch.ones(len(points)))


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_nearest_face_wins_whatever_the_order(backend: str) -> None:
    near, faces = quad(z=-1.0)
    far, _ = quad(z=-2.0, half=1.0)
    for first, second, winner in ((near, far, (0, 1)), (far, near, (2, 3))):
        both = torch.cat([first, second])
        hits = mesh.rasterize_mesh(both, torch.cat([faces, faces + 4]), CAMERA, backend=backend)
        assert set(hits.face_id[24, 26:38].tolist()) <= set(winner)


@pytest.mark.parametrize("backend", BACKENDS)
def test_of_coincident_faces_the_first_is_seen(backend: str) -> None:
    vertices, faces = quad()
    hits = mesh.rasterize_mesh(vertices, torch.cat([faces, faces]), CAMERA, backend=backend)
    assert set(hits.face_id[hits.covered].tolist()) == {0, 1}


@pytest.mark.parametrize("backend", BACKENDS)
def test_weights_are_perspective_correct_on_a_floor_that_passes_under_the_camera(backend: str) -> None:
    floor = torch.tensor([[-1.0, -0.2, -4.0], [1.0, -0.2, -4.0], [1.0, -0.2, 4.0], [-1.0, -0.2, 4.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    hits = mesh.rasterize_mesh(floor, faces, CAMERA, backend=backend)
    # Of a floor 0.2 m below the eye, row r sees the depth 60 px · 0.2 m / (r + 0.5 - 24).
    rows = torch.arange(28, 48)
    expected = 12.0 / (rows + 0.5 - 24)
    torch.testing.assert_close(hits.depth[rows, 32], expected, rtol=1e-4, atol=0)
    points = mesh.interpolate(hits, faces, floor)[rows, 32]
    torch.testing.assert_close(-points[:, 2], expected, rtol=1e-4, atol=0)
    assert (hits.face_id[rows, 32] >= 0).all()
    assert not hits.covered[:27].any()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "name",
    ["empty", "behind", "beside", "degenerate"],
)
def test_nothing_to_see(backend: str, name: str) -> None:
    vertices, faces = quad()
    if name == "empty":
        faces = faces[:0]
    elif name == "behind":
        vertices = vertices * torch.tensor([1.0, 1.0, -1.0])
    elif name == "beside":
        vertices = vertices + torch.tensor([5.0, 0.0, 0.0])
    else:
        vertices = vertices * torch.tensor([1.0, 0.0, 1.0])
    hits = mesh.rasterize_mesh(vertices, faces, CAMERA, backend=backend)
    assert (hits.face_id == -1).all()
    assert hits.depth.isinf().all()
    assert (hits.bary == 0).all()


def test_vertices_that_are_not_finite_are_refused() -> None:
    vertices, faces = quad()
    vertices[0, 0] = torch.nan
    with pytest.raises(ValueError, match="finite"):
        mesh.rasterize_mesh(vertices, faces, CAMERA)


@pytest.mark.skipif(bool(library.unavailable()), reason="the native library is not built")
@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10_000), n_faces=st.integers(0, 60), size=st.tuples(st.integers(1, 150), st.integers(1, 90))
)
def test_native_equals_reference_on_any_soup(seed: int, n_faces: int, size: tuple[int, int]) -> None:
    """Triangles of every size, through the camera plane and far outside the image: the same faces everywhere."""
    rng = np.random.default_rng(seed)
    vertices = torch.tensor(rng.normal(0, 1, (40, 3)) * 10 ** rng.uniform(-2, 1, (40, 1)), dtype=torch.float32)
    faces = torch.tensor(rng.integers(0, 40, (n_faces, 3)))
    camera = Camera(CAMERA.K, CAMERA.world_to_camera, *size)
    expected = mesh.rasterize_mesh(vertices, faces, camera, backend="reference")
    for threads in (1, 3):
        hits = mesh.rasterize_mesh(vertices, faces, camera, backend="native", threads=threads)
        assert torch.equal(hits.face_id, expected.face_id)
        # A compiler may fuse multiplications and additions, which rounds once less.
        torch.testing.assert_close(hits.bary, expected.bary, rtol=1e-6, atol=1e-7)
        torch.testing.assert_close(hits.depth, expected.depth, rtol=1e-6, atol=0)


@pytest.mark.skipif(bool(library.unavailable()), reason="the native library is not built")
def test_native_means_equal_their_definition() -> None:
    vertices, faces = sphere()
    hits = mesh.rasterize_mesh(vertices, faces, mesh.supersampled(CAMERA, 3))
    attributes = torch.rand(len(vertices), 5)
    expected, got = (
        mesh.interpolated_means(hits, faces, attributes, 3, backend=name) for name in ("reference", "native")
    )
    assert expected.shape == (48, 64, 5)
    # Nine float32 products are added up in another order.
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-6)


def test_clipping_a_face_changes_nothing_that_is_seen() -> None:
    """A face cut by the near plane shows what a smaller face with the same visible part shows."""
    far, near = torch.tensor([0.0, 0.3, -3.0]), torch.tensor([[-1.0, -1.5, 2.0], [1.0, -1.5, 2.0]])
    whole = torch.cat([far[None], near])
    share = (3.0 - 0.5) / 5.0  # cut by hand at z = -0.5, below the image
    part = torch.cat([far[None], far + share * (near - far)])
    faces = torch.tensor([[0, 1, 2]])
    cut = mesh.rasterize_mesh(whole, faces, CAMERA)
    plain = mesh.rasterize_mesh(part, faces, CAMERA)
    both = cut.covered & plain.covered
    assert torch.equal(cut.covered, plain.covered)
    assert both.sum() > 500
    torch.testing.assert_close(cut.depth[both], plain.depth[both], rtol=1e-4, atol=0)


def test_supersampling_softens_only_the_edge() -> None:
    vertices, faces = sphere()
    normals = meshes.vertex_normals(vertices, faces)
    rendering = mesh.render_clay(vertices, faces, normals, CAMERA, supersample=4)
    once = mesh.rasterize_mesh(vertices, faces, CAMERA).covered
    soft = (rendering.alpha > 0) & (rendering.alpha < 1)
    assert rendering.alpha.sum().item() == pytest.approx(once.sum().item(), rel=0.02)
    assert 0 < soft.sum() < 0.35 * once.sum()
    assert rendering.color.shape == (48, 64, 3)
    assert rendering.color[24, 32].mean() > 0.4  # the middle of the sphere faces the key light


def test_interpolation_is_differentiable_in_the_attributes() -> None:
    vertices, faces = sphere(8)
    hits = mesh.rasterize_mesh(vertices, faces, CAMERA)
    colors = torch.rand(len(vertices), 3, requires_grad=True)
    mesh.interpolate(hits, faces, colors).sum().backward()
    assert colors.grad is not None
    # Weights sum to one at every hit, in each channel.
    assert colors.grad.sum().item() == pytest.approx(3 * hits.covered.sum().item(), rel=1e-5)
