"""The open head's topology, and the map from MakeHuman's vertices to ours."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from open_head import eyes
from open_head.binding import Binding
from open_head.makehuman import N_BASE, MakeHuman
from open_head.seal import LipSeal
from open_head.skin import add_skin
from open_head.teeth import add_teeth

PARTS = ("skin", "tongue", "teeth_upper", "teeth_lower", "eye_left", "eye_right", "gums_upper", "gums_lower")
SIDES = (("left", "l"), ("right", "r"))


class Surface:
    """Faces and vertices of the open head as a function of the base mesh.

    Args:
        source: the MakeHuman data.
    """

    def __init__(self, source: MakeHuman) -> None:
        binding = Binding()
        add_skin(binding, source)
        add_teeth(binding, source)
        self._matrix = binding.matrix()
        self._offset = np.array(binding.offsets)
        self._eyes = {
            side: eyes.Eye.fit(source.neutral, source.group(f"helper-{letter}-eye")) for side, letter in SIDES
        }
        self.ball = eyes.make_ball(eyes.SHRINK * self._eyes["left"].radius)
        parts, faces, uv = list(binding.parts), list(binding.faces), list(binding.uv)
        for side, _ in SIDES:
            faces += [tuple(corner + len(parts) for corner in face) for face in self.ball.faces.tolist()]
            parts += [f"eye_{side}"] * len(self.ball.points)
            uv += [np.full((3, 2), np.nan)] * len(self.ball.faces)
        self.faces = np.array(faces)
        self.uv = np.array(uv)
        self.part = np.array([PARTS.index(part) for part in parts])
        self.base_vertex = self._single_base_vertices(binding)
        """Base vertex that an output vertex copies, -1 for new ones."""
        self._source = source
        self._neck_ids = np.array(source.json("rigs/standard/rig.default.json")["neck03"]["head"]["vertex_indices"])
        number = np.full(N_BASE, -1)
        number[self.base_vertex[self.base_vertex >= 0]] = np.flatnonzero(self.base_vertex >= 0)
        self.number = number
        """Output vertex that copies each base vertex, -1 for none."""
        self._parted = self._lift_parted(source.neutral)
        self._seal = LipSeal(source, self._parted, number, self.adjacency(self.is_part("skin")))
        self.template = self.lift(source.neutral)

    def is_part(self, *names: str) -> np.ndarray:
        """Vertices of the named parts."""
        return np.isin(self.part, [PARTS.index(name) for name in names])

    def lift(self, base: np.ndarray) -> np.ndarray:
        """Our vertices for the base mesh of a person at rest, lips closed, m (v, 3)."""
        return self._seal(self._lift_parted(base))

    def delta(self, displacement: np.ndarray) -> np.ndarray:
        """Displacement of our vertices for a movement of the neutral base mesh, m (v, 3).

        The lips are not sealed here, or no movement could part them.
        """
        return self._lift_parted(self._source.neutral + displacement) - self._parted

    def _lift_parted(self, base: np.ndarray) -> np.ndarray:
        """Our vertices with the lips as MakeHuman leaves them."""
        bound = self._matrix @ base + self._offset
        balls = []
        for side, _ in SIDES:
            centre, radius = self._eyes[side].follow(base)
            bound = eyes.settle(bound, centre, radius)
            balls.append(self.eye_centre(base, side) + eyes.SHRINK * radius * self.ball.points)
        return np.concatenate([bound, *balls])

    def extend(self, values: np.ndarray) -> np.ndarray:
        """Values of base vertices carried to ours; eyeballs get zero (v, k)."""
        bound = self._matrix @ values
        return np.concatenate([bound, np.zeros((len(self.part) - len(bound), *values.shape[1:]))])

    def eye_centre(self, base: np.ndarray, side: str) -> np.ndarray:
        """Centre of our smaller eyeball, whose front pole is the helper's, m."""
        centre, radius = self._eyes[side].follow(base)
        return centre + np.array([0, 0, (1 - eyes.SHRINK) * radius])

    def joints(self, base: np.ndarray) -> np.ndarray:
        """Root, neck, rig's jaw, left eye, right eye for the base mesh in any shape, m (5, 3)."""
        cubes = [
            base[self._source.group("joint-neck")],
            base[self._neck_ids],
            base[self._source.group("joint-mouth")],
        ]
        centres = [self.eye_centre(base, side) for side, _ in SIDES]
        return np.stack([cube.mean(0) for cube in cubes] + centres)

    def adjacency(self, kept: np.ndarray | None = None) -> sparse.csr_matrix:
        """Symmetric 0/1 matrix of edges; only between ``kept`` vertices when given."""
        faces = self.faces if kept is None else self.faces[kept[self.faces].all(1)]
        a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        n = len(self.part)
        edges = sparse.coo_matrix((np.ones(2 * a.size), (np.r_[a, b], np.r_[b, a])), shape=(n, n)).tocsr()
        edges.data[:] = 1.0
        return edges

    def border(self) -> np.ndarray:
        """Vertices on the open edge of the skin: the neck's cut."""
        skin = self.faces[self.is_part("skin")[self.faces].all(1)]
        edges = np.sort(np.stack([skin, np.roll(skin, -1, axis=1)], -1).reshape(-1, 2), axis=1)
        unique, count = np.unique(edges, axis=0, return_counts=True)
        mask = np.zeros(len(self.part), dtype=bool)
        mask[unique[count == 1]] = True
        return mask

    def _single_base_vertices(self, binding: Binding) -> np.ndarray:
        single = [next(iter(mix)) if len(mix) == 1 else -1 for mix in binding.weights]
        return np.array(single + [-1] * (2 * len(self.ball.points)))
