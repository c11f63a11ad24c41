"""The skin: the body mesh above a plane through the neck, cut cleanly, with mouth bag and eye sockets."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from open_head.binding import Binding, mixed
from open_head.makehuman import N_BASE, MakeHuman

CUT_POINT = (0.0, -0.119, -0.014)
"""A point of the cutting plane, m: low enough to keep the neck, high enough to leave the shoulders."""
CUT_SLOPE = 0.5
"""Fall of the plane per metre forwards: down to the pit of the throat, up to the nape."""
SNAP = 0.0015
"""Vertices nearer to the plane than this count as lying on it, m: no slivers."""


def add_skin(binding: Binding, source: MakeHuman) -> None:
    """Append skin and tongue to the binding."""
    vertices = source.neutral
    height = vertices[:, 1] - CUT_POINT[1] + CUT_SLOPE * (vertices[:, 2] - CUT_POINT[2])
    height[np.abs(height) < SNAP] = 0.0
    new_id: dict[tuple[int, int], int] = {}

    def vertex(part: str, a: int, b: int | None = None) -> int:
        """A base vertex, or the point where the edge a-b meets the plane."""
        key = (a, a) if b is None else (min(a, b), max(a, b))
        if key not in new_id:
            weights = {a: 1.0}
            if b is not None:
                share = height[a] / (height[a] - height[b])
                weights = mixed((1 - share, {a: 1.0}), (share, {b: 1.0}))
            new_id[key] = binding.add(part, weights)
        return new_id[key]

    body = source.quads.groups == "body"
    for quad, texture in _connected(source, body & (height[source.quads.vertices] > 0).any(1)):
        corners, uv = [], []
        for index in range(4):
            a, b = int(quad[index]), int(quad[(index + 1) % 4])
            uv_a, uv_b = source.uv[texture[index]], source.uv[texture[(index + 1) % 4]]
            if height[a] >= 0:
                corners.append(vertex("skin", a))
                uv.append(uv_a)
            if height[a] * height[b] < 0:
                corners.append(vertex("skin", a, b))
                share = height[a] / (height[a] - height[b])
                uv.append((1 - share) * uv_a + share * uv_b)
        binding.polygon(corners, np.array(uv))
    tongue = source.quads.groups == "helper-tongue"
    for quad, texture in zip(source.quads.vertices[tongue], source.quads.textures[tongue], strict=True):
        binding.polygon([vertex("tongue", int(corner)) for corner in quad], source.uv[texture])


def _connected(source: MakeHuman, chosen: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Chosen quads (vertex ids, texture ids) that hang together with the top of the head."""
    quads = source.quads.vertices[chosen]
    a, b = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    graph = sparse.coo_matrix((np.ones(a.size), (a, b)), shape=(N_BASE, N_BASE))
    _, label = csgraph.connected_components(graph, directed=False)
    top = quads.ravel()[source.neutral[quads.ravel(), 1].argmax()]
    kept = label[quads[:, 0]] == label[top]
    return list(zip(quads[kept], source.quads.textures[chosen][kept], strict=True))
