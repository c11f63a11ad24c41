"""Triangle meshes to pixels: which face each pixel sees, where on it, and a simple way to shade that.

Coverage is exact. Vertices snap to 1/4096 px, and whether a pixel centre lies in a triangle is decided in integers
with the top-left rule, so neighbouring faces neither overlap nor leave a gap, and the answer does not depend on the
machine or on the number of threads. The nearest face wins, the first of equally near ones; both sides of a face are
drawn. Nothing here is differentiable in the vertices; ``interpolate`` is differentiable in the attributes.

``_rasterize_reference`` is the definition in numpy; ``native/src/mesh.cpp`` is its fast twin.
"""

from __future__ import annotations

import ctypes
import itertools
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from toonifygb.render import library, resolve_backend
from toonifygb.structures import Camera, Rendering, TensorRecord

if TYPE_CHECKING:
    from jaxtyping import Float, Float64, Int, Int32, Int64

SUBPIXEL = 4096
"""Steps per pixel that vertices snap to; a power of two, fine enough for sub-pixel faces."""
GUARD_PX = 65536.0
"""Faces are clipped to this distance from the image origin, so that integer edge functions stay below 2⁶⁰."""
NEAR_M = 0.01
"""Faces are clipped to this distance from the camera plane."""
CHUNK_PAIRS = 1 << 21
"""Face-pixel pairs the reference looks at together: about 400 MB of temporaries."""


@dataclass(frozen=True)
class MeshHits(TensorRecord):
    """What each pixel centre of an image sees of a mesh."""

    face_id: Int64[Tensor, "h w"]
    """Number of the nearest face; -1 where there is none."""
    bary: Float[Tensor, "h w 3"]
    """Weights of the face's three corners at the hit, perspective-correct, sum 1; 0 where there is none."""
    depth: Float[Tensor, "h w"]
    """Distance of the hit from the camera plane, m; infinite where there is none."""

    @property
    def covered(self) -> Tensor:
        """Pixels that see the mesh."""
        return self.face_id >= 0


@dataclass(frozen=True)
class _Screen:
    """Triangles in front of the camera, in whole sub-pixels: all that the two rasterisers need."""

    xy: Int32[np.ndarray, "v 2"]
    """Sub-pixels; pixel centre (j + 0.5, i + 0.5) is at ((2 j + 1) SUBPIXEL / 2, …)."""
    inverse_depth: Float64[np.ndarray, " v"]
    faces: Int64[np.ndarray, "t 3"]


def rasterize_mesh(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    camera: Camera,
    *,
    near: float = NEAR_M,
    backend: str = "auto",
    threads: int | None = None,
) -> MeshHits:
    """Nearest face, barycentric weights and depth at every pixel centre.

    Args:
        vertices: world, m.
        faces: corner indices; either winding.
        camera: pinhole camera.
        near: faces are clipped where they come nearer to the camera plane than this, m.
        backend: ``native``, ``reference`` or ``auto`` (native where the library is built).
        threads: threads of the native rasteriser, all processors when ``None``; the result does not depend on it.

    Raises:
        InputError: no such backend.
        BackendError: ``native`` was asked for and is not available.
    """
    points = _homogeneous_pixels(vertices, camera)
    corners = np.ascontiguousarray(faces.detach().cpu().numpy(), np.int64)
    screen, source, corner_bary = _to_screen(points, corners, near)
    if resolve_backend(backend) == "native":
        triangle, bary, depth = _rasterize_native(
            screen, camera.width, camera.height, threads or os.cpu_count() or 1
        )
    else:
        triangle, bary, depth = _rasterize_reference(screen, camera.width, camera.height)
    if source is not None:
        triangle, bary = _undo_clipping(triangle, bary, source, corner_bary)
    return MeshHits(torch.from_numpy(triangle), torch.from_numpy(bary), torch.from_numpy(depth)).to(vertices.device)


