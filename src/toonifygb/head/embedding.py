"""What a bare rig lacks, taken from the open head: landmarks, regions, lids.

The open head is registered onto the rig's skin; then each of its landmarks has a nearest point there, and each of
the rig's vertices one on the open head. No file of anybody's landmarks is needed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.closest import Surface, closest_on_triangle
from toonifygb.geometry.meshes import barycentric, vertex_normals
from toonifygb.head.base import JOINTS, PARTS
from toonifygb.head.registration import REACH, Registration, register
from toonifygb.progress import SILENT

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from toonifygb.head.base import HeadModel
    from toonifygb.progress import Progress

N_SKIN = 468
"""Landmarks of the skin; behind them five of the right iris, then five of the left."""
IRISES = {"eye_right": slice(468, 473), "eye_left": slice(473, 478)}
LID_PAIRS = {
    "left": ((386, 374), (385, 380), (387, 373)),
    "right": ((159, 145), (158, 153), (160, 144)),
}
"""Landmarks on the margins of upper and lower lid, in the order of the columns of ``eyelid_basis``."""
CLOSURE_RANGE = (0.6, 1.6)
"""Bounds of the factor that makes the other head's lids meet on this one."""
FAR = 0.02
"""A vertex further than this from the registered head belongs to no region, m."""


def eyeballs(skin_weights: Float[Tensor, "v 5"]) -> Int[Tensor, " v"]:
    """``HeadModel.part`` of a rig of skin and eyeballs: an eyeball follows its eye's joint alone."""
    part = torch.zeros(len(skin_weights), dtype=torch.int64)
    for name in ("eye_left", "eye_right"):
        part[skin_weights[:, JOINTS.index(name)] > 0.5] = PARTS.index(name)
    return part


def furnish(rig: HeadModel, known: HeadModel, *, progress: Progress = SILENT) -> tuple[HeadModel, Registration]:
    """The rig with landmarks, regions and, where it has none, lids.

    Args:
        rig: a head with ``part``, float32.
        known: the head that has them, float32.
        progress: told while the known head is brought onto the rig.

    Returns:
        The furnished rig, and how the known head lies on it.
    """
    skin = _skin(rig)
    registration = register(known, rig, skin, progress=progress)
    vertices = registration.vertices.float()
    landmarks = _landmarks(rig, known, skin, vertices, registration)
    face_ids, mix, near = _on_known(rig, known, vertices)
    regions = {}
    for name, mask in known.regions.items():
        value = barycentric(mask[:, None], known.faces, face_ids, mix)[:, 0]
        regions[name] = torch.where(near & (rig.part == 0), value, 0.0)
    furnished = replace(rig, regions=regions, **landmarks)
    if rig.eyelid_basis is not None or known.eyelid_basis is None:
        return furnished, registration
    lids = barycentric(known.eyelid_basis.flatten(1), known.faces, face_ids, mix).unflatten(-1, (3, 2))
    lids = torch.einsum("ab,vbk->vak", registration.turn.float(), lids) * (near & (rig.part == 0))[:, None, None]
    return _closing(replace(furnished, eyelid_basis=lids)), registration


def _skin(head: HeadModel) -> Surface:
    return Surface(head.template, head.faces[(head.part[head.faces] == 0).all(-1)], REACH)


def _landmarks(
    rig: HeadModel, known: HeadModel, skin: Surface, vertices: Float[Tensor, "v 3"], registration: Registration
) -> dict[str, Tensor]:
    """The landmark fields of the rig."""
    corners, bary = known.landmark_faces[:N_SKIN], known.landmark_bary[:N_SKIN]
    points = barycentric(vertices, known.faces, corners, bary)
    normals = barycentric(vertex_normals(vertices, known.faces), known.faces, corners, bary)
    local, mix = skin.closest(points, torch.nn.functional.normalize(normals, dim=-1))
    faces = [_numbers(rig, 0)[local]]
    mixes = [mix]
    placed = barycentric(known.template, known.faces, known.landmark_faces, known.landmark_bary)
    turn = registration.turn.float()
    for name, columns in IRISES.items():
        joint = JOINTS.index(name)
        away = (placed[columns] - known.rest_joints[joint]) @ turn.T
        face_ids, mix = _on_ball(rig, PARTS.index(name), rig.rest_joints[joint], away)
        faces.append(face_ids)
        mixes.append(mix)
    return {
        "landmark_faces": torch.cat(faces),
        "landmark_bary": torch.cat(mixes),
        "landmark_offset": known.landmark_offset @ turn.T,
        "landmark_sigma": float(torch.linalg.det(turn)) ** (1 / 3) * known.landmark_sigma,
        "landmark_mirror": known.landmark_mirror,
    }


def _numbers(rig: HeadModel, part: int) -> Int[Tensor, " k"]:
    """Numbers of a part's faces in the whole rig."""
    return (rig.part[rig.faces] == part).all(-1).nonzero()[:, 0]


def _on_ball(
    rig: HeadModel, part: int, centre: Float[Tensor, " 3"], away: Float[Tensor, "n 3"]
) -> tuple[Int[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Points of an eyeball as far to the side as the given ones, whatever the size of either ball.

    An iris is as wide in every head; what varies is the ball it sits on, so sideways distances are kept and depth
    is the ball's own.
    """
    numbers = _numbers(rig, part)
    corners = rig.template[rig.faces[numbers]]
    radius = (corners - centre).norm(dim=-1).amax()
    side = away[:, :2]
    depth = (radius.square() - side.square().sum(-1)).clamp_min(0.25 * radius.square()).sqrt()
    points = centre + torch.cat([side, depth[:, None]], -1)
    mix = closest_on_triangle(points[:, None].expand(-1, len(corners), -1), corners)
    apart = (torch.einsum("nkc,kcx->nkx", mix, corners) - points[:, None]).square().sum(-1)
    best = apart.argmin(-1)
    return numbers[best], mix[torch.arange(len(points)), best]


def _on_known(
    rig: HeadModel, known: HeadModel, vertices: Float[Tensor, "v 3"]
) -> tuple[Int[Tensor, " v"], Float[Tensor, "v 3"], Tensor]:
    """Where each of the rig's vertices lies on the registered head: face, barycentrics, and whether near enough."""
    skin_faces = (known.part[known.faces] == 0).all(-1).nonzero()[:, 0]
    surface = Surface(vertices, known.faces[skin_faces], REACH)
    normals = vertex_normals(rig.template, rig.faces)
    local, mix = surface.closest(rig.template, normals)
    near = (surface.at(local, mix) - rig.template).norm(dim=-1) < FAR
    return skin_faces[local], mix, near


def _closing(rig: HeadModel) -> HeadModel:
    """The rig with its lids' travel scaled so that at 1 their margins just meet."""
    assert rig.eyelid_basis is not None, "the rig has no lids to close"
    points = rig.landmarks()
    assert points.eyelid_basis is not None, "landmarks lost the lids of their rig"
    factors = []
    for column, pairs in enumerate(LID_PAIRS.values()):
        upper, lower = torch.tensor(pairs).T
        gap = points.template[upper] - points.template[lower]
        travel = points.eyelid_basis[upper, :, column] - points.eyelid_basis[lower, :, column]
        along = torch.nn.functional.normalize(gap, dim=-1)
        factor = (gap * along).sum() / -(travel * along).sum().clamp_max(-1e-6)
        factors.append(float(factor.clamp(*CLOSURE_RANGE)))
    return replace(rig, eyelid_basis=rig.eyelid_basis * torch.tensor(factors))
