"""Closes the lips: a linear map that makes upper and lower lip meet, whatever the identity.

In MakeHuman's neutral shapes the lips stay up to a millimetre apart, so that teeth peep out. The lines where the
lips should touch are known; half of the gap between them is added to each side and fades into the face.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import linalg

from open_head.binding import EdgeFlow
from open_head.makehuman import MakeHuman

LOOPS = (474, 520)
"""Midline vertices of the base mesh where the two edge loops cross the upper lip that may touch the lower one."""
OVERLAP = 0.0004
"""How far the lips are pressed into each other, m: no light passes, from above or below either."""
REACH = 0.013
"""Distance from the line of contact over which the correction fades, m."""


class LipSeal:
    """Linear map of all vertices.

    Args:
        source: for the topology of the lips.
        vertices: neutral vertices before sealing, m (n, 3).
        number: output vertex of each base vertex.
        neighbours: symmetric adjacency of the skin (n, n).
    """

    def __init__(
        self, source: MakeHuman, vertices: np.ndarray, number: np.ndarray, neighbours: sparse.csr_matrix
    ) -> None:
        flow = EdgeFlow(source.quads.of("body"))
        loops = np.array([self._loop(flow, start, source.neutral) for start in LOOPS])
        corners = [int(np.argmax(sign * source.neutral[loops[-1], 0])) for sign in (1, -1)]
        upper = np.ones(loops.shape[1], dtype=bool)
        upper[corners[0] : corners[1] + 1] = False
        lower = ~upper
        lower[corners] = False
        # At each column the foremost of the loops towards the other lip touches it.
        heights = source.neutral[loops, 1]
        touching = np.where(upper, heights.argmin(0), heights.argmax(0))
        contact = number[loops[touching, np.arange(loops.shape[1])]]
        gap = _gap_rows(vertices, contact, upper, lower)
        side = np.where(upper, -0.5, 0.0) + np.where(lower, 0.5, 0.0)
        self._push = sparse.diags(side) @ gap
        width = np.abs(vertices[contact, 0]).max()
        self._press = side * OVERLAP * (1 - (vertices[contact, 0] / width) ** 8).clip(0)
        self._spread = _spread(vertices, number[loops], neighbours)

    def __call__(self, vertices: np.ndarray) -> np.ndarray:
        """Vertices with the lips closed, m."""
        sealed = vertices.copy()
        sealed[:, 1] += self._spread @ (self._push @ vertices[:, 1] + self._press)
        return sealed

    @staticmethod
    def _loop(flow: EdgeFlow, start: int, vertices: np.ndarray) -> list[int]:
        left = max(flow.neighbours[start], key=lambda n: vertices[n, 0])
        return flow.walk(start, left)


def _gap_rows(vertices: np.ndarray, contact: np.ndarray, upper: np.ndarray, lower: np.ndarray) -> sparse.csr_matrix:
    """Height of the upper over the lower line of contact at each contact vertex, as weights of vertices."""
    rows, columns, values = [], [], []
    for row, (vertex, is_upper) in enumerate(zip(contact, upper, strict=True)):
        if not (is_upper or lower[row]):
            continue
        others = contact[~upper] if is_upper else contact[~lower]
        others = others[np.argsort(vertices[others, 0])]
        x = vertices[others, 0]
        right = int(np.clip(np.searchsorted(x, vertices[vertex, 0]), 1, len(x) - 1))
        share = float(np.clip((vertices[vertex, 0] - x[right - 1]) / (x[right] - x[right - 1]), 0, 1))
        sign = 1.0 if is_upper else -1.0
        rows += [row] * 3
        columns += [int(vertex), int(others[right - 1]), int(others[right])]
        values += [sign, -sign * (1 - share), -sign * share]
    return sparse.csr_matrix((values, (rows, columns)), shape=(len(contact), len(vertices)))


def _spread(vertices: np.ndarray, loops: np.ndarray, neighbours: sparse.csr_matrix) -> sparse.csr_matrix:
    """Smooth extension of values on the loops' columns to the skin around them: biharmonic, zero beyond reach."""
    n = len(vertices)
    fixed = np.unique(loops)
    near = np.min(np.linalg.norm(vertices[:, None] - vertices[None, fixed], axis=-1), axis=1) < REACH
    skin = np.asarray(neighbours.sum(1)).ravel() > 0
    free = np.flatnonzero(near & skin & ~np.isin(np.arange(n), fixed))
    degree = np.asarray(neighbours.sum(1)).ravel()
    laplacian = sparse.diags(np.where(degree > 0, 1.0, 0.0)) - sparse.diags(1 / np.maximum(degree, 1)) @ neighbours
    smooth = (laplacian.T @ laplacian).tocsr()
    given = sparse.lil_matrix((n, loops.shape[1]))
    for column in range(loops.shape[1]):
        given[loops[:, column], column] = 1.0
    given = given.tocsr()
    solved = linalg.splu(smooth[free][:, free].tocsc()).solve(-(smooth[free] @ given).toarray())
    spread = given.tolil()
    spread[free] = solved
    return spread.tocsr()
