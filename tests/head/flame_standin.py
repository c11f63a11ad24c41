"""Heads like FLAME, made from the open head: its skin and eyeballs warped, turned, and meshed otherwise.

Nobody's model is needed: the truth is known because the warp is. Vertices are merged along random edges and split
along others, so that no vertex of the stand-in has a counterpart in the open head's mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from toonifygb import head
from toonifygb.geometry.meshes import barycentric
from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.head import JOINTS, PARTS, HeadModel
from toonifygb.head.open_head import FACE_MODES


@dataclass(frozen=True)
class StandIn:
    """A FLAME-like model and what is true of it."""

    template: torch.Tensor
    faces: torch.Tensor
    rest_joints: torch.Tensor
    skin_weights: torch.Tensor
    landmarks: torch.Tensor
    """Where the open head's landmarks went, without their offsets, m."""
    open_points: torch.Tensor
    """Every vertex's place on the unwarped open head of the same person."""


def stand_in(seed: int = 0, *, warp: float = 0.004, identity: float = 0.7, turn: float = 0.06) -> StandIn:
    """A FLAME-like head.

    Args:
        seed: of everything random.
        warp: size of the smooth displacement that no identity of the open head explains, m.
        identity: standard deviation of the identity coefficients.
        turn: rotation against the open head's axes, rad.
    """
    random = torch.Generator().manual_seed(seed)
    known = head.load("open")
    shape = torch.zeros(known.n_shape)
    shape[:FACE_MODES] = identity * torch.randn(FACE_MODES, generator=random)
    person = known.rest(shape)
    kept = [PARTS.index(name) for name in ("skin", "eye_left", "eye_right")]
    faces = known.faces[torch.isin(known.part[known.faces[:, 0]], torch.tensor(kept))]
    hidden = known.regions["inside_mouth"] + known.regions["eye_cavity"] > 1.5
    faces = faces[~hidden[faces].all(-1)]
    points, weights, faces = remeshed(person, known.skin_weights, faces, random)
    move = _warping(random, warp, turn)
    marks = barycentric(person, known.faces, known.landmark_faces, known.landmark_bary)
    return StandIn(
        template=move(points),
        faces=faces,
        rest_joints=move(known.joints(shape)),
        skin_weights=weights / weights.sum(-1, keepdim=True),
        landmarks=move(marks),
        open_points=points,
    )


def _warping(random: torch.Generator, size: float, turn: float):
    """A smooth displacement with some six waves through the head, then a similarity."""
    waves = 2 * torch.pi / 0.12 * torch.randn(6, 3, generator=random) / 3**0.5
    phase = 2 * torch.pi * torch.rand(6, generator=random)
    push = size * torch.randn(6, 3, generator=random) / 3**0.5
    stretch = 1 + 0.04 * torch.randn(3, generator=random)
    rotation = axis_angle_to_matrix(turn * torch.randn(3, generator=random) / 3**0.5)
    shift = torch.tensor([0.01, -0.05, 0.02])

    def move(points: torch.Tensor) -> torch.Tensor:
        bent = points + torch.sin(points @ waves.T + phase) @ push
        return 1.05 * (bent * stretch) @ rotation.T + shift

    return move


def remeshed(
    points: torch.Tensor, weights: torch.Tensor, faces: torch.Tensor, random: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Another mesh of nearly the same surface: a third of the faces split at a random inner point, the longest
    edges at their middles, then vertices joined along short edges."""
    chosen = torch.rand(len(faces), generator=random) < 0.25
    mix = 0.3 + torch.rand(int(chosen.sum()), 3, generator=random)
    mix = mix / mix.sum(-1, keepdim=True)
    points, weights, faces = _with_points(points, weights, faces, chosen, mix)
    for _ in range(4):
        points, weights, faces = _collapsed(points, weights, faces, random)
    used = faces.unique()
    new = torch.full((len(points),), -1)
    new[used] = torch.arange(len(used))
    return points[used], weights[used], new[faces]


def _with_points(points, weights, faces, chosen, mix):
    split = faces[chosen]
    fresh = len(points) + torch.arange(len(split))
    both = torch.cat([points, weights], 1)
    inner = (both[split] * mix[..., None]).sum(1)
    both = torch.cat([both, inner])
    a, b, c = split.T
    parts = [torch.stack(corners, -1) for corners in ((a, b, fresh), (b, c, fresh), (c, a, fresh))]
    return both[:, :3], both[:, 3:], torch.cat([faces[~chosen], *parts])


def _collapsed(points, weights, faces, random):
    """Independent short edges joined to one of their ends, where the surface stays a surface."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(-1).values
    edges, counts = edges.unique(dim=0, return_counts=True)
    outer = torch.zeros(len(points), dtype=torch.bool)
    outer[edges[counts == 1].flatten()] = True
    neighbours: dict[int, set[int]] = {}
    for a, b in edges.tolist():
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    length = (points[edges[:, 0]] - points[edges[:, 1]]).norm(dim=-1)
    order = (length * (0.5 + torch.rand(len(edges), generator=random))).argsort()[: len(edges) // 2]
    target = torch.arange(len(points))
    busy: set[int] = set()
    for a, b in edges[order].tolist():
        if outer[a] or outer[b] or len(neighbours[a] & neighbours[b]) != 2:
            continue
        around = neighbours[a] | neighbours[b]
        if around & busy:
            continue
        busy |= around
        target[b] = a
    faces = target[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return points, weights, faces[whole]


def rig(made: StandIn) -> HeadModel:
    """The stand-in as a bare head model with four random expressions."""
    from toonifygb.head.embedding import eyeballs

    n = len(made.template)
    random = torch.Generator().manual_seed(1)
    model = head.from_arrays(
        made.template,
        made.faces,
        1e-3 * torch.randn(n, 3, 5, generator=random),
        1e-3 * torch.randn(n, 3, 4, generator=random),
        torch.zeros(36, n, 3),
        regressor(made),
        made.skin_weights,
        part=eyeballs(made.skin_weights),
    )
    return model


def regressor(made: StandIn) -> torch.Tensor:
    """Weights of a few vertices each, under which the joints are where they should be."""
    n = len(made.template)
    matrix = torch.zeros(len(JOINTS), n)
    for joint, place in enumerate(made.rest_joints):
        near = (made.template - place).norm(dim=-1).topk(40, largest=False).indices
        system = torch.cat([made.template[near].T, torch.ones(1, 40)]).double()
        goal = torch.cat([place, torch.ones(1)]).double()
        matrix[joint, near] = (torch.linalg.pinv(system) @ goal).float()
    return matrix
