"""The subject's surface: the head model, continued into shoulders, and refined until vertices are pixel-sized."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb.geometry import meshes
from toonifygb.head import PARTS
from toonifygb.synthetic.refine import Refinement, refine, unit

if TYPE_CHECKING:
    from jaxtyping import Float32, Int64

    from toonifygb.head import HeadModel
    from toonifygb.structures import HeadMotion
    from toonifygb.synthetic.look import Look

TORSO = len(PARTS)
"""Part number of the shoulders, after those of the head model."""
CHEST_Z = -0.03
"""Depth of the body's axis in the head frame, m."""
SHOULDER_ROWS, CHEST_ROWS = 7, 7


@dataclass(frozen=True)
class Pose:
    """A posed subject, coarse mesh."""

    vertices: Float32[np.ndarray, "v 3"]
    """World, m."""
    normals: Float32[np.ndarray, "v 3"]
    joints: Float32[np.ndarray, "5 4 4"]
    """Rest → world of what hangs on each joint: clothes on the root, hair on the neck, which carries the skull."""


@dataclass(frozen=True)
class Body:
    """One identity's mesh: head vertices first, then the shoulders'."""

    head: HeadModel
    shape: torch.Tensor
    rest: Float32[np.ndarray, "v 3"]
    """Neutral and unposed, head frame, m."""
    rest_normals: Float32[np.ndarray, "v 3"]
    canonical: Float32[np.ndarray, "v 3"]
    """The same points on the mean identity: procedural colours are functions of these."""
    part: Int64[np.ndarray, " v"]
    faces: Int64[np.ndarray, "f 3"]
    refinement: Refinement

    def pose(self, motion: HeadMotion) -> Pose:
        """The coarse mesh under one frame's motion."""
        vertices, transforms = self.head.forward(self.shape, motion)
        transforms = transforms.clone()
        transforms[:, :3, 3] += motion.translation
        n_head = self.head.n_vertices
        torso = torch.from_numpy(self.rest[n_head:]) @ transforms[0, :3, :3].T + transforms[0, :3, 3]
        posed = torch.cat([vertices, torso])
        normals = meshes.vertex_normals(posed, torch.from_numpy(self.faces))
        return Pose(posed.numpy(), normals.numpy(), transforms.numpy())

    def region(self, name: str) -> Float32[np.ndarray, " v"]:
        """A region mask of the head model, 0 on the shoulders."""
        mask = self.head.regions[name].numpy().astype(np.float32)
        return np.concatenate([mask, np.zeros(len(self.rest) - len(mask), np.float32)])


def make_body(head: HeadModel, shape: torch.Tensor, look: Look) -> Body:
    """The mesh of one identity."""
    rest_head = head.rest(shape).numpy()
    template = head.template.numpy()
    loop = neck_loop(head)
    torso, torso_faces = _loft(rest_head, loop, head.n_vertices, look.shoulders)
    mean_torso, _ = _loft(template, loop, head.n_vertices, look.shoulders)
    rest = np.concatenate([rest_head, torso])
    part = np.concatenate([head.part.numpy(), np.full(len(torso), TORSO)])
    visible = head.faces.numpy()[_seen_faces(head)]
    faces = np.concatenate([visible, torso_faces])
    normals = meshes.vertex_normals(torch.from_numpy(rest), torch.from_numpy(faces)).numpy()
    face_part = part[faces[:, 0]]
    large = np.isin(face_part, [PARTS.index("skin"), PARTS.index("eye_left"), PARTS.index("eye_right"), TORSO])
    return Body(
        head,
        shape,
        rest,
        normals,
        np.concatenate([template, mean_torso]),
        part,
        faces,
        refine(faces, len(rest), large),
    )


