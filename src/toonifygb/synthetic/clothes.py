"""A shirt: the shoulders' own surface, raised and recoloured below the collar line, and a rib along that line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from toonifygb.head import JOINTS, PARTS
from toonifygb.synthetic.body import CHEST_Z, TORSO, neck_loop
from toonifygb.synthetic.look import linear
from toonifygb.synthetic.noise import fractal_noise, smoothstep, value_noise
from toonifygb.synthetic.refine import unit

if TYPE_CHECKING:
    from jaxtyping import Float32, Int64

    from toonifygb.synthetic.body import Body
    from toonifygb.synthetic.look import Look
    from toonifygb.synthetic.paint import Materials

THICKNESS_M = 0.0045
"""How far the cloth stands off the skin."""
RIB_M = 0.0055
"""Radius of the collar's rib."""
RIB_POINTS, RIB_SIDES = 160, 10


@dataclass(frozen=True)
class Rib:
    """A closed tube on the coarse mesh; it moves with the skin under it."""

    ends: Int64[np.ndarray, "p 2"]
    """Coarse edge that each point of the centre line sits on."""
    share: Float32[np.ndarray, " p"]
    """Place on that edge, 0 at the first end."""
    faces: Int64[np.ndarray, "f 3"]
    color: Float32[np.ndarray, " 3"]

    def place(
        self, vertices: Float32[np.ndarray, "v 3"], normals: Float32[np.ndarray, "v 3"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
        """Vertices and normals of the tube, ``RIB_SIDES`` for each point of its centre line."""
        (a, b), (normal_a, normal_b) = vertices[self.ends.T], normals[self.ends.T]
        centre = a + self.share[:, None] * (b - a)
        outward = unit(normal_a + normal_b)
        # Points sit where the line crosses edges, which is uneven; neighbours are averaged into a smooth curve.
        for _ in range(4):
            centre = 0.25 * np.roll(centre, 1, 0) + 0.5 * centre + 0.25 * np.roll(centre, -1, 0)
            outward = unit(np.roll(outward, 1, 0) + 2 * outward + np.roll(outward, -1, 0))
        along = unit(np.roll(centre, -1, 0) - np.roll(centre, 1, 0))
        across = unit(np.cross(along, outward))
        turn = np.arange(RIB_SIDES) * (2 * np.pi / RIB_SIDES)
        radial = (
            np.cos(turn)[None, :, None] * outward[:, None] * 0.75 + np.sin(turn)[None, :, None] * across[:, None]
        ).astype(np.float32)
        points = centre[:, None] + 0.35 * THICKNESS_M * outward[:, None] + RIB_M * radial
        return points.reshape(-1, 3), unit(radial).reshape(-1, 3)


def dress(materials: Materials, body: Body, look: Look, seed: int) -> Float32[np.ndarray, " n"]:
    """Turns the surface below the collar line into cloth.

    Returns:
        Where there is cloth, 0..1.
    """
    below = body.refinement.spread(_below_collar(body))
    cloth = smoothstep(-0.0012, 0.0012, below)
    place = body.refinement.spread(body.rest)
    weave = 1 + 0.05 * value_noise(place, 900, seed + 61) + 0.06 * fractal_noise(place, 60, seed + 62)
    color = linear(look.cloth) * weave[:, None]
    materials.albedo[:] = materials.albedo * (1 - cloth[:, None]) + color * cloth[:, None]
    for values, level in ((materials.shine, 0.25), (materials.gloss, 6.0), (materials.softness, 0.25)):
        values[:] = values * (1 - cloth) + level * cloth
    folds = fractal_noise(place * (1.0, 0.45, 1.0) + 0.4 * place[:, 1:2], 22, seed + 63)
    hang = smoothstep(0.0, 0.10, below)
    materials.carrier[cloth > 0.5] = JOINTS.index("root")
    materials.raise_m += THICKNESS_M * cloth + 0.0042 * folds * hang
    return cloth


def make_rib(body: Body, look: Look) -> Rib:
    """The rib along the collar line."""
    below = _below_collar(body)
    skin = np.isin(body.part[body.faces[:, 0]], [PARTS.index("skin"), TORSO])
    faces = body.faces[skin]
    sides = np.unique(np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2), 1), axis=0)
    ends = sides[(below[sides[:, 0]] < 0) != (below[sides[:, 1]] < 0)]
    value_a, value_b = below[ends[:, 0]], below[ends[:, 1]]
    share = value_a / (value_a - value_b)
    crossing = body.rest[ends[:, 0]] + share[:, None] * (body.rest[ends[:, 1]] - body.rest[ends[:, 0]])
    angle = np.arctan2(crossing[:, 0], crossing[:, 2] - CHEST_Z)
    order = np.argsort(angle)
    wanted = np.linspace(-np.pi, np.pi, RIB_POINTS, endpoint=False)
    nearest = order[np.searchsorted(angle[order], wanted).clip(max=len(order) - 1)]
    ring, side = np.arange(RIB_POINTS)[:, None], np.arange(RIB_SIDES)[None]
    next_ring, next_side = (ring + 1) % RIB_POINTS, (side + 1) % RIB_SIDES
    a, b = ring * RIB_SIDES + side, ring * RIB_SIDES + next_side
    c, d = next_ring * RIB_SIDES + side, next_ring * RIB_SIDES + next_side
    quads = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    return Rib(ends[nearest], share[nearest], quads, linear(look.cloth) * 0.82)


def _below_collar(body: Body) -> Float32[np.ndarray, " v"]:
    """Signed height under the collar line, m: positive where there is cloth."""
    place = body.rest
    edge_height = float(place[neck_loop(body.head), 1].mean())
    angle = np.arctan2(place[:, 0], place[:, 2] - CHEST_Z)
    front = 0.5 + 0.5 * np.cos(angle)
    line = edge_height + 0.034 - 0.042 * front
    head_part = np.isin(body.part, [PARTS.index("skin"), TORSO])
    return np.where(head_part, line - place[:, 1], -1.0).astype(np.float32)
