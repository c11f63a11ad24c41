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
    from jaxtyping import Float32, Int64, UInt8

    from toonifygb.structures import Camera, HeadMotion
    from toonifygb.synthetic.body import Pose
    from toonifygb.synthetic.subject import Subject

SUPERSAMPLE = 2
EYE_KEY_SEEN = 0.6
"""Share of the key lamp on the eyes: the shadow map is too coarse for the lids, whose shade is painted instead."""
HAIR_LIT_PER_POINT = 3
"""Every so many points of a hair ask for their own shadow."""
SKULL = JOINTS.index("neck")
HIDDEN_COSINE = -0.3
"""Vertices turned away from the camera by more than this are not lit; their faces and hairs are not drawn."""


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
    """A lit mesh, ready to be drawn."""

    vertices: Float32[np.ndarray, "n 3"]
    faces: Int64[np.ndarray, "f 3"]
    color: Float32[np.ndarray, "n 3"]
    """sRGB 0..1."""
    is_head: Float32[np.ndarray, " n"]


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
    faces = refinement.faces[~turned_away[refinement.faces].all(1)]
    seen = np.flatnonzero(~turned_away)
    bump = np.einsum("nij,nj->ni", pose.joints[materials.carrier[seen], :3, :3], materials.bump[seen])
    key_seen = shadows.visibility(pose.vertices, pose.normals)
    is_eye = np.isin(subject.body.part, [PARTS.index("eye_left"), PARTS.index("eye_right")])
    key_seen = np.where(is_eye, EYE_KEY_SEEN, key_seen)
    sky, key = refinement.spread(np.stack([subject.open_sky, key_seen], 1))[seen].T
    surface = light.Surface(unit(normals[seen] + bump), views[seen], sky, key)
    lit = light.shade(surface, *(values[seen] for values in materials.optics()))
    color = np.zeros_like(positions)
    color[seen] = light.display(lit)
    return _Layer(positions, faces, color, 1 - subject.cloth)


def _hairs(subject: Subject, pose: Pose, shadows: light.ShadowMap) -> list[_Layer]:
    """Strands of the head's hair, and brows and lashes."""
    layers = []
    head_hair = subject.hair.moved(pose.joints[SKULL]).facing(HIDDEN_COSINE)
    for strands in (head_hair, subject.facial_hair.place(pose)):
        n_strands, n_points = strands.width.shape
        asked = np.arange(0, n_points + HAIR_LIT_PER_POINT - 1, HAIR_LIT_PER_POINT).clip(max=n_points - 1)
        points, outward = (values[:, asked].reshape(-1, 3) for values in (strands.points, strands.outward))
        seen = shadows.visibility(points, outward, taps=2).reshape(n_strands, -1)
        between = np.stack([np.interp(np.arange(n_points), asked, row) for row in np.eye(len(asked))])
        color = light.display(strands.shade((seen @ between).astype(np.float32)))
        vertices, faces = strands.ribbons()
        flat = np.repeat(color.reshape(-1, 3), 2, 0)
        layers.append(_Layer(vertices, faces, flat, np.ones(len(vertices), np.float32)))
    return layers


def _rib(subject: Subject, pose: Pose) -> _Layer:
    """The collar's rib."""
    vertices, normals = subject.rib.place(pose.vertices, pose.normals)
    n = len(vertices)
    one = np.ones(n, np.float32)
    surface = light.Surface(normals, -unit(vertices), 0.75 * one, one)
    lit = light.shade(surface, np.broadcast_to(subject.rib.color, (n, 3)), 0.25 * one, 6 * one, 0.25 * one)
    return _Layer(vertices, subject.rib.faces, light.display(lit), np.zeros(n, np.float32))


def _compose(
    layers: list[_Layer], camera: Camera, room: Float32[np.ndarray, "h w 3"], threads: int | None
) -> SyntheticFrame:
    """Draws all layers together, ``SUPERSAMPLE``² samples to the pixel, over the room."""
    firsts = np.cumsum([0, *(len(layer.vertices) for layer in layers)])
    vertices = torch.from_numpy(np.concatenate([layer.vertices for layer in layers]))
    faces = torch.from_numpy(
        np.concatenate([layer.faces + first for layer, first in zip(layers, firsts, strict=False)])
    )
    color = np.concatenate([layer.color for layer in layers])
    is_head = np.concatenate([layer.is_head for layer in layers])[:, None]
    values = torch.from_numpy(np.concatenate([color, is_head, np.ones_like(is_head)], 1, dtype=np.float32))
    hits = rasterize_mesh(vertices, faces, supersampled(camera, SUPERSAMPLE), threads=threads)
    means = interpolated_means(hits, faces, values, SUPERSAMPLE, threads=threads).numpy()
    person = means[..., 4]
    image = means[..., :3] + (1 - person[..., None]) * room
    return SyntheticFrame(
        (image * 255 + 0.5).clip(0, 255).astype(np.uint8), person.clip(0, 1), means[..., 3].clip(0, 1)
    )
