"""Hair: where it grows, its body as a raised scalp, and strands grown over it in one of four styles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb.geometry import meshes
from toonifygb.geometry.sampling import sample_surface
from toonifygb.head import PARTS
from toonifygb.synthetic.look import linear
from toonifygb.synthetic.noise import fractal_noise, smoothstep, value_noise
from toonifygb.synthetic.refine import unit
from toonifygb.synthetic.strands import Strands

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float32

    from toonifygb.synthetic.body import Body
    from toonifygb.synthetic.look import Look
    from toonifygb.synthetic.paint import Materials

    Points = Float32[np.ndarray, "n 3"]


# Hairline of the mean head: height (m) over the angle from the face's middle (degrees). The dip at 78° is the
# sideburn, the rise after it runs around the ear.
HAIRLINE_ANGLE = (0, 14, 28, 42, 54, 64, 72, 82, 90, 97, 108, 125, 150, 180)
HAIRLINE_HEIGHT = (
    0.104,
    0.105,
    0.101,
    0.092,
    0.074,
    0.050,
    0.026,
    0.022,
    0.045,
    0.050,
    0.036,
    -0.006,
    -0.030,
    -0.036,
)
AXIS_Z = -0.005
"""Depth of the vertical axis that the hairline's angles are measured about, m."""
GROW_STEPS = 11


@dataclass(frozen=True)
class Style:
    """How hair grows: directions and lengths as functions of the root on the mean head."""

    comb: Callable[[Points], Points]
    """Direction along the scalp that the hair is led to."""
    length: Callable[[Points], Float32[np.ndarray, " n"]]
    """m."""
    body_m: float
    """Thickness of the body of hair."""
    lift: float
    """How much a strand leaves along the normal before the comb takes over."""
    gravity: float
    """Pull downwards in each step."""
    curl_m: float = 0.0
    """Radius of the curls."""
    curl_turns: float = 0.0
    n_strands: int = 5200
    width_m: float = 0.0013
    slack_m: float = 0.010
    """How far above the body of the hair strands may stand."""
    unruly: float = 0.25
    """Strength of the noise in the direction."""


def _side(place: Points) -> Float32[np.ndarray, " n"]:
    """-1 or 1: the side of the parting, which is a little to the subject's left, that hair falls to."""
    return np.where(place[:, 0] > 0.022, 1.0, -1.0)


def _comb_short(place: Points) -> Points:
    top = smoothstep(0.075, 0.115, place[:, 1])[:, None]
    aside = np.stack([0.9 * _side(place), 0.0 * place[:, 0], 0.45 - 6 * np.maximum(0.06 - place[:, 2], 0)], 1)
    down = np.stack([0.0 * place[:, 0], -1 + 0 * place[:, 0], -0.45 + 0 * place[:, 0]], 1)
    return aside * top + down * (1 - top)


def _comb_bob(place: Points) -> Points:
    top = smoothstep(0.07, 0.12, place[:, 1])[:, None]
    aside = np.stack([1.0 * _side(place), -0.25 + 0 * place[:, 0], -0.35 - 4 * np.maximum(-place[:, 2], 0)], 1)
    down = np.stack([0.12 * np.sign(place[:, 0]), -1 + 0 * place[:, 0], -0.22 + 0 * place[:, 0]], 1)
    return aside * top + down * (1 - top)


def _comb_swept(place: Points) -> Points:
    knot = np.array((0.0, 0.085, -0.105), np.float32)
    return unit(knot - place)


def _comb_curly(place: Points) -> Points:
    return np.stack([0.5 * place[:, 0] / 0.07, 0.2 + 0 * place[:, 0], place[:, 2] / 0.2], 1)


STYLES = {
    "short": Style(
        comb=_comb_short,
        length=lambda p: np.interp(p[:, 1], (-0.03, 0.02, 0.07, 0.115), (0.007, 0.011, 0.02, 0.05)).astype(
            np.float32
        ),
        body_m=0.010,
        lift=0.55,
        gravity=0.05,
        n_strands=7000,
    ),
    "bob": Style(
        comb=_comb_bob,
        length=lambda p: (1.12 * (p[:, 1] + 0.062) + 0.030).astype(np.float32),
        body_m=0.013,
        lift=0.35,
        gravity=0.30,
        n_strands=5200,
        width_m=0.0016,
        unruly=0.16,
    ),
    "swept": Style(
        comb=_comb_swept,
        length=lambda p: np.clip(
            np.linalg.norm(p - np.array((0.0, 0.085, -0.105)), axis=1) * 1.2, 0.03, 0.21
        ).astype(np.float32),
        body_m=0.009,
        lift=0.22,
        gravity=0.0,
        width_m=0.0015,
        unruly=0.12,
    ),
    "curly": Style(
        comb=_comb_curly,
        length=lambda p: np.interp(p[:, 1], (-0.03, 0.03, 0.08), (0.012, 0.022, 0.050)).astype(np.float32),
        body_m=0.015,
        lift=1.1,
        gravity=0.03,
        curl_m=0.0042,
        curl_turns=2.6,
        n_strands=6000,
        unruly=0.55,
    ),
}


