"""The preview's moving view stays where an avatar has been seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from make import tiny_sequence

from toonifygb.pipeline.outcome import swing_deg
from toonifygb.structures import TrackedSequence


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
