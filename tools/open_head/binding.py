"""Output vertices as affine functions of the base mesh, so that every morph target reaches all of them."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from open_head.makehuman import N_BASE


@dataclass
class Binding:
    """A growing list of vertices, each Σ weight · base vertex + offset, and of the faces between them."""

    weights: list[dict[int, float]] = field(default_factory=list)
    offsets: list[np.ndarray] = field(default_factory=list)
    parts: list[str] = field(default_factory=list)
    faces: list[tuple[int, int, int]] = field(default_factory=list)
    uv: list[np.ndarray] = field(default_factory=list)

    def add(self, part: str, weights: dict[int, float], offset: np.ndarray | None = None) -> int:
        """New vertex; returns its number."""
        self.weights.append(weights)
        self.offsets.append(np.zeros(3) if offset is None else offset)
        self.parts.append(part)
        return len(self.parts) - 1

    def polygon(self, corners: list[int], uv: np.ndarray | None = None) -> None:
        """Convex polygon as a fan of triangles; NaN texture coordinates when it has none."""
        texture = np.full((len(corners), 2), np.nan) if uv is None else uv
        for index in range(1, len(corners) - 1):
            chosen = (0, index, index + 1)
            self.faces.append((corners[0], corners[index], corners[index + 1]))
            self.uv.append(texture[list(chosen)])

    def grid(self, ids: np.ndarray, *, flip: bool = False) -> None:
        """Quads between neighbouring rows and columns of a grid of vertex numbers."""
        for row in range(ids.shape[0] - 1):
            for column in range(ids.shape[1] - 1):
                quad = [ids[row, column], ids[row, column + 1], ids[row + 1, column + 1], ids[row + 1, column]]
                self.polygon([int(corner) for corner in (quad[::-1] if flip else quad)])

    def matrix(self) -> sparse.csr_matrix:
        """Weights as a sparse matrix (vertices, base vertices)."""
        rows = [row for row, mix in enumerate(self.weights) for _ in mix]
        columns = [base for mix in self.weights for base in mix]
        values = [weight for mix in self.weights for weight in mix.values()]
        return sparse.csr_matrix((values, (rows, columns)), shape=(len(self.weights), N_BASE))


class EdgeFlow:
    """Walks a quad mesh straight ahead, along the lines an artist drew.

    Args:
        quads: vertex ids (n, 4).
    """

    def __init__(self, quads: np.ndarray) -> None:
        self.neighbours: dict[int, set[int]] = defaultdict(set)
        self._quads: dict[int, set[int]] = defaultdict(set)
        for number, quad in enumerate(quads):
            for corner in range(4):
                a, b = int(quad[corner]), int(quad[(corner + 1) % 4])
                self.neighbours[a].add(b)
                self.neighbours[b].add(a)
                self._quads[a].add(number)

    def walk(self, first: int, second: int) -> list[int]:
        """Vertices of the line through two neighbours, up to a border or an irregular vertex; a loop comes once."""
        line = [first, second]
        while True:
            here, before = line[-1], line[-2]
            behind = self._quads[here] & self._quads[before]
            ahead = [n for n in self.neighbours[here] if n != before and not self._quads[n] & behind]
            if len(ahead) != 1 or ahead[0] == first:
                return line
            line.append(ahead[0])

    def across(self, middle: int, x: np.ndarray) -> list[int]:
        """The line through a midline vertex, from the subject's right (x < 0) to the left."""
        right = min(self.neighbours[middle], key=lambda n: x[n])
        left = max(self.neighbours[middle], key=lambda n: x[n])
        return self.walk(middle, right)[:0:-1] + self.walk(middle, left)


def mixed(*terms: tuple[float, dict[int, float]]) -> dict[int, float]:
    """Σ factor · weights."""
    total: dict[int, float] = defaultdict(float)
    for factor, weights in terms:
        for base, weight in weights.items():
            total[base] += factor * weight
    return {base: weight for base, weight in total.items() if abs(weight) > 1e-12}
