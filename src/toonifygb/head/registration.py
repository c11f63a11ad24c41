"""One head's surface brought onto another's, whatever the other's topology.

Three steps, each of which starts where the last one ended: a similarity from the eyeballs' centres; the
similarity and the identity coefficients of the moving head together; smooth displacements on top, drawn from
Gaussian processes of two sizes (as in Gaussian process morphable models). The last two match nearest points again
and again. Points slide freely along the other surface: only their distance from its tangent planes is held tightly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.errors import InputError
from toonifygb.geometry.closest import Surface
from toonifygb.geometry.meshes import vertex_normals
from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.progress import SILENT

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from toonifygb.head.base import HeadModel
    from toonifygb.progress import Progress

JAW, EYES = 2, (3, 4)
"""Joints: the jaw's, and those at the centres of the eyeballs."""
REACH = 0.008
"""What opposite normals are worth when the nearest point is sought, m: about the thickness of a lip."""
TANGENT_SIGMA, SLIDING_SIGMA = 0.3e-3, 5e-3
"""Trust in a match across and along the other surface, m."""
EYE_SIGMA, MARK_SIGMA, LIPS_SIGMA = 1e-3, 2e-3, 2e-2
"""Trust in the centres of the eyeballs, in nose and mouth, and in the mouth's place along the lips, m. Without
these a face that is longer or shorter than expected settles with its nose on the other's lip."""
MARKS_SHARE = 10
"""One of these marks weighs as much as so many matches in a hundred."""
NOSE_RANGE = (0.2, 1.5)
"""How far below the eyes the tip of the nose is sought, in distances between the eyes."""
TIP = 0.004
"""Size of the tip of a nose, m."""
SEAM = 0.006
"""Vertices of the jaw and of the skull that are nearer than this are the two lips, m."""
ROUNDS = 15
COARSE = 3
"""Of so many vertices one is matched while the identity is sought."""
FIRST_GATE, LAST_GATE = 0.03, 0.005
"""Matches further off than this do not count, in the first and in the last round, m."""
FACING = 0.5
"""Least cosine between the normals of a match."""
IDENTITY_WEIGHT = 0.3
"""Weight of the identity prior N(0, 1) against a match at one sigma, per hundred matches."""
WARPS = ((0.045, 0.004, 60), (0.016, 0.0015, 220))
"""Smooth displacements: reach, size (both m) and number of centres."""
WARP_ROUNDS = 8
LEAST_WEIGHT = {"inside_mouth": 0.0, "eye_cavity": 0.0, "neck": 0.1, "scalp": 0.3, "ears": 0.3}
"""Say of the regions that other heads may lack or have elsewhere, relative to the face's."""


@dataclass(frozen=True)
class Registration:
    """The moving head on the other."""

    vertices: Float[Tensor, "v 3"]
    """All of the moving head's vertices, where the other head has them, m."""
    turn: Float[Tensor, "3 3"]
    """Scale times rotation of the similarity, for directions and displacements."""
    distance: Float[Tensor, " k"]
    """Between the matched points of the face and the other surface, m."""


def register(moving: HeadModel, other: HeadModel, still: Surface, *, progress: Progress = SILENT) -> Registration:
    """Brings a head onto a surface.

    Args:
        moving: a head with regions; its skin is matched.
        other: a head with eyes and a jaw; y up, z out of the face to within some 30 degrees.
        still: its skin.
        progress: told after every round.

    Raises:
        InputError: the other head has no mouth.
    """
    moving, other = moving.to(torch.float64), other.to(torch.float64)
    shape, frame = _fit_identity(moving, other, _Matcher(moving, still, COARSE), progress)
    match = _Matcher(moving, still)
    placed = frame.apply(moving.rest(shape))
    warped = _warp(match, placed, progress)
    weights, _, planes, _ = match(warped, LAST_GATE)
    distance = planes[weights > 0].abs()
    return Registration(warped, frame.scale * frame.rotation, distance)