def grows(place: Points, seed: int) -> Float32[np.ndarray, " n"]:
    """Where hair grows on the mean head, 0..1."""
    angle = np.rad2deg(np.arctan2(np.abs(place[:, 0]), place[:, 2] - AXIS_Z))
    line = np.interp(angle, HAIRLINE_ANGLE, HAIRLINE_HEIGHT) + 0.0022 * value_noise(place, 260, seed + 40)
    return smoothstep(-0.002, 0.005, place[:, 1] - line)


def cover_scalp(materials: Materials, body: Body, look: Look, seed: int) -> Float32[np.ndarray, " n"]:
    """Turns the scalp into the body of the hair.

    Returns:
        Where there is hair, 0..1.
    """
    style = STYLES[look.style]
    place = body.refinement.spread(body.canonical)
    skin = body.refinement.spread((body.part == PARTS.index("skin")).astype(np.float32))
    ears = body.refinement.spread(body.region("ears"))
    hair = grows(place, seed) * skin * smoothstep(0.5, 0.1, ears)
    fine = value_noise(place * (1, 0.3, 0.3), 700, seed + 41)
    color = linear(look.hair) * (0.55 * (1 + 0.3 * fine))[:, None]
    weight = smoothstep(0.1, 0.7, hair)[:, None]
    materials.albedo[:] = materials.albedo * (1 - weight) + color * weight
    for values, level in ((materials.shine, 0.12), (materials.gloss, 8.0), (materials.softness, 0.1)):
        values[:] = values * (1 - weight[:, 0]) + level * weight[:, 0]
    materials.raise_m += _body_thickness(style, place, seed) * hair
    return hair


def _body_thickness(style: Style, place: Points, seed: int) -> Float32[np.ndarray, " n"]:
    """Of the body of hair, m: thin at the hairline, the neck and the temples."""
    angle = np.rad2deg(np.arctan2(np.abs(place[:, 0]), place[:, 2] - AXIS_Z))
    inside = place[:, 1] - np.interp(angle, HAIRLINE_ANGLE, HAIRLINE_HEIGHT)
    full = smoothstep(0.0, 0.035, inside)
    return style.body_m * full * (0.72 + 0.28 * fractal_noise(place, 45, seed + 42))


def grow_hair(body: Body, look: Look, seed: int) -> Strands:
    """Strands at rest, head frame."""
    style = STYLES[look.style]
    roots, normals, place = _roots(body, style, seed)
    rng = np.random.Generator(np.random.Philox(seed + 1000))
    n = len(roots)
    varied = (0.78 + 0.44 * rng.random(n)).astype(np.float32)
    step = (style.length(place) * varied / GROW_STEPS)[:, None]
    hull, hull_normals = _hull(body)
    base = _body_thickness(style, place, seed)
    layer = rng.random(n).astype(np.float32)  # 0 lies on the scalp, 1 on top
    start = roots + normals * (0.6 * layer * base)[:, None]
    direction = unit(style.lift * normals + _along_skin(style.comb(place), normals))
    height = base * (0.6 + 0.7 * layer) + 0.0015
    clump = np.stack([fractal_noise(place, 110, seed + 43 + axis) for axis in range(3)], 1)
    points, outward = [start], [normals]
    for index in range(GROW_STEPS):
        progress = index / GROW_STEPS
        wild = np.stack([value_noise(points[-1], 160, seed + 46 + axis) for axis in range(3)], 1)
        pull = np.array((0, -style.gravity, 0), np.float32)
        comb = _along_skin(style.comb(points[-1] - roots + place), outward[-1])
        loose = style.unruly * (0.3 + 0.7 * progress) * (0.6 * clump + 0.4 * wild)
        direction = unit(direction + 0.45 * comb + pull + loose)
        ahead, near = _kept_near(
            points[-1] + step * direction, hull, hull_normals, height, style.slack_m * (0.3 + layer)
        )
        ahead = _beside_the_face(ahead)
        direction = unit(ahead - points[-1])
        points.append(ahead)
        outward.append(near)
    path = np.stack(points, 1)
    clear = ~_kinked(path)
    if style.curl_m:
        path = _curled(path, style, rng)
    clear &= ~_on_the_face(path).any(1)
    return _finish(path[clear], np.stack(outward, 1)[clear], layer[clear], look, style, rng)


def _roots(body: Body, style: Style, seed: int) -> tuple[Points, Points, Points]:
    """Roots and normals at rest, and the roots on the mean head."""
    weight = grows(body.canonical, seed) * (body.part == PARTS.index("skin")) * (1 - body.region("ears"))
    faces = torch.from_numpy(body.faces)
    face_weight = torch.from_numpy(weight)[faces].mean(1)
    on_scalp = face_weight > 0.25
    chosen = faces[on_scalp]
    rest, canonical = torch.from_numpy(body.rest), torch.from_numpy(body.canonical)
    ids, bary = sample_surface(rest, chosen, style.n_strands, seed)
    normals = torch.from_numpy(body.rest_normals)
    mixed = [meshes.barycentric(values, chosen, ids, bary.float()) for values in (rest, normals, canonical)]
    roots, normal, place = (values.numpy() for values in mixed)
    return roots, unit(normal), place