def interpolate(
    hits: MeshHits, faces: Int[Tensor, "f 3"], attributes: Float[Tensor, "v c"]
) -> Float[Tensor, "h w c"]:
    """Vertex attributes at every hit; 0 where there is none."""
    covered = hits.covered
    corners = attributes[faces[hits.face_id[covered]]]
    image = attributes.new_zeros(*covered.shape, attributes.shape[-1])
    image[covered] = (hits.bary[covered].to(attributes.dtype)[:, :, None] * corners).sum(1)
    return image


def supersampled(camera: Camera, factor: int) -> Camera:
    """The same view with ``factor`` × ``factor`` pixels for each one."""
    scale = torch.diag(torch.tensor([factor, factor, 1.0], dtype=camera.K.dtype, device=camera.K.device))
    return Camera(scale @ camera.K, camera.world_to_camera, camera.width * factor, camera.height * factor)


def box_downsample(image: Float[Tensor, "H W *c"], factor: int) -> Float[Tensor, "h w *c"]:
    """Means of ``factor`` × ``factor`` blocks: the partner of ``supersampled``."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return image.reshape(height, factor, width, factor, *image.shape[2:]).mean((1, 3))


def interpolated_means(
    hits: MeshHits,
    faces: Int[Tensor, "f 3"],
    attributes: Float[Tensor, "v c"],
    factor: int,
    *,
    backend: str = "auto",
    threads: int | None = None,
) -> Float[Tensor, "h w c"]:
    """``box_downsample(interpolate(hits, faces, attributes), factor)``, much faster; not differentiable.

    Where nothing is hit attributes count as 0.

    Args:
        hits: of a ``supersampled`` camera.
        faces: those that were rasterised.
        attributes: values at the vertices, float32.
        factor: samples per pixel along each axis.
        backend: as in ``rasterize_mesh``.
        threads: as in ``rasterize_mesh``.
    """
    if resolve_backend(backend) != "native":
        return box_downsample(interpolate(hits, faces, attributes), factor)
    average = library.load().tgb_mesh_means
    average.argtypes = [ctypes.c_void_p] * 4 + [ctypes.c_int] * 5 + [ctypes.c_void_p]
    average.restype = None
    height, width = hits.face_id.shape[0] // factor, hits.face_id.shape[1] // factor
    inputs = [hits.face_id, hits.bary, faces.long(), attributes.detach().float()]
    inputs = [tensor.cpu().contiguous() for tensor in inputs]
    means = torch.empty(height, width, attributes.shape[-1])
    sizes = (attributes.shape[-1], width, height, factor, threads or os.cpu_count() or 1)
    average(*(tensor.data_ptr() for tensor in inputs), *sizes, means.data_ptr())
    return means.to(attributes.device)


def render_clay(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    normals: Float[Tensor, "v 3"],
    camera: Camera,
    *,
    colors: Float[Tensor, "v 3"] | None = None,
    supersample: int = 2,
) -> Rendering:
    """Matt, smoothly shaded picture of a mesh under a key and a fill light that travel with the camera.

    Args:
        vertices: world, m.
        faces: corner indices.
        normals: unit vertex normals, world; they are turned towards the camera.
        camera: pinhole camera.
        colors: sRGB 0..1 at the vertices; light grey when ``None``.
        supersample: samples per pixel along each axis.
    """
    albedo = vertices.new_full((len(vertices), 3), 0.78) if colors is None else colors
    lit = albedo * key_and_fill(normals, vertices, camera)[:, None]
    hits = rasterize_mesh(vertices, faces, supersampled(camera, supersample))
    alpha = box_downsample(hits.covered.to(lit.dtype), supersample)
    return Rendering(interpolated_means(hits, faces, lit, supersample), alpha)


def key_and_fill(
    normals: Float[Tensor, "v 3"], vertices: Float[Tensor, "v 3"], camera: Camera
) -> Float[Tensor, " v"]:
    """Brightness 0..1 of a matt surface lit from the upper left and, weaker, from the right of the camera."""
    rotation, offset = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    seen = normals @ rotation.to(normals).T
    position = vertices @ rotation.to(vertices).T + offset.to(vertices)
    facing = -(seen * position).sum(-1, keepdim=True).sign()
    seen = torch.where(facing == 0, seen, seen * facing)
    brightness = torch.full_like(seen[:, 0], 0.22)
    for direction, strength in (((-0.45, -0.55, -0.70), 0.62), ((0.80, -0.10, -0.60), 0.24)):
        towards = torch.nn.functional.normalize(seen.new_tensor(direction), dim=0)
        brightness = brightness + strength * (seen @ towards).clamp_min(0)
    return brightness.clamp_max(1)


# --- projection and clipping, shared by both rasterisers --------------------------------------------------------


def _homogeneous_pixels(vertices: Float[Tensor, "v 3"], camera: Camera) -> Float64[np.ndarray, "v 3"]:
    """(x z, y z, z) with x, y in px and z the depth in m; linear in the vertex, so faces can be clipped in it."""
    world = vertices.detach().cpu().double()
    transform = camera.world_to_camera.detach().cpu().double()
    points = (world @ transform[:3, :3].T + transform[:3, 3]) @ camera.K.detach().cpu().double().T
    if not bool(points.isfinite().all()):
        raise ValueError("vertices and camera must be finite")
    return points.numpy()


def _planes(near: float) -> Float64[np.ndarray, "5 4"]:
    """Half-spaces n·p ≥ d of the guarded view: rows (n, d)."""
    guard = GUARD_PX
    rows = [(0, 0, 1, near), (1, 0, guard, 0), (-1, 0, guard, 0), (0, 1, guard, 0), (0, -1, guard, 0)]
    return np.array(rows, np.float64)


def _to_screen(
    points: Float64[np.ndarray, "v 3"], faces: Int64[np.ndarray, "f 3"], near: float
) -> tuple[_Screen, Int64[np.ndarray, " t"] | None, Float64[np.ndarray, "t 3 3"]]:
    """Triangles inside the guarded view.

    Returns:
        The triangles; the face each one comes from, ``None`` if they are just the faces; and the weights of that
        face's corners at each corner of the last triangles, those that were cut.
    """
    reach = GUARD_PX * points[:, 2]
    inside = (points[:, 2] >= near) & (np.abs(points[:, 0]) <= reach) & (np.abs(points[:, 1]) <= reach)
    none_cut = np.zeros((0, 3, 3))
    if inside.all():
        return _snap(points, faces), None, none_cut
    whole = inside[faces].all(1)
    cut, cut_source, cut_bary = _clip(points[faces[~whole]], _planes(near))
    kept = np.flatnonzero(whole)
    source = np.concatenate([kept, np.flatnonzero(~whole)[cut_source]])
    cut_faces = np.arange(cut.shape[0] * 3, dtype=np.int64).reshape(-1, 3) + len(points)
    safe = np.where(inside[:, None], points, (0.0, 0.0, 1.0))  # vertices outside belong to no triangle any more
    screen = _snap(np.concatenate([safe, cut.reshape(-1, 3)]), np.concatenate([faces[kept], cut_faces]))
    return screen, source, cut_bary


def _snap(points: Float64[np.ndarray, "v 3"], faces: Int64[np.ndarray, "t 3"]) -> _Screen:
    inverse_depth = 1.0 / points[:, 2]
    xy = np.rint(points[:, :2] * (inverse_depth[:, None] * SUBPIXEL)).astype(np.int32)
    return _Screen(xy, inverse_depth, faces)


def _clip(
    triangles: Float64[np.ndarray, "n 3 3"], planes: Float64[np.ndarray, "p 4"]
) -> tuple[Float64[np.ndarray, "m 3 3"], Int64[np.ndarray, " m"], Float64[np.ndarray, "m 3 3"]]:
    """Parts of triangles inside all planes, as triangles.

    Returns:
        The parts; the number of the triangle each lies in; weights of that triangle's corners at the part's.
    """
    source = np.arange(len(triangles))
    bary = np.broadcast_to(np.eye(3), (len(triangles), 3, 3)).copy()
    for plane in planes:
        distance = triangles @ plane[:3] - plane[3]
        n_inside = (distance >= 0).sum(1)
        joined = np.concatenate([triangles, bary], 2)  # what holds for positions holds for weights
        parts = [joined[n_inside == 3]]
        origins = [source[n_inside == 3]]
        for count in (1, 2):
            chosen = n_inside == count
            pieces = _cut(joined[chosen], distance[chosen], count)
            parts += pieces
            origins += [source[chosen]] * len(pieces)
        joined, source = np.concatenate(parts), np.concatenate(origins)
        triangles, bary = joined[..., :3], joined[..., 3:]
    return triangles, source, bary


def _cut(
    corners: Float64[np.ndarray, "n 3 c"], distance: Float64[np.ndarray, "n 3"], n_inside: int
) -> list[Float64[np.ndarray, "n 3 c"]]:
    """The inner parts of triangles with one (one part) or two (two parts) corners inside a plane."""
    lone_is_inside = n_inside == 1
    lone = np.argmax((distance >= 0) == lone_is_inside, axis=1)
    order = (lone[:, None] + np.arange(3)) % 3  # the lone corner first, winding kept
    corners = np.take_along_axis(corners, order[..., None], 1)
    distance = np.take_along_axis(distance, order, 1)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]

    def crossing(k: int) -> np.ndarray:
        # Always from the inner to the outer corner: both faces at an edge then cut it at the same point.
        inner, outer = (0, k) if lone_is_inside else (k, 0)
        share = distance[:, inner] / (distance[:, inner] - distance[:, outer])
        return corners[:, inner] + share[:, None] * (corners[:, outer] - corners[:, inner])

    ab, ac = crossing(1), crossing(2)
    if lone_is_inside:
        return [np.stack([a, ab, ac], 1)]
    return [np.stack([ab, b, c], 1), np.stack([ab, c, ac], 1)]


def _undo_clipping(
    triangle: Int64[np.ndarray, "h w"],
    bary: np.ndarray,
    source: Int64[np.ndarray, " t"],
    cut_bary: Float64[np.ndarray, "c 3 3"],
) -> tuple[Int64[np.ndarray, "h w"], np.ndarray]:
    """Hits on parts of faces as hits on the faces themselves."""
    first_cut = len(source) - len(cut_bary)
    on_cut = triangle >= first_cut
    bary[on_cut] = np.einsum("nk,nkc->nc", bary[on_cut], cut_bary[triangle[on_cut] - first_cut])
    face_id = np.where(triangle >= 0, np.append(source, -1)[triangle], -1)
    return face_id, bary


# --- the native twin --------------------------------------------------------------------------------------------


def _rasterize_native(
    screen: _Screen, width: int, height: int, threads: int
) -> tuple[Int64[np.ndarray, "h w"], np.ndarray, np.ndarray]:
    """Triangle number, weights and depth at each pixel centre, by the library."""
    rasterize = library.load().tgb_mesh_rasterize
    address, size = ctypes.c_void_p, ctypes.c_int64
    rasterize.argtypes = [address] * 3 + [size] + [ctypes.c_int] * 3 + [address] * 3
    rasterize.restype = None
    triangle = np.empty((height, width), np.int64)
    bary = np.empty((height, width, 3), np.float32)
    depth = np.empty((height, width), np.float32)
    inputs = [np.ascontiguousarray(array) for array in (screen.xy, screen.inverse_depth, screen.faces)]
    rasterize(
        *(array.ctypes.data for array in inputs),
        len(screen.faces),
        *(width, height, threads),
        *(array.ctypes.data for array in (triangle, bary, depth)),
    )
    return triangle, bary, depth


# --- the definition ---------------------------------------------------------------------------------------------


def _rasterize_reference(
    screen: _Screen, width: int, height: int
) -> tuple[Int64[np.ndarray, "h w"], np.ndarray, np.ndarray]:
    """Triangle number, weights and depth at each pixel centre: the definition of coverage."""
    corners = screen.xy.astype(np.int64)[screen.faces]  # t 3 2
    low, high = _pixel_boxes(corners, width, height)
    extent = np.maximum(high - low + 1, 0)
    area = np.abs(_twice_area(corners))
    extent[area == 0] = 0
    # Edge functions times these add up to 1 / depth, which is linear on the screen.
    gain = screen.inverse_depth[screen.faces] / np.maximum(area, 1)[:, None]  # t 3
    counts = extent.prod(1)
    nearest = np.zeros(height * width)
    winner = np.full(height * width, -1, np.int64)
    for first, last in _chunks(counts):
        ids = np.repeat(np.arange(first, last), counts[first:last])
        step = np.arange(len(ids)) - np.repeat(
            np.cumsum(counts[first:last]) - counts[first:last], counts[first:last]
        )
        column = low[ids, 0] + step % extent[ids, 0]
        row = low[ids, 1] + step // extent[ids, 0]
        edges, inside = _edge_functions(corners[ids], column, row)
        ids, pixel, edges = ids[inside], (row * width + column)[inside], edges[inside]
        weighted = edges * gain[ids]
        nearness = weighted[:, 0] + weighted[:, 1] + weighted[:, 2]
        order = np.lexsort((ids, -nearness, pixel))
        best = order[np.unique(pixel[order], return_index=True)[1]]
        best = best[nearness[best] > nearest[pixel[best]]]
        nearest[pixel[best]], winner[pixel[best]] = nearness[best], ids[best]
    return _describe(winner, nearest, corners, gain, width, height)


def _describe(
    winner: np.ndarray, nearest: np.ndarray, corners: np.ndarray, gain: np.ndarray, width: int, height: int
) -> tuple[Int64[np.ndarray, "h w"], np.ndarray, np.ndarray]:
    """The winners' weights and depths as images."""
    pixel = np.flatnonzero(winner >= 0)
    ids = winner[pixel]
    edges, _ = _edge_functions(corners[ids], pixel % width, pixel // width)
    bary = np.zeros((height * width, 3), np.float32)
    depth = np.full(height * width, np.inf, np.float32)
    distance = 1.0 / nearest[pixel]
    bary[pixel] = edges * gain[ids] * distance[:, None]
    depth[pixel] = distance
    return winner.reshape(height, width), bary.reshape(height, width, 3), depth.reshape(height, width)


def _chunks(counts: Int64[np.ndarray, " t"]) -> list[tuple[int, int]]:
    """Ranges of triangles with about ``CHUNK_PAIRS`` pixels to look at in each."""
    if len(counts) == 0:
        return []
    bucket = np.cumsum(counts) // CHUNK_PAIRS
    starts = np.append(np.unique(bucket, return_index=True)[1], len(counts))
    return [(int(a), int(b)) for a, b in itertools.pairwise(starts)]


def _pixel_boxes(
    corners: Int64[np.ndarray, "t 3 2"], width: int, height: int
) -> tuple[Int64[np.ndarray, "t 2"], Int64[np.ndarray, "t 2"]]:
    """First and last (column, row) whose centres can lie in each triangle."""
    half = SUBPIXEL // 2
    low = (corners.min(1) - half + SUBPIXEL - 1) // SUBPIXEL
    high = (corners.max(1) - half) // SUBPIXEL
    return np.maximum(low, 0), np.minimum(high, (width - 1, height - 1))


def _twice_area(corners: Int64[np.ndarray, "t 3 2"]) -> Int64[np.ndarray, " t"]:
    """Signed; positive when the corners run clockwise on the screen (y down)."""
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]


def _edge_functions(
    corners: Int64[np.ndarray, "n 3 2"], column: Int64[np.ndarray, " n"], row: Int64[np.ndarray, " n"]
) -> tuple[Int64[np.ndarray, "n 3"], np.ndarray]:
    """Twice the area between the pixel centre and the edge opposite each corner, and whether all three are inside.

    A centre exactly on an edge counts for the triangle whose left or top edge it is.
    """
    sign = np.sign(_twice_area(corners))[:, None]
    start, end = np.roll(corners, -1, 1), np.roll(corners, -2, 1)
    dx, dy = (sign * (end - start)[..., 0], sign * (end - start)[..., 1])
    x = ((2 * column + 1) * (SUBPIXEL // 2))[:, None] - start[..., 0]
    y = ((2 * row + 1) * (SUBPIXEL // 2))[:, None] - start[..., 1]
    edges = dx * y - dy * x
    owned = (dy < 0) | ((dy == 0) & (dx > 0))
    return edges, (edges + owned > 0).all(1)
