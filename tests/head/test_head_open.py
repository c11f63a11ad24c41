"""The open head that ships: its parts, its motion, its lips and lids, its file."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest
import torch

from toonifygb import head
from toonifygb.errors import AssetError
from toonifygb.geometry import meshes
from toonifygb.geometry.cameras import tracked_camera
from toonifygb.head import open_head
from toonifygb.render.mesh import rasterize_mesh
from toonifygb.structures import HeadMotion

UNITS = """browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft
cheekSquintRight eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight jawForward mouthClose mouthDimpleLeft
mouthDimpleRight mouthFrownLeft mouthFrownRight mouthFunnel mouthLeft mouthLowerDownLeft mouthLowerDownRight
mouthPressLeft mouthPressRight mouthPucker mouthRight mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper
mouthSmileLeft mouthSmileRight mouthStretchLeft mouthStretchRight mouthUpperUpLeft mouthUpperUpRight noseSneerLeft
noseSneerRight tongueOut""".split()
"""ARKit's units less those that are joints or lids here."""
LID_PAIRS = ((386, 374), (385, 380), (387, 373), (159, 145), (158, 153), (160, 144))
INNER_LIPS = (13, 14)
MM = 1e-3


@pytest.fixture(scope="module")
def model() -> head.HeadModel:
    return head.load("open")


def posed(model: head.HeadModel, shape: torch.Tensor | None = None, **change: dict[int, float]) -> torch.Tensor:
    """Vertices with some expression, eyelid or jaw values set; the jaw by its pitch."""
    motion = HeadMotion(torch.zeros(model.n_expression), torch.zeros(5, 3), torch.zeros(3), torch.zeros(2))
    for index, value in change.get("expression", {}).items():
        motion.expression[index] = value
    for index, value in change.get("eyelids", {}).items():
        motion.eyelids[index] = value
    for index, value in change.get("pitch", {}).items():
        motion.joints[index, 0] = value
    return model.forward(torch.zeros(model.n_shape) if shape is None else shape, motion)[0]