def _hull(body: Body) -> tuple[Points, Points]:
    """Points and normals of the skin that hair may not enter."""
    outside = (
        (body.part == PARTS.index("skin"))
        & (body.region("inside_mouth") < 0.5)
        & (body.region("eye_cavity") < 0.5)
        & (body.canonical[:, 2] < 0.085)
    )
    return body.rest[outside], body.rest_normals[outside]


def _along_skin(direction: Points, normals: Points) -> Points:
    """Directions turned into the plane of the skin, unit."""
    flat = direction - np.einsum("ni,ni->n", direction, normals)[:, None] * normals
    return unit(flat.astype(np.float32))


def _beside_the_face(points: Points) -> Points:
    """Points moved sideways out of the way of forehead, eyes and cheeks."""
    least = np.interp(points[:, 1], (-0.05, 0.06, 0.08, 0.095, 0.104), (0.060, 0.060, 0.050, 0.028, 0.0))
    aside = np.where(points[:, 0] < 0, -1, 1) * np.maximum(np.abs(points[:, 0]), least)
    x = np.where(points[:, 2] > 0.03, aside, points[:, 0])
    return np.concatenate([x[:, None], points[:, 1:]], 1).astype(np.float32)


def _kinked(path: Float32[np.ndarray, "s k 3"]) -> np.ndarray:
    """Strands that were pushed around a sharp corner (more than 50°)."""
    along = unit(np.diff(path, axis=1))
    return (np.einsum("ski,ski->sk", along[:, 1:], along[:, :-1]) < 0.64).any(1)


def _on_the_face(points: Float32[np.ndarray, "s k 3"]) -> np.ndarray:
    """Whether points lie in front of forehead, eyes and cheeks."""
    x, y, z = np.abs(points[..., 0]), points[..., 1], points[..., 2]
    return (z > 0.05) & (y < 0.088) & (x < 0.056)


def _kept_near(
    points: Points, hull: Points, hull_normals: Points, height: Float32[np.ndarray, " n"], slack: np.ndarray
) -> tuple[Points, Points]:
    """Points moved to between ``height`` and ``height + slack`` outside the hull, and the hull's normals there.

    Below the ears hair hangs free: the upper limit fades.
    """
    distances = torch.cdist(torch.from_numpy(points), torch.from_numpy(hull))
    nearest = distances.topk(4, largest=False).indices.numpy()
    normal = unit(hull_normals[nearest].mean(1))
    above = np.einsum("ni,ni->n", points - hull[nearest].mean(1), normal)
    most = height + slack + 0.6 * np.maximum(0.015 - points[:, 1], 0)
    return points + (np.clip(above, height, most) - above)[:, None] * normal, normal


def _curled(path: Float32[np.ndarray, "s k 3"], style: Style, rng: np.random.Generator) -> np.ndarray:
    """Strands wound around their own paths."""
    n, k, _ = path.shape
    along = unit(path[:, -1] - path[:, 0])
    side = unit(np.cross(along, np.array((0.31, 0.87, 0.38), np.float32)))
    other = np.cross(along, side)
    progress = np.linspace(0, 1, k, dtype=np.float32)
    turn = 2 * np.pi * (style.curl_turns * progress + rng.random((n, 1)))
    radius = style.curl_m * progress**0.5 * (0.7 + 0.6 * rng.random((n, 1)))
    wound = (radius * np.cos(turn))[..., None] * side[:, None] + (radius * np.sin(turn))[..., None] * other[:, None]
    return (path + wound).astype(np.float32)


def _finish(
    path: Float32[np.ndarray, "s k 3"],
    outward: Float32[np.ndarray, "s k 3"],
    layer: Float32[np.ndarray, " s"],
    look: Look,
    style: Style,
    rng: np.random.Generator,
) -> Strands:
    """Widths, colours and exposure of grown strands."""
    n, k, _ = path.shape
    progress = np.linspace(0, 1, k, dtype=np.float32)[None]
    width = style.width_m * (0.75 + 0.5 * rng.random((n, 1))) * (1 - 0.75 * progress**2)
    width = width * np.minimum(0.35 + 4 * progress, 1)  # fine at the root: a soft hairline
    tone = (0.72 + 0.56 * rng.random((n, 1, 1))) * (0.92 + 0.16 * progress[..., None])
    warm = 1 + 0.10 * rng.standard_normal((n, 1, 1)) * np.array((1.0, 0.0, -0.6))
    albedo = linear(look.hair) * tone * warm
    exposure = np.clip(0.30 + 0.60 * layer[:, None] + 0.15 * progress, 0, 1)
    return Strands(
        path.astype(np.float32),
        unit(outward).astype(np.float32),
        width.astype(np.float32),
        np.clip(albedo, 0.002, 1).astype(np.float32),
        np.broadcast_to(exposure, width.shape).astype(np.float32),
    )
