"""One frame: pose, light and draw a subject in front of its room."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb.head import JOINTS, PARTS
from toonifygb.render.mesh import interpolated_means, rasterize_mesh, supersampled
from toonifygb.synthetic import light
from toonifygb.synthetic.refine import unit

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Bool, Float32, Int64, UInt8

    from toonifygb.structures import Camera, HeadMotion
    from toonifygb.synthetic.body import Pose
    from toonifygb.synthetic.strands import Strands
    from toonifygb.synthetic.subject import Subject

SUPERSAMPLE = 2
EYE_KEY_SEEN = 0.6
"""Share of the key lamp on the eyes: the shadow map is too coarse for the lids, whose shade is painted instead."""
HAIR_LIT_PER_POINT = 3
"""Every so many points of a hair ask for their own shadow."""
SKULL = JOINTS.index("neck")
HIDDEN_COSINE = -0.3
"""Vertices turned away from the camera by more than this stay black; what has only such ones is not drawn."""


@dataclass(frozen=True)
class SyntheticFrame:
    """A picture and what is known about it."""

    image: UInt8[np.ndarray, "h w 3"]
    person: Float32[np.ndarray, "h w"]
    """Share of each pixel that the person covers, 0..1."""
    head: Float32[np.ndarray, "h w"]
    """The same for the person without clothes: skin, hair, eyes, mouth."""


@dataclass(frozen=True)
class _Layer:
    """A mesh, ready to be drawn."""

    vertices: Float32[np.ndarray, "n 3"]
    faces: Int64[np.ndarray, "f 3"]
    is_head: Float32[np.ndarray, " n"]
    color: Callable[[Int64[np.ndarray, " k"]], Float32[np.ndarray, "k 3"]]
    """sRGB 0..1 of some vertices; only those are lit that a pixel sees, a third of all."""


def draw(
    subject: Subject,
    motion: HeadMotion,
    camera: Camera,
    room: Float32[np.ndarray, "h w 3"],
    *,
    threads: int | None = None,
) -> SyntheticFrame:
    """Picture of one frame.

    Args:
        subject: who.
        motion: of one frame, no batch axis.
        camera: at the world's origin, looking along -z (``tracked_camera``).
        room: sRGB 0..1.
        threads: of the native rasteriser; the picture does not depend on it.
    """
    pose = subject.body.pose(motion)
    shadows = light.cast_shadows(*_shadow_casters(subject, pose), light.KEY.direction, threads=threads)
    layers = [_skin(subject, pose, shadows), *_hairs(subject, pose, shadows), _rib(subject, pose)]
    return _compose(layers, camera, room, threads)


def _shadow_casters(subject: Subject, pose: Pose) -> tuple[Float32[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]:
    """The coarse mesh with cloth and the body of the hair on it."""
    raised = subject.materials.raise_m[: len(pose.vertices), None]  # coarse vertices come first among the fine ones
    return pose.vertices + raised * pose.normals, subject.body.faces


def _skin(subject: Subject, pose: Pose, shadows: light.ShadowMap) -> _Layer:
    """Head and shoulders with clothes and the body of the hair."""
    refinement, materials = subject.body.refinement, subject.materials
    positions, normals = refinement.curve(pose.vertices, pose.normals)
    positions = positions + materials.raise_m[:, None] * normals
    views = -unit(positions)
    turned_away = np.einsum("ni,ni->n", normals, views) < HIDDEN_COSINE
    key_seen = shadows.visibility(pose.vertices, pose.normals)
    is_eye = np.isin(subject.body.part, [PARTS.index("eye_left"), PARTS.index("eye_right")])
    key_seen = np.where(is_eye, EYE_KEY_SEEN, key_seen)
    light_seen = refinement.spread(np.stack([subject.open_sky, key_seen], 1))

    def color(ids: Int64[np.ndarray, " k"]) -> Float32[np.ndarray, "k 3"]:
        bump = np.einsum("nij,nj->ni", pose.joints[materials.carrier[ids], :3, :3], materials.bump[ids])
        surface = light.Surface(unit(normals[ids] + bump), views[ids], *light_seen[ids].T)
        lit = light.display(light.shade(surface, *(values[ids] for values in materials.optics())))
        return np.where(turned_away[ids, None], 0, lit)

    return _Layer(positions, refinement.faces[~turned_away[refinement.faces].all(1)], 1 - subject.cloth, color)


def _hairs(subject: Subject, pose: Pose, shadows: light.ShadowMap) -> list[_Layer]:
    """Strands of the head's hair, and brows and lashes."""
    head_hair = subject.hair.moved(pose.joints[SKULL]).facing(HIDDEN_COSINE)
    return [_ribbons(head_hair, shadows), _ribbons(subject.facial_hair.place(pose), shadows)]