def parts_seen(model: head.HeadModel, vertices: torch.Tensor, centre: torch.Tensor, width_px: int) -> torch.Tensor:
    """Part at each pixel of a frontal close-up, 0.1 mm per pixel from 1 m away; -1 for nothing."""
    shift = torch.tensor([0.0, 0.0, -1.0]) - centre
    hits = rasterize_mesh(vertices + shift, model.faces, tracked_camera(10_000.0, width_px, width_px // 2))
    part = model.part[model.faces[hits.face_id.clamp_min(0), 0]]
    return torch.where(hits.covered, part, -1)


def some_people(model: head.HeadModel) -> list[torch.Tensor]:
    random = torch.Generator().manual_seed(5)
    return [torch.randn(model.n_shape, generator=random) for _ in range(4)]


def test_units_are_arkits(model: head.HeadModel) -> None:
    assert list(model.expression_names) == UNITS
    assert torch.equal(model.expression_lower, torch.zeros(39))
    assert torch.equal(model.expression_upper, torch.ones(39))
    assert (model.expression_sigma > 0).all()
    assert (model.expression_sigma <= 0.5).all()


def test_every_unit_moves_the_skin_and_stays_in_its_half(model: head.HeadModel) -> None:
    move = model.expression_basis.norm(dim=1)
    tongue = model.expression_names.index("tongueOut")
    skin = model.part == 0
    assert (move[skin].amax(0)[torch.arange(39) != tongue] > 1 * MM).all()
    for index, name in enumerate(model.expression_names):
        if name.endswith(("Left", "Right")) and not name.startswith("mouth"):
            side = 1.0 if name.endswith("Left") else -1.0
            other = side * model.template[:, 0] < -15 * MM
            assert move[other, index].max() < 1 * MM, name


def test_numbers_are_in_range(model: head.HeadModel) -> None:
    assert model.faces.min() == 0
    assert model.faces.max() == model.n_vertices - 1
    assert (model.skin_weights >= 0).all()
    assert (model.skin_weights.sum(-1) - 1).abs().max() < 1e-6
    assert set(model.part.unique().tolist()) == set(range(len(head.PARTS)))
    expected = {
        "face",
        "lips",
        "eyelids",
        "brows",
        "ears",
        "scalp",
        "neck",
        "neck_cut",
        "inside_mouth",
        "eye_cavity",
    }
    assert set(model.regions) == expected
    for name, mask in model.regions.items():
        assert mask.min() == 0, name
        assert mask.max() == 1, name
        assert (mask[model.part != 0] == 0).all(), name


def test_size_of_an_adult_head(model: head.HeadModel) -> None:
    """Means of adults: height of the head 22 cm, breadth 15 cm, iris 11.7 mm; the artist's head is near them."""
    skin = model.template[model.part == 0]
    chin = model.landmarks().template[152, 1]
    assert 0.20 < skin[:, 1].max() - chin < 0.24
    crown = skin[skin[:, 1] > 0.07]
    assert 0.13 < crown[:, 0].max() - crown[:, 0].min() < 0.16
    rim = model.landmarks().template[474:478]
    assert (rim[0, 0] - rim[2, 0] - 11.7 * MM).abs() < 0.1 * MM


@pytest.mark.parametrize("name", ["skin", "tongue", "eye_left", "eye_right"])
def test_solid_parts_face_outwards(model: head.HeadModel, name: str) -> None:
    part = head.PARTS.index(name)
    faces = model.faces[(model.part[model.faces] == part).all(-1)]
    a, b, c = (model.template[faces[:, corner]] - model.template[faces].mean((0, 1)) for corner in range(3))
    assert (a * torch.linalg.cross(b, c)).sum() / 6 > 0


@pytest.mark.parametrize("jaw", ["upper", "lower"])
def test_front_teeth_and_gums_face_forwards(model: head.HeadModel, jaw: str) -> None:
    teeth = head.PARTS.index(f"teeth_{jaw}")
    vertices = posed(model)
    faces = model.faces[(model.part[model.faces] >= 2).all(-1)]
    shift = torch.tensor([0.0, 0.0, -1.0]) - vertices[model.part == teeth].mean(0)
    hits = rasterize_mesh(vertices + shift, faces, tracked_camera(4000.0, 160, 80))
    seen = hits.face_id[hits.covered].unique()
    normals = meshes.face_normals(vertices, faces[seen])
    flat = normals[:, 2].abs() > 0.5
    # Between the rows one looks past the biting edges at the backs of the molars: a few faces.
    assert (normals[flat, 2] > 0).float().mean() > 0.9


def test_only_the_neck_is_open(model: head.HeadModel) -> None:
    skin = model.faces[(model.part[model.faces] == 0).all(-1)]
    edges = torch.stack([skin, skin.roll(-1, 1)], -1).reshape(-1, 2).sort(-1).values
    unique, count = edges.unique(dim=0, return_counts=True)
    assert count.max() == 2
    border = unique[count == 1].unique()
    assert torch.equal(border, model.regions["neck_cut"].nonzero()[:, 0])
    assert model.template[border, 1].max() < -0.05


def test_lids_meet_at_one(model: head.HeadModel) -> None:
    landmarks = model.at(model.landmark_faces, model.landmark_bary)
    zero, ones = torch.zeros(model.n_shape), torch.ones(2)
    opened = landmarks.rest(zero)
    closed = landmarks.rest(zero, eyelids=ones)
    for upper, lower in LID_PAIRS:
        assert opened[upper, 1] - opened[lower, 1] > 5 * MM
        assert (closed[upper, 1] - closed[lower, 1]).abs() < 0.3 * MM


def test_blink_covers_the_eyeballs(model: head.HeadModel) -> None:
    eyes = torch.tensor([head.PARTS.index("eye_left"), head.PARTS.index("eye_right")])
    centre = model.rest_joints[3]
    opened = torch.isin(parts_seen(model, posed(model), centre, 400), eyes).sum()
    closed = torch.isin(parts_seen(model, posed(model, eyelids={0: 1.0, 1: 1.0}), centre, 400), eyes).sum()
    assert opened > 10_000
    assert closed < 0.01 * opened


def test_neutral_lips_are_closed(model: head.HeadModel) -> None:
    """From the front no pixel of 0.1 mm passes between the lips, for the mean and for other people."""
    for shape in (torch.zeros(model.n_shape), *some_people(model)):
        vertices = posed(model, shape)
        centre = vertices[model.regions["lips"] > 0.5].mean(0)
        seen = parts_seen(model, vertices, centre, 700)
        assert (seen == 0).all(), [head.PARTS[part] for part in seen.unique().tolist()]


def test_jaw_opens_the_mouth_and_carries_the_lower_teeth(model: head.HeadModel) -> None:
    closed, opened = posed(model), posed(model, pitch={2: 0.3})
    points = model.landmarks()
    motion = HeadMotion(torch.zeros(39), torch.zeros(5, 3), torch.zeros(3), torch.zeros(2))
    motion.joints[2, 0] = 0.3
    lips = points.forward(torch.zeros(model.n_shape), motion)[0]
    assert lips[INNER_LIPS[0], 1] - lips[INNER_LIPS[1], 1] > 15 * MM
    for tissue in ("teeth", "gums"):
        upper = model.part == head.PARTS.index(f"{tissue}_upper")
        assert (opened[upper] - closed[upper]).norm(dim=-1).max() < 0.1 * MM
        lower = model.part == head.PARTS.index(f"{tissue}_lower")
        assert (opened[lower] - closed[lower])[:, 1].mean() < -8 * MM
        before, after = torch.pdist(closed[lower][::20]), torch.pdist(opened[lower][::20])
        # The artist's jawOpen is no pure turn; the pose corrective keeps its last half millimetre.
        assert (before - after).abs().max() < 0.6 * MM
    seen = parts_seen(model, opened, opened[model.regions["lips"] > 0.5].mean(0), 700)
    assert {head.PARTS[part] for part in seen.unique().tolist()} >= {"tongue", "teeth_lower"}


def test_gaze_turns_the_eyeball_and_drags_the_lids(model: head.HeadModel) -> None:
    down = posed(model, pitch={3: 0.35})
    ball = model.part == head.PARTS.index("eye_left")
    pole = model.landmark_faces[473]
    assert down[model.faces[pole], 1].mean() < model.template[model.faces[pole], 1].mean() - 3 * MM
    radius = (down[ball] - model.rest_joints[3]).norm(dim=-1)
    assert (radius - (model.template[ball] - model.rest_joints[3]).norm(dim=-1)).abs().max() < 1e-6
    lid = model.landmarks()
    motion = HeadMotion(torch.zeros(39), torch.zeros(5, 3), torch.zeros(3), torch.zeros(2))
    motion.joints[3, 0] = 0.35
    moved = lid.forward(torch.zeros(model.n_shape), motion)[0] - lid.template
    assert moved[386, 1] < -1 * MM
    assert moved[159, 1].abs() < 0.1 * MM


def test_frown_does_not_fold_the_glabella(model: head.HeadModel) -> None:
    both = {index: 1.0 for index, name in enumerate(model.expression_names) if name.startswith("browDown")}
    faces = model.faces[(model.part[model.faces] == 0).all(-1)]
    before = meshes.face_normals(posed(model), faces)
    after = meshes.face_normals(posed(model, expression=both), faces)
    # Sixty degrees; the builder smooths until none is beyond it.
    assert (before * after).sum(-1).min() > 0.49


def test_landmarks_are_symmetric(model: head.HeadModel) -> None:
    mirror = model.landmark_mirror
    assert torch.equal(mirror[mirror], torch.arange(478))
    points = model.landmarks().template
    reflected = points[mirror] * torch.tensor([-1.0, 1.0, 1.0])
    assert (reflected - points).norm(dim=-1).max() < 0.01 * MM
    assert (model.landmark_bary >= 0).all()
    assert (model.landmark_bary.sum(-1) - 1).abs().max() < 1e-6
    assert (model.landmark_sigma > 0.3 * MM).all()
    assert (model.landmark_sigma < 6 * MM).all()


def test_landmarks_sit_on_the_face(model: head.HeadModel) -> None:
    corners = model.faces[model.landmark_faces]
    assert (model.part[corners[:468]] == 0).all()
    assert (model.part[corners[468:473]] == head.PARTS.index("eye_right")).all()
    assert (model.part[corners[473:]] == head.PARTS.index("eye_left")).all()
    points = model.landmarks().template
    assert points[4, 2] == points[:, 2].max()  # the tip of the nose
    assert points[152, 1] < points[14, 1] < points[13, 1] + 1 * MM < points[4, 1]


def test_what_the_face_cannot_tell_stays_out_of_it(model: head.HeadModel) -> None:
    """Identity's second block moves ears and skull but not the landmarks."""
    second = model.landmarks().shape_basis[..., open_head.FACE_MODES :]
    assert second.square().sum(1).mean(0).sqrt().max() < 0.06 * MM
    elsewhere = model.regions["scalp"] + model.regions["ears"] > 0.5
    moved = model.shape_basis[elsewhere][..., open_head.FACE_MODES :].square().sum((1, 2)).mean().sqrt()
    assert moved > 1 * MM


def test_ears_follow_a_face_known_by_its_landmarks(model: head.HeadModel) -> None:
    """Identity found from landmarks alone with the standard prior: the ears keep their distance to the face."""
    landmarks = model.landmarks().subset(torch.arange(468))
    system = landmarks.shape_basis.flatten(0, 1) / MM
    ears = model.subset((model.regions["ears"] > 0.5).nonzero()[:, 0])
    for truth in some_people(model):
        wanted = system @ truth
        identity = torch.eye(model.n_shape)
        found = torch.linalg.solve(system.T @ system + identity, system.T @ wanted)
        missed = (ears.rest(found) - ears.rest(truth)).norm(dim=-1).mean()
        mean_ears_miss = (ears.template - ears.rest(truth)).norm(dim=-1).mean()
        assert missed < 2 * MM
        assert missed < 0.5 * mean_ears_miss


def test_file_is_small_and_the_recorded_one() -> None:
    path = Path(str(resources.files("toonifygb.head") / "data" / "open_head.safetensors"))
    assert path.stat().st_size <= 5_000_000
    open_head.verify(path)


def test_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "open_head.safetensors"
    path.write_bytes(b"not a head")
    with pytest.raises(AssetError, match=r"open_head.safetensors has sha256 .* hint: reinstall"):
        open_head.verify(path)
