"""The avatar before training: Gaussians on the tracked head, deltas taken from the mesh, and a mouth.

Face Gaussians lie on skin and eyeballs, denser where looks matter; a share of them fills the space above the
scalp, because hair stands off the bald mesh. They are ordered so that those which expressions move come first: the
training streams only these through its expression deltas.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import torch

from toonifygb.avatar.bases import check_bases, reduced
from toonifygb.avatar.model import POSE_DRIVERS, Avatar, PoseDrivers, pose_quantities
from toonifygb.avatar.mouth import mouth_points
from toonifygb.avatar.transfer import consistency, turns
from toonifygb.geometry.cameras import tracked_camera
from toonifygb.geometry.meshes import barycentric, face_areas, sample_surface, vertex_normals
from toonifygb.geometry.sampling import curve_order
from toonifygb.head import JOINTS, PARTS
from toonifygb.structures import GaussianParams, HeadMotion

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from toonifygb.config import TrainConfig
    from toonifygb.head import HeadModel
    from toonifygb.structures import Camera

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""
FIRST_OPACITY = 0.1
HAIR_SHARE = 0.25
"""Share of the face set that starts above the scalp when training views are at hand."""
HAIR_REACH = 0.045
"""Thickness of that layer, m."""
HAIR_INSIDE = 0.9
"""Least share of the views in which a hair Gaussian must lie inside the head's matte."""
SURFACE_PARTS = ("skin", "eye_left", "eye_right")
DENSITY = {"lips": 4.0, "eyelids": 4.0, "face": 2.5, "ears": 1.5}
"""Gaussians per area by region, relative to the rest of the skin."""
EYE_DENSITY = 4.0
HIDDEN_DENSITY = 0.4
"""Inside of mouth and eye sockets: rarely seen."""
HIDDEN_REGIONS = ("inside_mouth", "eye_cavity")
_FALLBACK_CAMERA = (800.0, 512, 512)
_NEIGHBOURS_AT_ONCE = 512


class Views(Protocol):
    """A few training images that a new Gaussian may look at."""

    def matte_share(self, points: Float[Tensor, "n 3"], skin_weights: Float[Tensor, "n 5"]) -> Float[Tensor, " n"]:
        """Share of the views in which each rest-pose point falls inside the head's matte."""
        ...

    def colors(
        self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], skin_weights: Float[Tensor, "n 5"]
    ) -> Float[Tensor, "n 3"]:
        """Mean colour 0..1 of each rest-pose point where it faces the camera; grey where it never does."""
        ...


def init_avatar(
    head: HeadModel,
    shape: Float[Tensor, " s"],
    config: TrainConfig,
    *,
    motion: HeadMotion | None = None,
    camera: Camera | None = None,
    full_camera: Camera | None = None,
    views: Views | None = None,
) -> Avatar:
    """An untrained avatar of one identity.

    Args:
        head: the head model.
        shape: β of the subject.
        config: numbers of Gaussians and bases, SH degree, seed.
        motion: the training frames' motion; gives the avatar its pose drivers and ranges.
        camera: camera of the training crops.
        full_camera: camera of the whole clip; the training camera when ``None``.
        views: training images for hair and colours; without them the head is bald and grey.

    Raises:
        InputError: a number of bases that the head model has no use for.
    """
    check_bases(config, head)
    rest = head.rest(shape)
    n_kept = config.n_bases if config.blendshapes == "full" else None
    n_expressions = n_kept or head.n_blendshapes or head.n_expression
    face = _face_set(head, rest, n_expressions, config, views)
    names = list(head.expression_names[:n_expressions])
    n_eyelids = 0 if head.eyelid_basis is None else 2
    names += ["eyelid_left", "eyelid_right"][:n_eyelids]
    drivers = None if motion is None else pose_drivers(motion)
    names += POSE_DRIVERS if drivers is not None else ()
    camera = camera or tracked_camera(*_FALLBACK_CAMERA)
    upper, lower = _mouth_sets(head, rest, config, views)
    lowest, highest, mean = _ranges(head, motion)
    avatar = Avatar(
        neutral=face.neutral,
        deltas=_extended(face.deltas, len(names)),
        blendshape_names=tuple(names),
        n_expressions=n_expressions,
        n_eyelids=n_eyelids,
        drivers=drivers,
        skin_weights=face.skin_weights,
        pose_basis=face.pose_basis,
        pose_features=tuple(int(feature) for feature in head.pose_features),
        rest_joints=head.joints(shape),
        joint_expression_basis=head.joint_expression_basis,
        parents=head.parents,
        mouth_upper=upper,
        mouth_lower=lower,
        mouth_upper_weights=_bound_to("neck"),
        mouth_lower_weights=_bound_to("jaw"),
        motion_lower=lowest,
        motion_upper=highest,
        motion_mean=mean,
        camera=camera,
        full_camera=full_camera or camera,
        head_model=head.name,
        shape=shape,
        meta={"n_moved": face.n_moved},
    )
    return avatar if config.blendshapes == "full" else reduced(avatar, head, config, motion)


