"""Colours of skin, lips, eyes and mouth as functions of the place on the mean head.

Positions are canonical (the head model's template, m), so every identity gets its cheeks where its cheeks are.
Colours are linear light 0..1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from toonifygb.head import JOINTS, PARTS
from toonifygb.synthetic.body import TORSO
from toonifygb.synthetic.look import linear
from toonifygb.synthetic.noise import fractal_noise, smoothstep, value_noise

if TYPE_CHECKING:
    from jaxtyping import Float32, Int64

    from toonifygb.synthetic.body import Body
    from toonifygb.synthetic.look import Look

    Points = Float32[np.ndarray, "n 3"]


PUPIL, IRIS = np.deg2rad(8.0), np.deg2rad(22.3)
"""Angles from the eye's axis; the limbus of the head model is at 22.3°."""
GUM_COLOR, TOOTH_COLOR, TONGUE_COLOR = (178, 92, 92), (236, 226, 208), (186, 92, 96)


@dataclass
class Materials:
    """How the surface answers light, at every fine vertex."""

    albedo: Float32[np.ndarray, "n 3"]
    shine: Float32[np.ndarray, " n"]
    """Strength of the highlight relative to bare skin."""
    gloss: Float32[np.ndarray, " n"]
    """Sharpness of the highlight: exponent of its cosine."""
    softness: Float32[np.ndarray, " n"]
    """How far light wraps into the shade, 0 hard .. 1 like skin: cheap subsurface scattering."""
    raise_m: Float32[np.ndarray, " n"]
    """Displacement along the normal, m: cloth and the body of the hair."""
    bump: Float32[np.ndarray, "n 3"]
    """Added to the normal, rest axes: what the displacement and the cornea do to it."""
    carrier: Int64[np.ndarray, " n"]
    """Joint whose rotation carries the bump."""

    def optics(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The arguments of ``light.shade``: albedo, shine, gloss, softness."""
        return self.albedo, self.shine, self.gloss, self.softness


def paint(body: Body, look: Look, seed: int) -> Materials:
    """Materials of the bare subject."""
    place = body.refinement.spread(body.canonical)
    part = _fine_parts(body)
    n = len(place)
    zeros = np.zeros(n, np.float32)
    materials = Materials(
        albedo=np.zeros((n, 3), np.float32),
        shine=zeros + 1,
        gloss=zeros + 14,
        softness=zeros + 1,
        raise_m=zeros.copy(),
        bump=np.zeros((n, 3), np.float32),
        carrier=np.full(n, JOINTS.index("neck")),
    )
    _paint_skin(materials, body, look, place, part == PARTS.index("skin"), seed)
    _paint_mouth(materials, place, part)
    for joint, name in ((3, "eye_left"), (4, "eye_right")):
        rows = np.flatnonzero(part == PARTS.index(name))
        centre = body.head.rest_joints[joint].numpy()
        from_centre = place[rows] - centre
        materials.albedo[rows] = eye_color(from_centre, look, seed)
        materials.bump[rows] = _cornea(from_centre)
        materials.carrier[rows] = joint
        materials.shine[rows], materials.gloss[rows], materials.softness[rows] = 4.0, 130.0, 0.5
    return materials


def _fine_parts(body: Body) -> np.ndarray:
    """Part number of each fine vertex; shoulders count as skin, which they continue."""
    coarse = np.where(body.part == TORSO, PARTS.index("skin"), body.part)
    return body.refinement.spread(coarse.astype(np.float32)).round().astype(int)


def _paint_skin(materials: Materials, body: Body, look: Look, place: Points, skin: np.ndarray, seed: int) -> None:
    """Skin of head and shoulders, lips and the inside of the mouth."""
    spread = body.refinement.spread
    lips, ears, lids, inside, socket = (
        spread(body.region(name)) for name in ("lips", "ears", "eyelids", "inside_mouth", "eye_cavity")
    )
    color = linear(look.skin) * skin_tint(place, look, seed)
    color *= _toward((1.10, 0.74, 0.70), 0.55 * ears)
    color *= _toward((0.93, 0.80, 0.80), 0.6 * lids)
    color *= _toward((0.85, 0.55, 0.52), np.minimum(socket, 1 - lids))
    lines = value_noise(place * (1, 0.12, 0.3), 1100, seed + 31)
    lip_color = linear(look.lips) * (1 + 0.12 * lines)[:, None]
    lip_weight = (look.lip_tint * smoothstep(0.15, 0.85, lips))[:, None]
    color = color * (1 - lip_weight) + lip_color * lip_weight
    inner = np.maximum(inside - lips, 0)[:, None]
    color = color * (1 - inner) + linear((120, 44, 46)) * inner
    materials.albedo[skin] = color[skin]
    t_zone = _spot(place, (0.0, 0.085, 0.105), (0.035, 0.02, 0.05)) + _spot(
        place, (0.0, 0.012, 0.112), (0.012, 0.025, 0.03)
    )
    materials.shine[skin] = (0.85 + 0.5 * t_zone + 1.3 * lips + 0.6 * inner[:, 0])[skin]
    materials.gloss[skin] = (13 + 30 * lips + 20 * inner[:, 0])[skin]


def skin_tint(place: Points, look: Look, seed: int) -> Points:
    """What multiplies the skin's colour: blotches, pores, flushed cheeks, shaded eyes, freckles, stubble."""
    side = np.abs(place[:, 0])
    mirrored = np.stack([side, place[:, 1], place[:, 2]], 1)
    blotch, fine = fractal_noise(place, 55, seed + 5), value_noise(place, 480, seed + 6)
    tint = np.ones_like(place, np.float32)
    tint *= 1 + blotch[:, None] * (0.03, 0.07, 0.07) + 0.035 * fine[:, None]
    face = smoothstep(0.03, 0.06, place[:, 2])
    tint *= _toward((1.02, 0.74, 0.74), 0.42 * _spot(mirrored, (0.045, 0.004, 0.08), (0.020, 0.018, 0.03)))
    tint *= _toward((1.02, 0.78, 0.76), 0.4 * _spot(place, (0.0, 0.0, 0.113), (0.013, 0.011, 0.02)))
    tint *= _toward((1.0, 0.86, 0.84), 0.5 * _spot(place, (0.0, -0.058, 0.1), (0.02, 0.013, 0.03)))
    tint *= _toward((0.86, 0.78, 0.84), 0.8 * _spot(mirrored, (0.029, 0.026, 0.085), (0.014, 0.007, 0.02)))
    tint *= _toward((0.90, 0.80, 0.80), 0.7 * _spot(mirrored, (0.030, 0.046, 0.088), (0.018, 0.006, 0.02)))
    if look.freckles:
        field = _spot(mirrored, (0.032, 0.008, 0.095), (0.030, 0.016, 0.04)) * face
        speckles = smoothstep(0.45, 0.75, value_noise(place, 330, seed + 8)) * (
            0.5 + 0.5 * value_noise(place, 90, seed + 9)
        )
        tint *= _toward((0.80, 0.62, 0.50), look.freckles * field * speckles)
    if look.stubble:
        tint *= _toward(
            (0.56, 0.60, 0.66), look.stubble * _beard(place) * (0.62 + 0.38 * value_noise(place, 900, seed + 10))
        )
    return tint


def _beard(place: Points) -> Float32[np.ndarray, " n"]:
    """Where a beard grows, 0..1."""
    side = np.abs(place[:, 0])
    upper_edge = np.interp(
        side, [0.0, 0.024, 0.034, 0.05, 0.062, 0.068], [-0.008, -0.012, -0.022, -0.018, 0.0, 0.02]
    )
    below = smoothstep(0.006, -0.006, place[:, 1] - upper_edge)
    throat = smoothstep(-0.105, -0.075, place[:, 1] + 0.25 * np.maximum(place[:, 2], 0))
    bare = _spot(place, (0.0, -0.047, 0.1), (0.007, 0.004, 0.03))  # the dip under the lower lip
    return below * throat * smoothstep(-0.005, 0.02, place[:, 2]) * (1 - 0.5 * bare)


def _paint_mouth(materials: Materials, place: Points, part: np.ndarray) -> None:
    """Tongue, teeth and gums."""
    groups = {
        "tongue": (TONGUE_COLOR, 1.2, 30.0),
        "teeth_upper": (TOOTH_COLOR, 1.6, 60.0),
        "teeth_lower": (TOOTH_COLOR, 1.6, 60.0),
        "gums_upper": (GUM_COLOR, 1.2, 30.0),
        "gums_lower": (GUM_COLOR, 1.2, 30.0),
    }
    for name, (color, shine, gloss) in groups.items():
        rows = np.flatnonzero(part == PARTS.index(name))
        rough = value_noise(place[rows], 260, 77)[:, None]
        materials.albedo[rows] = linear(color) * (1 + 0.06 * rough)
        materials.shine[rows], materials.gloss[rows] = shine, gloss


def _cornea(from_centre: Points) -> Points:
    """What the cornea, which bulges twice as strongly as the eyeball, adds to its normals: the eyes' sparkle."""
    direction = from_centre / np.linalg.norm(from_centre, axis=1, keepdims=True)
    angle = np.arccos(np.clip(direction[:, 2], -1, 1))
    bulge = 1.1 * smoothstep(1.25 * IRIS, 0.9 * IRIS, angle)
    return (direction - np.array((0, 0, 1), np.float32)) * bulge[:, None]


def eye_color(from_centre: Points, look: Look, seed: int) -> Points:
    """White, iris and pupil of an eyeball that looks along +z."""
    direction = from_centre / np.linalg.norm(from_centre, axis=1, keepdims=True)
    angle = np.arccos(np.clip(direction[:, 2], -1, 1))
    radius = angle / IRIS
    turn = np.arctan2(direction[:, 1], direction[:, 0])
    ring = np.stack([np.cos(turn), np.sin(turn), 0.35 * radius], 1)
    fibres = fractal_noise(ring, 9, seed + 51)
    iris = linear(look.iris) * (1.25 + 0.55 * fibres)[:, None]
    warm = smoothstep(0.75, 0.45, radius)[:, None] * 0.35  # the lighter ring around the pupil
    iris = iris * (1 - warm) + iris * np.array((2.2, 1.7, 1.0)) * warm
    iris *= 1 - 0.75 * smoothstep(0.74, 1.0, radius)[:, None]
    veins = smoothstep(0.35, 0.7, fractal_noise(direction * (1, 1, 0.4), 12, seed + 52))
    far = smoothstep(1.4, 3.2, radius)
    white = linear((218, 211, 206)) * (1 - far[:, None] * np.array((0.04, 0.16, 0.16)))
    white = white * (1 - (0.25 * veins * far)[:, None] * np.array((0.1, 0.8, 0.8)))
    edge = smoothstep(0.94, 1.08, radius)[:, None]
    color = iris * (1 - edge) + white * edge
    color *= (
        1 - 0.42 * smoothstep(0.06, 0.36, direction[:, 1])[:, None]
    )  # the upper lid and its lashes shade the eye
    return color * smoothstep(PUPIL / IRIS - 0.06, PUPIL / IRIS + 0.04, radius)[:, None] + 0.004


def _spot(place: Points, centre: tuple[float, float, float], size: tuple[float, float, float]) -> np.ndarray:
    """Gaussian bump of the given standard deviations, m."""
    return np.exp(-(((place - np.array(centre, np.float32)) / np.array(size, np.float32)) ** 2).sum(1))


def _toward(factor: tuple[float, float, float], weight: np.ndarray) -> Points:
    """1 where the weight is 0, ``factor`` where it is 1."""
    return 1 + np.asarray(weight)[:, None] * (np.array(factor, np.float32) - 1)