@dataclass(frozen=True)
class _Frame:
    """A similarity x ↦ s R x + t."""

    scale: float
    rotation: Float[Tensor, "3 3"]
    shift: Float[Tensor, " 3"]

    def apply(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """The points, moved."""
        return self.scale * points @ self.rotation.T + self.shift

    def moved(self, step: Float[Tensor, " 7"]) -> _Frame:
        """After a rotation vector, a shift and a change of the logarithm of the scale, about the shift."""
        turn = axis_angle_to_matrix(step[:3])
        return _Frame(self.scale * float(step[6].exp()), turn @ self.rotation, self.shift + step[3:6])

    @classmethod
    def from_eyes(cls, own: Float[Tensor, "2 3"], other: Float[Tensor, "2 3"]) -> _Frame:
        """The similarity that carries eyes to eyes and turns the head no more than that needs."""
        axis, goal = own[0] - own[1], other[0] - other[1]
        scale = float(goal.norm() / axis.norm())
        cross = torch.linalg.cross(axis / axis.norm(), goal / goal.norm())
        rotation = axis_angle_to_matrix(cross)
        return cls(scale, rotation, other.mean(0) - scale * rotation @ own.mean(0))


class _Matcher:
    """Nearest points on the still surface for the moving head's skin."""

    def __init__(self, moving: HeadModel, still: Surface, every: int = 1) -> None:
        skin = moving.part == 0
        self.faces = moving.faces[skin[moving.faces].all(-1)]
        self.ids = self.faces.unique()[::every]
        weights = torch.ones_like(moving.template[:, 0])
        for name, least in LEAST_WEIGHT.items():
            if name in moving.regions:
                weights = weights.minimum(1 - (1 - least) * moving.regions[name])
        self.ids = self.ids[weights[self.ids] > 0]
        self._weights = weights
        self._still = still
        self._edge = _boundary(still)

    def __call__(
        self, vertices: Float[Tensor, "v 3"], gate: float
    ) -> tuple[Float[Tensor, " k"], Float[Tensor, "k 3"], Float[Tensor, " k"], Float[Tensor, "k 3"]]:
        """Weight, the matched surface's normal, distance from its plane, and offset, of each skin vertex."""
        points = vertices[self.ids]
        normals = vertex_normals(vertices, self.faces)[self.ids]
        face_ids, mix = self._still.closest(points.float(), normals.float())
        planes = self._still.face_normals[face_ids].double()
        offset = points - self._still.at(face_ids, mix).double()
        apart = offset.norm(dim=-1)
        # Where the other surface ends, nearest points pile up on its edge and mean nothing.
        inner = (self._edge[self._still.faces[face_ids]] * mix).sum(-1) < 0.5
        facing = (planes * normals).sum(-1) > FACING
        weights = self._weights[self.ids] * (1 - (apart / gate).square()).clamp_min(0).square() * inner * facing
        return weights, planes, (offset * planes).sum(-1), offset


def _marks(head: HeadModel) -> tuple[Int[Tensor, " m"], Int[Tensor, " k"]]:
    """Numbers of the vertices at the tip of the nose and at the middle of the mouth of a head looking along +z.

    The nose stands out most below the eyes. The mouth is where skin that follows the jaw is next to skin that does
    not: everywhere else one passes into the other over centimetres.
    """
    eyes = head.rest_joints[list(EYES)]
    unit = (eyes[0] - eyes[1]).norm()
    apart = (head.template - eyes.mean(0)) / unit
    low, high = NOSE_RANGE
    skin = (head.part == 0) & (apart[:, 0].abs() < 0.5) & (apart[:, 1] < -low) & (apart[:, 1] > -high)
    points = torch.where(skin[:, None], head.template, -torch.inf)
    nose = (head.template - head.template[points[:, 2].argmax()]).norm(dim=-1) < TIP
    jaw = head.skin_weights[:, JAW]
    front = (head.part == 0) & (apart[:, 0].abs() < 0.15) & (apart[:, 2] > 0)
    upper, lower = (front & (jaw < 0.3)).nonzero()[:, 0], (front & (jaw > 0.7)).nonzero()[:, 0]
    close = torch.cdist(head.template[upper], head.template[lower]) < SEAM
    lips = torch.cat([upper[close.any(1)], lower[close.any(0)]])
    if len(lips) == 0:
        raise InputError(
            f"the head model {head.name} has no mouth: its jaw is joined to its skull",
            "use a model of the FLAME family as its authors publish it",
        )
    depth = head.template[lips, 2]
    return nose.nonzero()[:, 0], lips[depth > depth.amax() - SEAM]


def _boundary(surface: Surface) -> Float[Tensor, " v"]:
    """1 at vertices on the edge of an open surface."""
    edges = (
        torch.cat([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]]).sort(-1).values
    )
    found, counts = edges.unique(dim=0, return_counts=True)
    mask = torch.zeros(len(surface.vertices))
    mask[found[counts == 1].flatten()] = 1
    return mask


