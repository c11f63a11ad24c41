"""Splitting the faces of a mesh until they are about as small as pixels, so that vertices can carry the picture.

Every edge gets a vertex in its middle. It is lifted onto the cubic that is normal to both end normals (the edge of
a PN triangle; Vlachos et al. 2001), so outlines become round while the old vertices stay where they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float32, Int64


@dataclass(frozen=True)
class Refinement:
    """How a refined mesh arises from a coarse one: old vertices, then the middles of edges, level by level."""

    edges: tuple[Int64[np.ndarray, "e 2"], ...]
    """Ends of the edges halved at each level."""
    faces: Int64[np.ndarray, "f 3"]
    face_source: Int64[np.ndarray, " f"]
    """Coarse face that each fine face lies in."""

    def spread(self, values: Float32[np.ndarray, "v ..."]) -> Float32[np.ndarray, "w ..."]:
        """Coarse values, linearly interpolated at all vertices."""
        for ends in self.edges:
            values = np.concatenate([values, 0.5 * (values[ends[:, 0]] + values[ends[:, 1]])])
        return values

    def curve(
        self, positions: Float32[np.ndarray, "v 3"], normals: Float32[np.ndarray, "v 3"]
    ) -> tuple[Float32[np.ndarray, "w 3"], Float32[np.ndarray, "w 3"]]:
        """Positions and unit normals at all vertices."""
        for ends in self.edges:
            (a, b), (normal_a, normal_b) = positions[ends.T], normals[ends.T]
            along = b - a
            # Where the normals part, at lips and lids, an edge is a crease and stays straight.
            roundness = np.maximum(np.einsum("ni,ni->n", normal_a, normal_b), 0) / 8
            rise_a = np.einsum("ni,ni->n", along, normal_a) * roundness
            rise_b = np.einsum("ni,ni->n", along, normal_b) * roundness
            middle = 0.5 * (a + b) - rise_a[:, None] * normal_a + rise_b[:, None] * normal_b
            positions = np.concatenate([positions, middle])
            normals = np.concatenate([normals, unit(normal_a + normal_b)])
        return positions, normals


def refine(faces: Int64[np.ndarray, "f 3"], n_vertices: int, twice: Bool[np.ndarray, " f"]) -> Refinement:
    """Splits every face into four, and those ``twice`` into sixteen.

    Faces split twice must not share edges with others: they would no longer meet at every vertex.
    """
    source = np.arange(len(faces))
    edges_1, fine = _halve(faces, n_vertices)
    source_1 = np.tile(source, 4)
    again = twice[source_1]
    edges_2, finest = _halve(fine[again], n_vertices + len(edges_1))
    return Refinement(
        (edges_1, edges_2),
        np.concatenate([fine[~again], finest]),
        np.concatenate([source_1[~again], np.tile(source_1[again], 4)]),
    )


def _halve(
    faces: Int64[np.ndarray, "f 3"], n_vertices: int
) -> tuple[Int64[np.ndarray, "e 2"], Int64[np.ndarray, "g 3"]]:
    """Edges to halve, and four faces for each one (all first quarters, then all second ones, …)."""
    sides = np.stack([faces, np.roll(faces, -1, 1)], -1)  # f 3 2: side k runs from corner k to corner k + 1
    low, high = sides.min(-1), sides.max(-1)
    keys, number = np.unique(low * n_vertices + high, return_inverse=True)
    edges = np.stack([keys // n_vertices, keys % n_vertices], 1)
    middle = n_vertices + number.reshape(-1, 3)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return edges, np.concatenate([np.stack(quarter, 1) for quarter in quarters])


def unit(vectors: Float32[np.ndarray, "*n 3"]) -> Float32[np.ndarray, "*n 3"]:
    """Vectors scaled to length 1; zero stays zero."""
    length = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
    return vectors / np.maximum(length, 1e-12)[..., None]
