"""The preview's moving view stays where an avatar has been seen; the report's close-ups show eyes and mouth."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from make import tiny_sequence

from toonifygb.pipeline import pictures
from toonifygb.pipeline.outcome import face_parts, swing_deg
from toonifygb.structures import Split, TrackedSequence
from toonifygb.train import Dataset

if TYPE_CHECKING:
    from pathlib import Path


def turning(degrees: np.ndarray) -> TrackedSequence:
    sequence = tiny_sequence(len(degrees))
    joints = torch.zeros_like(sequence.motion.joints)
    joints[:, 1, 1] = torch.from_numpy(np.radians(degrees)).float()
    return replace(sequence, motion=replace(sequence.motion, joints=joints))


def test_a_head_that_never_turned_is_hardly_walked_around() -> None:
    swing = swing_deg(turning(np.zeros(60)), 25.0)
    assert swing.max() == pytest.approx(15)
    assert swing.min() == pytest.approx(-15)


def test_the_view_keeps_within_the_sides_the_head_showed() -> None:
    yaw = 10 + 25 * np.sin(np.linspace(0, 25, 400))
    swing = swing_deg(turning(yaw), 25.0)
    assert swing.max() > 25
    assert swing.min() < -30
    shown = yaw - swing  # the head's turn as the moving view sees it: 25 degrees filmed to each side and 10 beyond
    assert shown.max() < 10 + 36
    assert shown.min() > 10 - 36
    assert np.abs(np.diff(swing)).max() < 3  # and never jumps


def test_close_ups_are_cut_around_the_eyes_and_the_mouth(tmp_path: Path) -> None:
    sequence = tiny_sequence(4)
    points = torch.full((4, 478, 2), 50.0)
    points[:, [33, 263], :] = torch.tensor([[30.0, 40.0], [70.0, 40.0]])
    points[:, [159, 145, 386, 374], 1] = 40.0
    points[:, [61, 291], :] = torch.tensor([[40.0, 80.0], [60.0, 80.0]])
    points[:, [0, 17], 1] = 80.0
    points[3] = torch.nan
    sequence = replace(sequence, landmarks=replace(sequence.landmarks, points=points))
    boxes = np.array([[10, 20, 110, 120]] * 4)
    crops = Dataset(tmp_path, np.zeros((4, 200, 200, 3), np.uint8), np.zeros((4, 200, 200), np.uint8), boxes,
                    sequence.camera, Split((0, 1), (2, 3)), "x")  # fmt: skip
    eyes, mouth = face_parts(sequence, crops, 0)
    assert eyes == (24, -16, 112)  # centre (80, 40) in the crop, 80 px wide, twice the frame's pixels
    assert mouth == (52, 92, 56)
    assert face_parts(sequence, crops, 3) == []
    image = np.arange(200 * 200 * 3, dtype=np.int64).reshape(200, 200, 3).astype(np.uint8)
    shown = pictures.cut(image, eyes)
    assert shown.shape == (112, 112, 3)
    assert not shown[:16].any()
    assert np.array_equal(shown[16:], image[:96, 24:136])
    assert not pictures.cut(image, (500, 500, 20)).any()