def _fit_identity(
    moving: HeadModel, other: HeadModel, match: _Matcher, progress: Progress
) -> tuple[Float[Tensor, " s"], _Frame]:
    """Identity coefficients and similarity under which the head lies on the surface."""
    n_shape = moving.n_shape
    shape = torch.zeros(n_shape, dtype=torch.float64)
    own = list(EYES)
    frame = _Frame.from_eyes(moving.rest_joints[own], other.rest_joints[own])
    ids = _marks(moving)
    goals = torch.cat([other.rest_joints[own], *(other.template[near].mean(0)[None] for near in _marks(other))])
    # Where along the lips their middle is, the marks do not know.
    sigma = torch.tensor([EYE_SIGMA] * 6 + [MARK_SIGMA] * 3 + [LIPS_SIGMA, MARK_SIGMA, MARK_SIGMA]).double()
    trust = sigma.pow(-2) * len(match.ids) / 100 * MARKS_SHARE
    basis = moving.shape_basis[match.ids]
    mark_basis = torch.cat(
        [moving.joint_shape_basis[own], *(moving.shape_basis[near].mean(0)[None] for near in ids)]
    )
    for step in range(ROUNDS):
        gate = FIRST_GATE * (LAST_GATE / FIRST_GATE) ** (step / (ROUNDS - 1))
        vertices = frame.apply(moving.rest(shape))
        weights, planes, distance, offset = match(vertices, gate)
        scaled = frame.scale * frame.rotation
        levers = _levers(vertices[match.ids] - frame.shift, torch.einsum("ab,nbs->nas", scaled, basis))
        marks = torch.cat([frame.apply(moving.joints(shape)[own]), *(vertices[near].mean(0)[None] for near in ids)])
        mark_levers = _levers(marks - frame.shift, torch.einsum("ab,nbs->nas", scaled, mark_basis))
        system = torch.zeros(7 + n_shape, 7 + n_shape, dtype=torch.float64)
        right = torch.zeros(7 + n_shape, dtype=torch.float64)
        across = torch.einsum("na,nap->np", planes, levers)
        for rows, rest, weight in (
            (across, distance, weights / TANGENT_SIGMA**2),
            (levers.flatten(0, 1), offset.flatten(), weights.repeat_interleave(3) / SLIDING_SIGMA**2),
            (mark_levers.flatten(0, 1), (marks - goals).flatten(), trust),
        ):
            weighed = rows * weight[:, None]
            system += weighed.T @ rows
            right += weighed.T @ rest
        prior = IDENTITY_WEIGHT * float(weights.sum())
        system[7:, 7:] += prior * torch.eye(n_shape)
        right[7:] += prior * shape
        change = -torch.linalg.solve(system, right)
        frame, shape = frame.moved(change[:7]), shape + change[7:]
        progress.update(step + 1, ROUNDS + WARP_ROUNDS)
    return shape, frame


def _levers(arms: Float[Tensor, "n 3"], basis: Float[Tensor, "n 3 s"]) -> Float[Tensor, "n 3 p"]:
    """Derivatives of positions by rotation, shift, log scale and identity."""
    identity = torch.eye(3, dtype=arms.dtype).expand(len(arms), 3, 3)
    turn = torch.linalg.cross(identity, arms[:, None].expand(-1, 3, -1), dim=-1)
    return torch.cat([turn.mT, identity, arms[..., None], basis], -1)


def _warp(match: _Matcher, placed: Float[Tensor, "v 3"], progress: Progress) -> Float[Tensor, "v 3"]:
    """The placed head with smooth displacements that bring it onto the surface."""
    features = torch.cat([_process(placed, match.ids, *warp) for warp in WARPS], -1)
    n_features = features.shape[1]
    here = features[match.ids]
    drawn = torch.zeros(n_features, 3, dtype=torch.float64)
    for step in range(WARP_ROUNDS):
        gate = 2 * LAST_GATE if step < WARP_ROUNDS // 2 else LAST_GATE
        weights, planes, distance, offset = match(placed + features @ drawn, gate)
        rows = torch.einsum("nf,na->nfa", here, planes).flatten(1)
        tight = weights / TANGENT_SIGMA**2
        # Half the digits suffice for the matrix of a step, and take half the time.
        half = (rows * tight.sqrt()[:, None]).float()
        system = (half.T @ half).double()
        loose = weights / SLIDING_SIGMA**2
        sliding = (here * loose[:, None]).T @ here
        system += torch.kron(sliding, torch.eye(3, dtype=torch.float64))
        system += torch.eye(3 * n_features)
        right = (rows * (tight * distance)[:, None]).sum(0)
        right += (here.T @ (offset * loose[:, None])).flatten() + drawn.flatten()
        drawn = drawn - torch.linalg.solve(system, right).view(-1, 3)
        progress.update(ROUNDS + step + 1, ROUNDS + WARP_ROUNDS)
    return placed + features @ drawn


def _process(
    points: Float[Tensor, "v 3"], among: Int[Tensor, " k"], reach: float, size: float, count: int
) -> Float[Tensor, "v m"]:
    """Values at the points of m independent unit parts of a Gaussian process with a Gaussian kernel."""
    centres = points[among][_spread(points[among], count)]

    def kernel(a: Tensor, b: Tensor) -> Tensor:
        return size**2 * torch.exp(-torch.cdist(a, b).square() / (2 * reach**2))

    own = kernel(centres, centres)
    factor = torch.linalg.cholesky(own + 1e-6 * size**2 * torch.eye(len(centres)))
    return torch.linalg.solve_triangular(factor, kernel(points, centres).T, upper=False).T


def _spread(points: Float[Tensor, "n 3"], count: int) -> Int[Tensor, " m"]:
    """Numbers of points far from each other, each the farthest from those before it."""
    chosen = [int(points[:, 2].argmax())]
    nearest = (points - points[chosen[0]]).square().sum(-1)
    for _ in range(min(count, len(points)) - 1):
        chosen.append(int(nearest.argmax()))
        nearest = nearest.minimum((points - points[chosen[-1]]).square().sum(-1))
    return torch.tensor(chosen)
