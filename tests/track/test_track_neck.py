"""The neck takes the turn; the head stays where it was tracked and the body stands still."""

from __future__ import annotations

import torch
from make import tiny_head, tiny_motion

from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.track.neck import on_a_neck

SHAPE = torch.tensor([0.5, -0.5, 0.2])


def test_the_head_stays_and_the_body_stands_still() -> None:
    head, motion = tiny_head(), tiny_motion(12)
    joints = motion.joints.clone()
    joints[:, 1] = 0
    joints[:, 0] += torch.linspace(-0.4, 0.5, 12)[:, None] * torch.tensor([0.3, 1.0, 0.1])
    motion = motion.map(torch.clone)
    motion.joints.copy_(joints)
    bent = on_a_neck(motion, head, SHAPE)
    before, after = (head.forward(SHAPE, each) for each in (motion, bent))
    on_head = head.skin_weights[:, 0] == 0
    assert on_head.any()
    assert (~on_head).any()
    assert (before[0] - after[0])[:, on_head].norm(dim=-1).max() < 1e-6
    body = axis_angle_to_matrix(bent.joints[:, 0])
    assert (body - body[0]).abs().max() < 1e-6
    chest = torch.tensor([0.0, -0.3, 0.0])
    travel = []
    for (_, transforms), each in ((before, motion), (after, bent)):
        carried = transforms[:, 0, :3, :3] @ chest + transforms[:, 0, :3, 3] + each.translation
        travel.append(carried.std(0).norm())
    assert travel[1] < 0.5 * travel[0]


def test_one_direction_needs_no_neck() -> None:
    head, motion = tiny_head(), tiny_motion(5)
    joints = motion.joints.clone()
    joints[:, :2] = torch.tensor([[0.1, 0.4, -0.05], [0.0, 0.0, 0.0]])
    motion.joints.copy_(joints)
    bent = on_a_neck(motion, head, SHAPE)
    assert (bent.joints - motion.joints).abs().max() < 1e-5
    assert (bent.translation - motion.translation).abs().max() < 1e-6
