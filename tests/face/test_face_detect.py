"""Detection: merging rules, tiles, and faces of all sizes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from drawn_face import draw_face

from toonifygb.face.crop import Square
from toonifygb.face.detect import (
    Detector,
    FaceFinder,
    distinct,
    face_square,
    overlap,
    tile_levels,
    weighted_suppression,
)
from toonifygb.structures import Detection


@pytest.fixture(scope="module")
def finder() -> FaceFinder:
    return FaceFinder()


def scene(height: int, width: int, *faces: tuple[int, int, int]) -> np.ndarray:
    """A grey image with drawn faces at (left, top, side)."""
    image = np.full((height, width, 3), (128, 132, 140), np.uint8)
    for left, top, side in faces:
        image[top : top + side, left : left + side] = draw_face(side)
    return image


def test_overlap_of_known_boxes() -> None:
    a = np.array([[0.0, 0, 4, 4]])
    b = np.array([[0.0, 0, 4, 4], [2, 0, 6, 4], [4, 4, 8, 8], [1, 1, 3, 3]])
    np.testing.assert_allclose(overlap(a, b)[0], [1, 8 / 24, 0, 4 / 16])


def test_weighted_suppression_averages_a_group_and_keeps_strangers() -> None:
    boxes = np.array([[0.0, 0, 10, 10], [50, 50, 60, 60], [2, 0, 12, 10]])
    keypoints = np.arange(36.0).reshape(3, 6, 2)
    scores = np.array([0.6, 0.7, 0.9])
    first, second = weighted_suppression(boxes, keypoints, scores)
    np.testing.assert_allclose(first[0], (0.9 * boxes[2] + 0.6 * boxes[0]) / 1.5)
    np.testing.assert_allclose(first[1], (0.9 * keypoints[2] + 0.6 * keypoints[0]) / 1.5)
    assert first[2] == 0.9
    np.testing.assert_allclose(second[0], boxes[1])
    assert weighted_suppression(boxes[:0], keypoints[:0], scores[:0]) == []


def test_distinct_keeps_the_best_of_each_face() -> None:
    def at(x: float, score: float) -> Detection:
        return Detection(torch.tensor([x, 0, x + 10, 10]), torch.zeros(6, 2), score)

    kept = distinct([at(0, 0.6), at(1, 0.8), at(30, 0.5)])
    assert [one.score for one in kept] == [0.8, 0.5]


@pytest.mark.parametrize("size", [(720, 1080), (1920, 1080), (3840, 2160), (320, 240)])
def test_finest_tiles_hold_every_small_face_whole(size: tuple[int, int]) -> None:
    width, height = size
    *_, finest = tile_levels(width, height)
    side = finest[0].side
    face = 0.25 * side
    for x in np.linspace(face / 2, width - face / 2, 25):
        for y in np.linspace(face / 2, height - face / 2, 25):
            reach = (side - face) / 2 + 1e-6
            assert any(abs(t.x - x) <= reach and abs(t.y - y) <= reach for t in finest)


def test_the_face_square_levels_the_eyes() -> None:
    points = torch.zeros(6, 2)
    points[0], points[1] = torch.tensor([0.0, 0]), torch.tensor([1.0, 1])
    square = face_square(Detection(torch.tensor([10.0, 20, 30, 60]), points, 1.0))
    assert (square.x, square.y, square.side) == (20, 40, 60)
    assert square.angle == pytest.approx(np.pi / 4)


def test_both_detectors_agree_on_a_plain_face() -> None:
    image = scene(400, 400, (80, 80, 240))
    whole = [Square(200, 200, 400)]
    (near,), (far,) = Detector.near().detect(image, whole), Detector.far().detect(image, whole)
    assert overlap(near.box.numpy()[None], far.box.numpy()[None])[0, 0] > 0.6
    assert (near.keypoints - far.keypoints).norm(dim=1).max() < 0.06 * 240
    eyes = torch.tensor([[0.385, 0.43], [0.615, 0.43]]) * 240 + 80
    assert (near.keypoints[:2] - eyes).norm(dim=1).max() < 0.03 * 240


@pytest.mark.parametrize(
    ("height", "width", "face_px"),
    [(1080, 720, 40), (1080, 1920, 40), (1080, 1920, 170), (2160, 3840, 60), (260, 260, 130)],
)
def test_faces_from_40_px_are_found(finder: FaceFinder, height: int, width: int, face_px: int) -> None:
    side = round(face_px / 0.515)
    left, top = (width - side) * 2 // 3, (height - side) // 4
    image = scene(height, width, (left, top, side))
    eyes = np.array([[0.385, 0.43], [0.615, 0.43]]) * side + [left, top]
    for detections in finder.levels(image, thorough=True):
        for one in detections:
            if np.abs(one.keypoints[:2].numpy() - eyes).max() < 0.15 * face_px:
                return
    pytest.fail("not found on any level")


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_turned_clips_are_found_on_the_last_level(finder: FaceFinder, turn: int) -> None:
    image = np.ascontiguousarray(np.rot90(scene(300, 400, (100, 40, 220)), turn))
    found = [one for level in finder.levels(image, thorough=True) for one in level]
    angles = [face_square(one).angle for one in found]
    expected = [-np.pi / 2, np.pi, np.pi / 2][turn - 1]
    assert min(abs(np.angle(np.exp(1j * (a - expected)))) for a in angles) < 0.3


def test_an_empty_image_has_no_face(finder: FaceFinder) -> None:
    ramp = cv2.resize(np.array([[30, 90], [160, 220]], np.uint8), (640, 360))[..., None].repeat(3, 2)
    assert not [one for level in finder.levels(ramp, thorough=True) for one in level]
