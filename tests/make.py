"""Small made-up things for tests: a head of 190 vertices, an avatar on it, a track. No files, no downloads."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from toonifygb.avatar import Avatar, init_avatar
from toonifygb.config import TrainConfig
from toonifygb.geometry.cameras import project, tracked_camera
from toonifygb.head import PARENTS, PARTS, HeadModel
from toonifygb.structures import Camera, HeadMotion, Landmarks, TrackedSequence

TINY = TrainConfig(
    n_gaussians=300,
    n_mouth_gaussians=40,
    resolution=48,
    steps=40,
    delta_frames=1,
    sh_degree=1,
    test_share=0.2,
    checkpoint_seconds=1e9,
)
UNITS = ("smile", "frown", "browUp", "pucker")


def icosphere(subdivisions: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit sphere: vertices and outward faces."""
    g = (1 + math.sqrt(5)) / 2
    points = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
    points += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2)]
    faces += [(10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5)]
    faces += [(2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    vertices = [torch.nn.functional.normalize(torch.tensor(p, dtype=torch.float64), dim=0) for p in points]
    for _ in range(subdivisions):
        middles: dict[tuple[int, int], int] = {}

        def middle(a: int, b: int, known: dict[tuple[int, int], int] = middles) -> int:
            key = (min(a, b), max(a, b))
            if key not in known:
                known[key] = len(vertices)
                vertices.append(torch.nn.functional.normalize(vertices[a] + vertices[b], dim=0))
            return known[key]

        finer = []
        for a, b, c in faces:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            finer += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = finer
    return torch.stack(vertices).float(), torch.tensor(faces)


def _bump(
    points: torch.Tensor, centre: tuple[float, float, float], move: tuple[float, float, float]
) -> torch.Tensor:
    """Displacement that is ``move`` at ``centre`` and fades within some 3 cm; exactly zero far away."""
    distance = (points - torch.tensor(centre)).norm(dim=-1)
    fade = (1 - (distance / 0.06).square()).clamp_min(0).square()
    return fade[:, None] * torch.tensor(move)


def _teeth() -> tuple[torch.Tensor, torch.Tensor]:
    """One strip of four quads for each jaw, upper first."""
    x = torch.linspace(-0.02, 0.02, 5)
    z = 0.085 - 12 * x.square()
    rows = [torch.stack([x, torch.full_like(x, y), z], -1) for y in (-0.025, -0.034, -0.036, -0.045)]
    first = torch.arange(4)
    quads = torch.cat(
        [torch.stack([first + 5, first + 6, first], -1), torch.stack([first + 6, first + 1, first], -1)]
    )
    return torch.cat(rows), torch.cat([quads, quads + 10])


def tiny_head() -> HeadModel:
    """A head-sized ellipsoid with teeth, four expressions, two eyelids, one corrective and three identities."""
    sphere, sphere_faces = icosphere()
    skin = sphere * torch.tensor([0.075, 0.11, 0.095])
    teeth, teeth_faces = _teeth()
    template = torch.cat([skin, teeth])
    faces = torch.cat([sphere_faces, teeth_faces + len(skin)])
    part = torch.zeros(len(template), dtype=torch.int64)
    part[len(skin) : len(skin) + 10] = PARTS.index("teeth_upper")
    part[len(skin) + 10 :] = PARTS.index("teeth_lower")
    is_skin = (part == 0).float()[:, None]
    mouth, brow = (0.0, -0.035, 0.09), (0.0, 0.06, 0.08)
    units = [
        _bump(template, (0.02, -0.035, 0.09), (0.004, 0.008, 0.0)),
        _bump(template, (-0.02, -0.035, 0.09), (-0.003, -0.006, 0.0)),
        _bump(template, brow, (0.0, 0.008, 0.0)),
        _bump(template, mouth, (0.0, 0.0, 0.01)),
    ]
    lids = [_bump(template, (x, 0.03, 0.085), (0.0, -0.008, 0.0)) for x in (0.03, -0.03)]
    jaw = (1 / (1 + torch.exp((template[:, 1] + 0.03) / 0.01))) * (template[:, 2] > 0) * 0.9
    jaw[part == PARTS.index("teeth_lower")] = 1.0
    jaw[part == PARTS.index("teeth_upper")] = 0.0
    neck_below = (template[:, 1] < -0.09).float()
    weights = torch.zeros(len(template), 5)
    weights[:, 0] = 0.5 * neck_below
    weights[:, 2] = jaw * (1 - weights[:, 0])
    weights[:, 1] = 1 - weights[:, 0] - weights[:, 2]
    generator = torch.Generator().manual_seed(3)
    front = torch.nonzero(skin[sphere_faces].mean(1)[:, 2] > 0.03)[:, 0]
    landmark_faces = front[torch.randint(len(front), (478,), generator=generator)]
    return HeadModel(
        name="tiny",
        template=template,
        faces=faces,
        shape_basis=0.002 * torch.randn(len(template), 3, 3, generator=generator) * is_skin[..., None],
        expression_basis=torch.stack(units, -1) * is_skin[..., None],
        expression_names=UNITS,
        expression_sigma=torch.full((4,), 0.5),
        expression_lower=torch.zeros(4),
        expression_upper=torch.ones(4),
        eyelid_basis=torch.stack(lids, -1) * is_skin[..., None],
        pose_basis=_bump(template, mouth, (0.0, -0.004, 0.002))[None] * is_skin,
        pose_features=torch.tensor([16]),
        rest_joints=torch.tensor(
            [[0.0, -0.12, -0.03], [0.0, -0.06, -0.02], [0.0, -0.01, 0.02], [0.03, 0.03, 0.06], [-0.03, 0.03, 0.06]]
        ),
        joint_shape_basis=0.001 * torch.randn(5, 3, 3, generator=generator),
        joint_expression_basis=torch.zeros(5, 3, 4),
        skin_weights=weights,
        part=part,
        regions={
            "face": ((template[:, 2] > 0.02) * (part == 0)).float(),
            "lips": ((template - torch.tensor(mouth)).norm(dim=-1) < 0.04).float() * is_skin[:, 0],
            "scalp": ((template[:, 1] > 0.05) * (part == 0)).float(),
            "neck": neck_below,
        },
        landmark_faces=landmark_faces,
        landmark_bary=torch.full((478, 3), 1 / 3),
        landmark_offset=torch.zeros(478, 3),
        landmark_sigma=torch.full((478,), 0.002),
        landmark_mirror=torch.arange(478),
        parents=PARENTS,
    )


def tiny_motion(n_frames: int = 20, seed: int = 0) -> HeadMotion:
    """Smooth talking and nodding half a metre in front of the camera."""
    generator = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, 2 * math.pi, n_frames)[:, None]
    phase = 6 * torch.rand(4, generator=generator)
    joints = torch.zeros(n_frames, 5, 3)
    joints[:, 0, 0] = 0.08 * (2 * time[:, 0]).sin()
    joints[:, 0, 1] = 0.25 * time[:, 0].sin()
    joints[:, 2, 0] = 0.12 * (1 + (3 * time[:, 0]).sin())
    translation = torch.tensor([0.0, 0.0, -0.6]) + 0.005 * torch.cat([time.sin(), time.cos(), (2 * time).sin()], -1)
    lids = (0.5 + 0.5 * (2 * time).cos()).repeat(1, 2)
    return HeadMotion(0.5 + 0.5 * (2 * time + phase).sin(), joints, translation, lids)


def tiny_camera(size: int = 64) -> Camera:
    """A camera that shows the whole tiny head."""
    return tracked_camera(1.8 * size, size, size)


def tiny_sequence(n_frames: int = 20, size: int = 64) -> TrackedSequence:
    """A track of the tiny head with its projected landmarks."""
    head, motion, camera = tiny_head(), tiny_motion(n_frames), tiny_camera(size)
    shape = torch.tensor([0.5, -0.5, 0.2])
    points, _ = head.landmarks().forward(shape, motion)
    pixels, _ = project(camera, points)
    return TrackedSequence(
        head_model=head.name,
        shape=shape,
        motion=motion,
        camera=camera,
        landmarks=Landmarks(pixels, torch.ones(n_frames), size, size),
        tracked=torch.ones(n_frames, dtype=torch.bool),
        error_px=torch.full((n_frames,), 0.5),
        fps=25.0,
        source_sha256="0" * 64,
    )


def tiny_avatar(n: int = 300, seed: int = 0, sh_degree: int = 1) -> Avatar:
    """An avatar on the tiny head with random colours and deltas, as if trained."""
    config = replace(TINY, n_gaussians=n, sh_degree=sh_degree, seed=seed)
    motion = tiny_motion()
    avatar = init_avatar(tiny_head(), torch.tensor([0.5, -0.5, 0.2]), config, motion=motion, camera=tiny_camera())
    generator = torch.Generator().manual_seed(seed)

    def shaken(size: float):
        return lambda tensor: tensor + size * torch.randn(tensor.shape, generator=generator)

    mouth = avatar.mouth_upper.map(shaken(1e-3)), avatar.mouth_lower.map(shaken(1e-3))
    neutral = replace(
        avatar.neutral,
        quats=shaken(0.2)(avatar.neutral.quats),
        log_scales=shaken(0.2)(avatar.neutral.log_scales),
        opacity_logits=shaken(0.5)(avatar.neutral.opacity_logits) + 3,
        sh=shaken(0.3)(avatar.neutral.sh),
    )
    deltas = replace(avatar.deltas, sh=shaken(0.05)(avatar.deltas.sh), quats=shaken(0.02)(avatar.deltas.quats))
    return replace(avatar, neutral=neutral, deltas=deltas, mouth_upper=mouth[0], mouth_lower=mouth[1])
