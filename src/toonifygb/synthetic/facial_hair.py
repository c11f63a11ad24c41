"""Brows and lashes: short strands rooted in the skin, which move with every expression."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb.geometry.sampling import sample_surface
from toonifygb.head import JOINTS, PARTS
from toonifygb.synthetic.look import linear
from toonifygb.synthetic.noise import smoothstep
from toonifygb.synthetic.refine import unit
from toonifygb.synthetic.strands import Strands

if TYPE_CHECKING:
    from jaxtyping import Float32, Int64

    from toonifygb.synthetic.body import Body, Pose
    from toonifygb.synthetic.look import Look
    from toonifygb.synthetic.paint import Materials

# MediaPipe's landmarks of the subject's right eye; the left ones are their mirrors.
BROW_TOP = (70, 63, 105, 66, 107)
BROW_BOTTOM = (46, 53, 52, 65, 55)
LID_TOP = (33, 246, 161, 160, 159, 158, 157, 173)
LID_BOTTOM = (33, 7, 163, 144, 145, 153, 154)
HAIRS_PER_BROW, HAIRS_PER_LID_TOP, HAIRS_PER_LID_BOTTOM = 520, 40, 18
POINTS_PER_HAIR = 5


@dataclass(frozen=True)
class FacialHair:
    """Hairs in the frames of their roots."""

    vertices: Int64[np.ndarray, "s 6"]
    """Coarse vertices that each root is a mix of."""
    weights: Float32[np.ndarray, "s 6"]
    local: Float32[np.ndarray, "s k 3"]
    """Points relative to the root along (side, up, normal), m; side is the head's x axis in the skin's plane."""
    width: Float32[np.ndarray, "s k"]
    albedo: Float32[np.ndarray, "s k 3"]

    def place(self, pose: Pose) -> Strands:
        """The hairs on a posed subject, world."""
        roots = np.einsum("sj,sjc->sc", self.weights, pose.vertices[self.vertices])
        side, up, normal = _frames(
            np.einsum("sj,sjc->sc", self.weights, pose.normals[self.vertices]),
            pose.joints[JOINTS.index("neck"), :3, 0],
        )
        points = roots[:, None] + sum(
            self.local[..., axis : axis + 1] * direction[:, None]
            for axis, direction in enumerate((side, up, normal))
        )
        outward = np.broadcast_to(normal[:, None], points.shape)
        return Strands(points, outward, self.width, self.albedo, np.full(self.width.shape, 0.9, np.float32))


def tint_brows(materials: Materials, body: Body, look: Look) -> None:
    """Darkens the skin under the brows, where single hairs are too fine to be drawn."""
    place = body.refinement.spread(body.canonical)
    for mirrored in (False, True):
        top, bottom = (_landmarks(body, ids, mirrored) for ids in (BROW_TOP, BROW_BOTTOM))
        weight = 0.55 * look.brow_fullness * _brow_mask(place, top, bottom, 1.0 if mirrored else -1.0)[:, None]
        brow = 0.5 * (linear(look.hair) + materials.albedo * 0.4)
        materials.albedo[:] = materials.albedo * (1 - weight) + brow * weight


def grow_facial_hair(body: Body, look: Look, seed: int) -> FacialHair:
    """Brows and lashes of a subject."""
    rng = np.random.Generator(np.random.Philox(seed + 2000))
    tufts = []
    for mirrored in (False, True):
        tufts.append(_brow(body, look, rng, mirrored, seed))
        tufts.append(_lashes(body, rng, mirrored, LID_TOP, HAIRS_PER_LID_TOP, 0.0068, 1.0))
        tufts.append(_lashes(body, rng, mirrored, LID_BOTTOM, HAIRS_PER_LID_BOTTOM, 0.0034, -1.0))
    return FacialHair(*(np.concatenate(fields) for fields in zip(*tufts, strict=True)))


def _brow(body: Body, look: Look, rng: np.random.Generator, mirrored: bool, seed: int) -> tuple[np.ndarray, ...]:
    """One brow: hairs rise at its inner end, lie along it in the middle and sink at its tail."""
    top, bottom = (_landmarks(body, ids, mirrored) for ids in (BROW_TOP, BROW_BOTTOM))
    sign = 1.0 if mirrored else -1.0
    inside = _brow_mask(body.canonical, top, bottom, sign) * (body.part == PARTS.index("skin"))
    faces = torch.from_numpy(body.faces)
    weight = torch.from_numpy(inside.astype(np.float32))[faces].mean(1)
    chosen = torch.nonzero(weight > 0.08)[:, 0]
    n = int(HAIRS_PER_BROW * look.brow_fullness)
    ids, bary = sample_surface(
        torch.from_numpy(body.canonical), faces[chosen], n, seed, weight[chosen].clamp_min(0.1)
    )
    corners = body.faces[chosen.numpy()[ids.numpy()]]
    place = np.einsum("sk,skc->sc", bary.float().numpy(), body.canonical[corners])
    span = np.abs(top[:, 0])
    along = ((np.abs(place[:, 0]) - span.min()) / (span.max() - span.min())).clip(0, 1)  # 0 inner end, 1 tail
    slope = np.interp(along, (0, 0.15, 0.6, 1.0), (1.25, 0.75, 0.15, -0.45)) + 0.22 * rng.standard_normal(n)
    length = np.interp(along, (0, 0.3, 1.0), (0.0044, 0.0058, 0.0042)) * (0.75 + 0.5 * rng.random(n))
    progress = np.linspace(0, 1, POINTS_PER_HAIR)[None]
    bend = slope[:, None] - 0.5 * progress  # hairs curve down towards their tips
    side = sign * np.cos(np.arctan(bend)) * length[:, None] * progress
    up = np.sin(np.arctan(bend)) * length[:, None] * progress
    lift = 0.0003 + 0.0007 * np.sin(np.pi * 0.75 * progress) * (0.6 + 0.8 * rng.random((n, 1)))
    local = np.stack([side, up, np.broadcast_to(lift, side.shape)], -1)
    width = 0.00036 * (1 - 0.7 * progress) * (0.7 + 0.6 * rng.random((n, 1)))
    tone = 0.62 * (0.8 + 0.4 * rng.random((n, 1, 1))) * np.ones((1, POINTS_PER_HAIR, 1))
    return _pack(corners, bary.float().numpy(), local, width, tone * linear(look.hair))


def _brow_mask(place: np.ndarray, top: np.ndarray, bottom: np.ndarray, sign: float) -> Float32[np.ndarray, " n"]:
    """Inside the band between two rows of landmarks, 0..1."""
    x = np.abs(place[:, 0])

    def height(row: np.ndarray) -> np.ndarray:
        order = np.argsort(np.abs(row[:, 0]))
        return np.interp(x, np.abs(row[order, 0]), row[order, 1])

    low, high = height(bottom), height(top)
    share = (place[:, 1] - low) / np.maximum(high - low, 1e-4)
    inner, outer = np.abs(top[:, 0]).min(), np.abs(top[:, 0]).max()
    within = smoothstep(inner - 0.002, inner + 0.003, x) * smoothstep(outer + 0.003, outer - 0.006, x)
    front = (place[:, 2] > 0.04) & (place[:, 0] * sign > 0)
    return within * smoothstep(-0.15, 0.25, share) * smoothstep(1.1, 0.6, share) * front


def _lashes(
    body: Body,
    rng: np.random.Generator,
    mirrored: bool,
    lid: tuple[int, ...],
    n: int,
    length_m: float,
    upward: float,
) -> tuple[np.ndarray, ...]:
    """Lashes of one lid: they leave forwards, fan out sideways and curl away from the eye."""
    ids = [int(body.head.landmark_mirror[i]) if mirrored else i for i in lid]
    stand = (np.linspace(0, len(ids) - 1, n) + rng.uniform(-0.05, 0.05, n)).clip(0, len(ids) - 1.001)
    first = stand.astype(int)
    share = (stand - first).astype(np.float32)[:, None]
    corners = body.head.faces[body.head.landmark_faces[ids]].numpy()
    bary = body.head.landmark_bary[ids].float().numpy()
    vertices = np.concatenate([corners[first], corners[first + 1]], 1)
    weights = np.concatenate([(1 - share) * bary[first], share * bary[first + 1]], 1)
    sign = 1.0 if mirrored else -1.0
    along = 1 - stand / (len(ids) - 1)  # 1 at the outer corner
    fan = sign * (1.35 * along - 0.45)
    progress = np.linspace(0, 1, POINTS_PER_HAIR)[None]
    reach = length_m * (0.8 + 0.4 * rng.random(n)) * np.interp(along, (0, 0.3, 1), (0.6, 1, 1))
    side = (0.55 * fan)[:, None] * progress
    up = np.broadcast_to(upward * (-0.16 * progress + 0.62 * progress**2), side.shape)
    forwards = np.broadcast_to(0.95 * progress - 0.25 * progress**2, side.shape)
    world = np.stack([side, up, forwards], -1) * reach[:, None, None]  # along the head's axes
    normal = unit(np.einsum("sj,sjc->sc", weights, body.rest_normals[vertices]))
    frame = np.stack(_frames(normal, np.array((1, 0, 0), np.float32)), 1)  # s 3 3: rows side, up, normal
    local = np.einsum("skc,sac->ska", world, frame)
    width = 0.00042 * (1 - 0.8 * progress) * np.ones((n, 1))
    albedo = np.full((n, POINTS_PER_HAIR, 3), 0.010)
    return _pack(vertices, weights, local, width, albedo)


def _pack(
    vertices: np.ndarray, weights: np.ndarray, local: np.ndarray, width: np.ndarray, albedo: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Fields of ``FacialHair``; three corners are padded to six."""
    pad = 6 - vertices.shape[1]
    return (
        np.pad(vertices, ((0, 0), (0, pad))),
        np.pad(weights, ((0, 0), (0, pad))).astype(np.float32),
        local.astype(np.float32),
        np.broadcast_to(width, local.shape[:2]).astype(np.float32),
        np.broadcast_to(albedo, local.shape).astype(np.float32),
    )


def _frames(normals: np.ndarray, head_x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Side, up and normal at each root, unit and orthogonal."""
    normal = unit(normals)
    up = unit(np.cross(normal, head_x))
    return np.cross(up, normal), up, normal


def _landmarks(body: Body, ids: tuple[int, ...], mirrored: bool) -> np.ndarray:
    """Canonical positions of landmarks or of their mirrors."""
    rows = [int(body.head.landmark_mirror[i]) if mirrored else i for i in ids]
    corners = body.head.faces[body.head.landmark_faces[rows]].numpy()
    return np.einsum("lk,lkc->lc", body.head.landmark_bary[rows].numpy(), body.canonical[corners])
