"""FFHQ alignment and the crop rule against the published procedure's own numbers, and Pillow's resampling."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import stylize_scene as scene

from toonifygb.errors import FaceError
from toonifygb.stylize.styleganex.align import FaceMarks, align_face, face_quad, sample_quad, shrink
from toonifygb.stylize.styleganex.frame import CropRule, crop_rule, full_rule, published_rule

N_GOLDEN = 6


def golden_picture(height: int, width: int, phase: float) -> np.ndarray:
    """The closed-form picture the reference arrays were made from: gratings, and a disc with a hard edge."""
    y = (np.arange(height)[:, None] + 0.5) / height
    x = (np.arange(width)[None, :] + 0.5) / width
    disc = ((x - 0.5) ** 2 / 0.09 + (y - 0.45) ** 2 / 0.14 < 1.0).astype(np.float64)
    planes = []
    for c in range(3):
        g = 0.5 + 0.25 * np.sin(2 * np.pi * ((2 + c) * x + (3 - c) * y) + phase + c)
        g = g + 0.15 * np.cos(2 * np.pi * (11 + 3 * c) * x * y + 0.7 * phase)
        inner = 0.3 + 0.2 * c + 0.2 * np.sin(9 * np.pi * (x - y) + phase)
        planes.append((1 - 0.35 * disc) * g + 0.35 * disc * inner)
    return np.clip(np.rint(np.stack(planes, axis=-1) * 255.0), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def golden(golden_dir: Path):
    arrays = np.load(golden_dir / "styleganex" / "align.npz")
    return arrays, json.loads(str(arrays["meta"]))


@pytest.mark.golden
@pytest.mark.parametrize("case", range(N_GOLDEN))
def test_alignment_is_the_published_one(golden, case: int) -> None:
    arrays, meta = golden
    picture = golden_picture(*(meta[case][key] for key in ("height", "width", "phase")))
    ours = align_face(picture, FaceMarks.from_ibug68(arrays[f"lm{case}"])).image.astype(int)
    difference = np.abs(ours - arrays[f"aligned{case}"])
    # one byte of 1.2 million differs: the padded border is blurred in float32 here, in float64 there
    assert difference.max() <= 1
    assert (difference > 0).mean() < 1e-4


@pytest.mark.golden
@pytest.mark.parametrize("case", range(N_GOLDEN))
def test_crop_is_the_published_one(golden, case: int) -> None:
    arrays, meta = golden
    height, width = meta[case]["height"], meta[case]["width"]
    rule = published_rule(FaceMarks.from_ibug68(arrays[f"lm{case}"]), height, width)
    found = [*rule.size, rule.top, rule.bottom, rule.left, rule.right, rule.scale]
    assert found == meta[case]["crop_h_w_top_bottom_left_right_scale"]
    cut = rule.cut(golden_picture(height, width, meta[case]["phase"]))
    assert list(cut.shape) == meta[case]["crop_shape"]
    # OpenCV's builds round bilinear sums differently in the last place
    assert np.abs(cut[::8, ::8].astype(int) - arrays[f"crop_sample{case}"]).max() <= 1


def test_resampling_is_that_of_pillow() -> None:
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed; it is the reference here")
    noise = np.random.default_rng(1).integers(0, 256, (101, 83, 3), dtype=np.uint8)
    small = image.fromarray(noise).resize((31, 40), image.Resampling.LANCZOS)
    assert np.array_equal(shrink(noise, 31, 40), np.asarray(small))
    quad = np.array([[3.2, 4.1], [5.0, 93.0], [80.0, 99.0], [71.0, 6.0]])
    square = image.fromarray(noise).transform((64, 64), image.Transform.QUAD, tuple(quad.ravel()), image.BILINEAR)
    assert np.array_equal(sample_quad(noise, quad, 64), np.asarray(square))


def test_an_aligned_face_is_upright_whatever_the_roll() -> None:
    """The quadrilateral turns with the face and keeps its size."""
    points = scene.face_at(400, 400)
    upright = face_quad(FaceMarks.from_mediapipe(points))
    angle = np.deg2rad(35.0)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    turned = face_quad(FaceMarks.from_mediapipe((points - 200.0) @ turn + 200.0))
    np.testing.assert_allclose(turned + 0.5, (upright + 0.5 - 200.0) @ turn + 200.0, atol=1e-3)


def test_landmark_schemes_agree() -> None:
    """The sides of the face keep their names: the eye on the picture's left comes first."""
    marks = FaceMarks.from_mediapipe(scene.face_at(300, 300))
    assert marks.eye_left[0] < 150 < marks.eye_right[0]
    assert marks.mouth_left[0] < marks.mouth_right[0]
    assert marks.eye_middle[1] < marks.mouth_left[1]
    ibug = np.zeros((68, 2))
    ibug[36:42], ibug[42:48], ibug[48], ibug[54] = (10, 20), (50, 22), (15, 60), (45, 61)
    assert FaceMarks.from_ibug68(ibug).eye_distance == pytest.approx(np.hypot(40, 2))


def test_where_an_aligned_face_was() -> None:
    """``quad`` is in continuous px of the frame: what is there returns to the aligned picture's corners."""
    picture = golden_picture(1300, 1300, 0.3)
    for width in (120.0, 620.0):  # without and with shrinking
        points = (scene.blank_face() * width + 650.0).astype(np.float32)
        aligned = align_face(picture, FaceMarks.from_mediapipe(points))
        there, beside = (
            np.abs(sample_quad(picture, aligned.quad + off, 256).astype(float) - aligned.image).mean()
            for off in (0.0, 1.0)
        )
        assert there < 0.5 * beside


def test_a_face_on_its_side_has_no_published_scale() -> None:
    sideways = FaceMarks(
        *(np.array(place) for place in ((150.0, 90.0), (150.0, 180.0), (100.0, 110.0), (100.0, 160.0)))
    )
    with pytest.raises(FaceError, match="lies on its side"):
        published_rule(sideways, 300, 300)
    assert full_rule(sideways.eye_distance, 300, 300).scale == pytest.approx(64 / 90)


@pytest.mark.parametrize(("height", "width"), [(300, 410), (97, 61), (720, 1280)])
def test_the_whole_frame_is_covered(height: int, width: int) -> None:
    rule = full_rule(50.0, height, width)
    assert rule.is_whole
    assert rule.shape[0] % 8 == rule.shape[1] % 8 == 0
    assert rule.place() == (slice(0, height), slice(0, width))
    assert rule.shape[0] - rule.size[0] < 8 and rule.shape[1] - rule.size[1] < 8


def test_a_crop_follows_the_face_and_stays_in_the_frame() -> None:
    rule = crop_rule(64.0, (1000.0, 300.0), 720, 1280)
    assert rule.shape == (512, 512)
    assert rule.left <= 1000 - 200 and rule.right >= 1000 + 200
    corner = crop_rule(64.0, (5.0, 5.0), 720, 1280)
    assert (corner.top, corner.left) == (0, 0)
    assert not rule.is_whole


def test_a_rule_survives_as_plain_numbers() -> None:
    rule = crop_rule(47.3, (100.0, 90.0), 333, 444)
    assert CropRule.from_state(json.loads(json.dumps(rule.to_state()))) == rule
