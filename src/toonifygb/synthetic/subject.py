"""A synthetic person: everything that does not change from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb import head as heads
from toonifygb.geometry import meshes
from toonifygb.structures import HeadMotion
from toonifygb.synthetic import clothes, facial_hair, hair, light
from toonifygb.synthetic.body import Body, make_body
from toonifygb.synthetic.look import Look, make_look
from toonifygb.synthetic.paint import Materials, paint

if TYPE_CHECKING:
    from jaxtyping import Float32

    from toonifygb.head import HeadModel
    from toonifygb.synthetic.facial_hair import FacialHair
    from toonifygb.synthetic.strands import Strands

OPEN_JAW_RAD = 0.32
"""Opening at which the light inside the mouth is measured."""
MOUTH_GLOW = 0.22
"""Least light inside the mouth: what its wet walls pass on to each other."""


@dataclass(frozen=True)
class Subject:
    """One synthetic person."""

    seed: int
    look: Look
    body: Body
    materials: Materials
    cloth: Float32[np.ndarray, " n"]
    """Where the fine vertices are cloth, 0..1."""
    open_sky: Float32[np.ndarray, " v"]
    """Share of the surroundings that each coarse vertex sees, 0..1."""
    hair: Strands
    facial_hair: FacialHair
    rib: clothes.Rib

    @property
    def head(self) -> HeadModel:
        """The head model whose parameters the subject's motion is told in."""
        return self.body.head

    @property
    def shape(self) -> torch.Tensor:
        """β, identity coefficients."""
        return self.body.shape


def make_subject(seed: int) -> Subject:
    """The person of that number: always the same one, on every machine.

    Seeds 0 to 3 are four hand-made people, further ones vary their features and colours.
    """
    look = make_look(seed)
    head = heads.load("open")
    rng = np.random.Generator(np.random.Philox(look.shape_seed))
    coefficients = look.shape_spread * rng.standard_normal(head.n_shape)
    body = make_body(head, torch.from_numpy(coefficients.astype(np.float32)), look)
    materials = paint(body, look, seed)
    facial_hair.tint_brows(materials, body, look)
    hair.cover_scalp(materials, body, look, seed)
    cloth = clothes.dress(materials, body, look, seed)
    materials.bump += _relief(body, materials)
    return Subject(
        seed,
        look,
        body,
        materials,
        cloth,
        _open_sky(body),
        hair.grow_hair(body, look, seed),
        facial_hair.grow_facial_hair(body, look, seed),
        clothes.make_rib(body, look),
    )


def _relief(body: Body, materials: Materials) -> Float32[np.ndarray, "n 3"]:
    """Difference between the normals with and without the displacement, rest axes."""
    positions, normals = body.refinement.curve(body.rest, body.rest_normals)
    raised = positions + materials.raise_m[:, None] * normals
    true = meshes.vertex_normals(torch.from_numpy(raised), torch.from_numpy(body.refinement.faces)).numpy()
    changed = np.abs(materials.raise_m) > 1e-5
    return np.where(changed[:, None], true - normals, 0).astype(np.float32)


def _open_sky(body: Body) -> Float32[np.ndarray, " v"]:
    """Ambient occlusion at rest; inside the mouth, and on the lips' inner sides, with the jaw open."""
    n_expression = body.head.n_expression
    joints = torch.zeros(5, 3)
    closed = body.pose(HeadMotion(torch.zeros(n_expression), joints, torch.zeros(3), torch.zeros(2)))
    joints = joints.clone()
    joints[2, 0] = OPEN_JAW_RAD
    opened = body.pose(HeadMotion(torch.zeros(n_expression), joints, torch.zeros(3), torch.zeros(2)))
    at_rest, at_open = (
        light.open_sky(pose.vertices, pose.normals, pose.vertices, body.faces) for pose in (closed, opened)
    )
    mouth_part = np.isin(
        body.part, [heads.PARTS.index(name) for name in heads.PARTS if "eye" not in name and name != "skin"]
    )
    inside = np.maximum(np.maximum(body.region("inside_mouth"), body.region("lips")), mouth_part)
    return at_rest * (1 - inside) + np.maximum(np.maximum(at_open, at_rest), MOUTH_GLOW) * inside