def neck_loop(head: HeadModel) -> Int64[np.ndarray, " n"]:
    """Vertices of the neck's cut edge, in the direction of the faces' winding."""
    skin = head.faces.numpy()[(head.part[head.faces[:, 0]] == PARTS.index("skin")).numpy()]
    sides = np.concatenate([skin, np.roll(skin, -1, 1)], 1).reshape(-1, 2, 3).swapaxes(1, 2).reshape(-1, 2)
    size = head.n_vertices
    lone = ~np.isin(sides[:, 0] * size + sides[:, 1], sides[:, 1] * size + sides[:, 0])
    following = dict(sides[lone].tolist())
    low = min(following, key=lambda vertex: float(head.template[vertex, 1]))
    loop = [low]
    while following[loop[-1]] != low:
        loop.append(following[loop[-1]])
    return np.array(loop)


def _seen_faces(head: HeadModel) -> np.ndarray:
    """All faces but those of the eyeballs' back halves, which are never seen."""
    part = head.part.numpy()[head.faces.numpy()[:, 0]]
    depth = head.template.numpy()[head.faces.numpy(), 2].max(1)
    seen = np.ones(len(part), bool)
    for joint, name in ((3, "eye_left"), (4, "eye_right")):
        seen &= (part != PARTS.index(name)) | (depth > float(head.rest_joints[joint, 2]))
    return seen


def _loft(
    rest: Float32[np.ndarray, "v 3"], loop: Int64[np.ndarray, " n"], first: int, half_width: float
) -> tuple[Float32[np.ndarray, "m 3"], Int64[np.ndarray, "f 3"]]:
    """Shoulders and chest: rings from the neck's cut edge outwards over the shoulders and down.

    Args:
        rest: head vertices, m.
        loop: the cut edge.
        first: number that the first new vertex gets.
        half_width: of the shoulders, m.
    """
    edge = rest[loop]
    angle = np.arctan2(edge[:, 0], edge[:, 2] - CHEST_Z)
    side = np.abs(np.sin(angle))
    front = np.maximum(np.cos(angle), 0)

    def ring(width: float, depth: float, height: np.ndarray | float) -> np.ndarray:
        x = width * np.sign(np.sin(angle)) * side**0.8
        z = CHEST_Z + depth * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.8
        return np.stack([x, np.broadcast_to(height, x.shape), z], 1)

    base = float(edge[:, 1].mean())
    shoulder = ring(half_width, 0.088, base - 0.060 - 0.055 * front + 0.012 * side)
    chest = ring(half_width * 1.10, 0.112, base - 0.16)
    belly = ring(half_width * 1.06, 0.115, base - 0.34)
    outward = unit(np.stack([edge[:, 0], np.full(len(edge), -0.02), edge[:, 2] - CHEST_Z], 1))
    reach = np.linalg.norm(shoulder - edge, axis=1, keepdims=True)
    up = np.array([0.0, 0.035, 0.0])
    rows = [
        _bezier(edge, edge + 0.42 * reach * outward, shoulder + 0.8 * up, shoulder, t)
        for t in np.arange(1, SHOULDER_ROWS + 1) / SHOULDER_ROWS
    ]
    rows += [
        _bezier(shoulder, shoulder - up, chest + up, belly, t) for t in np.arange(1, CHEST_ROWS + 1) / CHEST_ROWS
    ]
    n = len(loop)
    ids = np.concatenate([loop[None], first + np.arange(len(rows) * n).reshape(-1, n)])
    a, b = ids, np.roll(ids, -1, 1)
    faces = np.concatenate(
        [
            np.stack([b[:-1], a[:-1], a[1:]], -1).reshape(-1, 3),
            np.stack([b[:-1], a[1:], b[1:]], -1).reshape(-1, 3),
        ]
    )
    return np.concatenate(rows).astype(np.float32), faces


def _bezier(p0: np.ndarray, p1: np.ndarray, p2: np.ndarray, p3: np.ndarray, t: float) -> np.ndarray:
    """Point at ``t`` of the cubic curves with these control points."""
    s = 1 - t
    return s**3 * p0 + 3 * s * s * t * p1 + 3 * s * t * t * p2 + t**3 * p3