def pose_drivers(motion: HeadMotion) -> PoseDrivers:
    """Pose drivers fitted to the training frames: standardised there, limited to the range seen there."""
    quantities = pose_quantities(motion)
    centre, scale = quantities.mean(0), quantities.std(0, correction=0)
    # A quantity that never changes must not turn rounding noise into coefficients: 0.01 rad, 1 mm.
    least = torch.tensor([0.01] * 4 + [0.001] * 3)
    scale = scale.maximum(least)
    standard = (quantities - centre) / scale
    return PoseDrivers(centre, scale, standard.amin(0), standard.amax(0))


@dataclass(frozen=True)
class _Places:
    """Where Gaussians start: a point of the surface each, and a distance along its normal."""

    face_ids: Int[Tensor, " n"]
    bary: Float[Tensor, "n 3"]
    offset: Float[Tensor, " n"]
    """m along the outward normal; 0 for Gaussians on the surface."""

    def pick(self, which: Tensor) -> _Places:
        """Some of them, in the given order."""
        return _Places(self.face_ids[which], self.bary[which], self.offset[which])

    def points(self, rest: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> tuple[Tensor, Tensor]:
        """Positions and unit normals in the rest pose."""
        normals = barycentric(vertex_normals(rest, faces), faces, self.face_ids, self.bary)
        normals = torch.nn.functional.normalize(normals, dim=-1)
        return barycentric(rest, faces, self.face_ids, self.bary) + normals * self.offset[:, None], normals


@dataclass(frozen=True)
class _FaceSet:
    neutral: GaussianParams
    deltas: GaussianParams
    """Mesh-derived; expressions, then eyelids."""
    skin_weights: Float[Tensor, "n 5"]
    pose_basis: Float[Tensor, "p n 3"]
    n_moved: int
    """The first so many Gaussians are moved by some expression or eyelid; the others by none."""


def _face_set(
    head: HeadModel, rest: Float[Tensor, "v 3"], n_expressions: int, config: TrainConfig, views: Views | None
) -> _FaceSet:
    surface = replace(head, faces=head.faces[_surface_faces(head)], uv=None)
    places = _places(surface, rest, config, views)
    basis = [head.expression_basis[..., :n_expressions]]
    basis += [] if head.eyelid_basis is None else [head.eyelid_basis]
    movement = torch.cat(basis, dim=-1).movedim(-1, 0)

    # Those that some blendshape moves come first, and neighbours come together: the same blendshapes move them, so
    # that training can leave out whole stretches of the others.
    places = places.pick(curve_order(places.points(rest, surface.faces)[0]))
    moved = (consistency(barycentric(movement, surface.faces, places.face_ids, places.bary)) > 0).any(0)
    places = places.pick(torch.argsort(moved.int(), descending=True, stable=True))
    at = surface.at(places.face_ids, places.bary)

    means, normals = places.points(rest, surface.faces)
    colors = None if views is None else views.colors(means, normals, at.skin_weights)
    neutral = _fresh(means, config.sh_degree, colors)
    displacement = barycentric(movement, surface.faces, places.face_ids, places.bary)
    deltas = GaussianParams(
        means=displacement,
        quats=turns(rest, rest + movement, surface.faces, places.face_ids, neutral.quats),
        log_scales=torch.zeros_like(displacement),
        opacity_logits=torch.zeros_like(displacement[..., 0]),
        sh=neutral.sh.new_zeros(len(movement), *neutral.sh.shape),
    )
    weights = at.skin_weights / at.skin_weights.sum(-1, keepdim=True)
    return _FaceSet(neutral, deltas, weights, at.pose_basis, int(moved.sum()))


def _surface_faces(head: HeadModel) -> Bool[Tensor, " f"]:
    wanted = torch.tensor([PARTS.index(name) for name in SURFACE_PARTS])
    return torch.isin(head.part[head.faces[:, 0]], wanted)


def _places(surface: HeadModel, rest: Float[Tensor, "v 3"], config: TrainConfig, views: Views | None) -> _Places:
    """Surface points by density, plus hair where the views show some above the scalp."""
    hair = (
        None if views is None else _hair(surface, rest, round(HAIR_SHARE * config.n_gaussians), config.seed, views)
    )
    n_hair = 0 if hair is None else len(hair.face_ids)
    face_ids, bary = sample_surface(
        rest, surface.faces, config.n_gaussians - n_hair, config.seed, _density(surface)
    )
    on_surface = _Places(face_ids, bary, bary.new_zeros(len(bary)))
    if hair is None:
        return on_surface
    return _Places(
        torch.cat([face_ids, hair.face_ids]),
        torch.cat([bary, hair.bary]),
        torch.cat([on_surface.offset, hair.offset]),
    )


def _density(surface: HeadModel) -> Float[Tensor, " f"]:
    """Wanted Gaussians per area of each face, relative to plain skin."""
    density = torch.ones_like(surface.template[:, 0])
    for name, value in DENSITY.items():
        if name in surface.regions:
            density = density.maximum(1 + (value - 1) * surface.regions[name])
    for name in HIDDEN_REGIONS:
        if name in surface.regions:
            density = torch.where(surface.regions[name] > 0.5, HIDDEN_DENSITY, density)
    eyes = torch.tensor([PARTS.index("eye_left"), PARTS.index("eye_right")])
    density = torch.where(torch.isin(surface.part, eyes), EYE_DENSITY, density)
    return density[surface.faces].mean(-1)


def _hair(surface: HeadModel, rest: Float[Tensor, "v 3"], n: int, seed: int, views: Views) -> _Places | None:
    """Points above the scalp that lie inside the matte of nearly every view; fewer than ``n`` for thin hair."""
    if "scalp" not in surface.regions:
        return None
    generator = torch.Generator().manual_seed(seed)
    weight = surface.regions["scalp"][surface.faces].mean(-1) * face_areas(rest, surface.faces)
    n_tried = 4 * n
    face_ids = torch.multinomial(weight, n_tried, replacement=True, generator=generator)
    u, v = torch.rand(2, n_tried, generator=generator)
    root = u.sqrt()
    bary = torch.stack([1 - root, root * (1 - v), root * v], dim=-1)
    places = _Places(face_ids, bary, HAIR_REACH * torch.rand(n_tried, generator=generator))
    points, _ = places.points(rest, surface.faces)
    inside = views.matte_share(points, surface.at(face_ids, bary).skin_weights) >= HAIR_INSIDE
    return places.pick(inside.nonzero()[:n, 0])


def _mouth_sets(
    head: HeadModel, rest: Float[Tensor, "v 3"], config: TrainConfig, views: Views | None
) -> tuple[GaussianParams, GaussianParams]:
    sets = []
    for points, joint in zip(
        mouth_points(head, rest, config.n_mouth_gaussians, config.seed), ("neck", "jaw"), strict=True
    ):
        forward = torch.tensor([0.0, 0.0, 1.0]).expand_as(points)
        weights = _bound_to(joint).expand(len(points), -1)
        colors = None if views is None else views.colors(points, forward, weights)
        sets.append(_fresh(points, config.sh_degree, colors))
    return sets[0], sets[1]


def _fresh(means: Float[Tensor, "n 3"], sh_degree: int, colors: Float[Tensor, "n 3"] | None) -> GaussianParams:
    """Round, faint Gaussians as large as the distance between them (3DGB's rule); grey without colours."""
    n = len(means)
    spread = nearest_squared(means).clamp_min(1e-7).sqrt().log()
    sh = means.new_zeros(n, (sh_degree + 1) ** 2, 3)
    if colors is not None:
        sh[:, 0] = (colors - 0.5) / SH_C0
    return GaussianParams(
        means=means,
        quats=means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        log_scales=spread[:, None].repeat(1, 3),
        opacity_logits=means.new_full((n,), FIRST_OPACITY).logit(),
        sh=sh,
    )


def nearest_squared(points: Float[Tensor, "n 3"], neighbours: int = 3) -> Float[Tensor, " n"]:
    """Mean squared distance of each point to its nearest others, m²."""
    neighbours = min(neighbours, len(points) - 1)
    if neighbours < 1:
        return torch.zeros_like(points[:, 0])
    found = []
    for block in points.split(_NEIGHBOURS_AT_ONCE):
        apart = torch.cdist(block, points, compute_mode="donot_use_mm_for_euclid_dist")
        found.append(apart.topk(neighbours + 1, largest=False).values[:, 1:].square().mean(-1))
    return torch.cat(found)


def _extended(deltas: GaussianParams, count: int) -> GaussianParams:
    """Deltas with zero rows appended up to ``count``."""
    return deltas.map(lambda delta: torch.cat([delta, delta.new_zeros(count - len(delta), *delta.shape[1:])]))


def _bound_to(joint: str) -> Float[Tensor, " 5"]:
    weights = torch.zeros(len(JOINTS))
    weights[JOINTS.index(joint)] = 1.0
    return weights


def _ranges(head: HeadModel, motion: HeadMotion | None) -> tuple[HeadMotion, HeadMotion, HeadMotion]:
    """Least, greatest and mean motion; the head model's own limits and a resting pose without a clip."""
    if motion is not None:
        return (
            motion.map(lambda values: values.amin(0)),
            motion.map(lambda values: values.amax(0)),
            motion.map(lambda values: values.mean(0)),
        )
    joints, origin = torch.zeros(len(JOINTS), 3), torch.zeros(3)
    lowest = HeadMotion(head.expression_lower, joints, origin, torch.zeros(2))
    highest = HeadMotion(head.expression_upper, joints, origin, torch.ones(2))
    return lowest, highest, HeadMotion(torch.zeros_like(head.expression_lower), joints, origin, torch.zeros(2))