def _ribbons(strands: Strands, shadows: light.ShadowMap) -> _Layer:
    """Strands as they are seen by the camera."""
    vertices, faces = strands.ribbons()
    per_strand = len(vertices) // len(strands.width)

    def color(ids: Int64[np.ndarray, " k"]) -> Float32[np.ndarray, "k 3"]:
        hairs, number = np.unique(ids // per_strand, return_inverse=True)
        return _hair_color(strands.chosen(hairs), shadows)[number, ids % per_strand // 2]

    return _Layer(vertices, faces, np.ones(len(vertices), np.float32), color)


def _hair_color(strands: Strands, shadows: light.ShadowMap) -> Float32[np.ndarray, "s k 3"]:
    """Colour of every point, sRGB 0..1."""
    n_strands, n_points = strands.width.shape
    asked = np.arange(0, n_points + HAIR_LIT_PER_POINT - 1, HAIR_LIT_PER_POINT).clip(max=n_points - 1)
    points, outward = (values[:, asked].reshape(-1, 3) for values in (strands.points, strands.outward))
    seen = shadows.visibility(points, outward, taps=2).reshape(n_strands, -1)
    between = np.stack([np.interp(np.arange(n_points), asked, row) for row in np.eye(len(asked))])
    return light.display(strands.shade((seen @ between).astype(np.float32)))


def _rib(subject: Subject, pose: Pose) -> _Layer:
    """The collar's rib."""
    vertices, normals = subject.rib.place(pose.vertices, pose.normals)
    n = len(vertices)
    one = np.ones(n, np.float32)
    surface = light.Surface(normals, -unit(vertices), 0.75 * one, one)
    lit = light.shade(surface, np.broadcast_to(subject.rib.color, (n, 3)), 0.25 * one, 6 * one, 0.25 * one)
    color = light.display(lit)
    return _Layer(vertices, subject.rib.faces, np.zeros(n, np.float32), lambda ids: color[ids])


def _compose(
    layers: list[_Layer], camera: Camera, room: Float32[np.ndarray, "h w 3"], threads: int | None
) -> SyntheticFrame:
    """Draws all layers together, ``SUPERSAMPLE``² samples to the pixel, over the room."""
    firsts = np.cumsum([0, *(len(layer.vertices) for layer in layers)])
    vertices = np.concatenate([layer.vertices for layer in layers])
    faces = np.concatenate([layer.faces + first for layer, first in zip(layers, firsts, strict=False)])
    faces_drawn = torch.from_numpy(faces)
    hits = rasterize_mesh(
        torch.from_numpy(vertices), faces_drawn, supersampled(camera, SUPERSAMPLE), threads=threads
    )
    seen = _seen_vertices(hits.face_id.numpy(), faces, len(vertices))
    values = np.zeros((len(vertices), 5), np.float32)  # colour, is head, is person
    for layer, first in zip(layers, firsts, strict=False):
        ids = np.flatnonzero(seen[first : first + len(layer.vertices)])
        values[first + ids, :3] = layer.color(ids)
        values[first + ids, 3] = layer.is_head[ids]
    values[:, 4] = 1
    means = interpolated_means(hits, faces_drawn, torch.from_numpy(values), SUPERSAMPLE, threads=threads).numpy()
    person = means[..., 4]
    image = means[..., :3] + (1 - person[..., None]) * room
    return SyntheticFrame(
        (image * 255 + 0.5).clip(0, 255).astype(np.uint8), person.clip(0, 1), means[..., 3].clip(0, 1)
    )


def _seen_vertices(
    face_id: Int64[np.ndarray, "h w"], faces: Int64[np.ndarray, "f 3"], n_vertices: int
) -> Bool[np.ndarray, " n"]:
    """Which vertices are corners of a face that some sample sees."""
    face_seen = np.zeros(len(faces) + 1, bool)
    face_seen[face_id] = True  # where nothing is seen the number is -1, the extra last one
    seen = np.zeros(n_vertices, bool)
    seen[faces[face_seen[:-1]]] = True
    return seen
