"""Skinning: rest stays at rest, rigid moves are rigid, children follow."""

from __future__ import annotations

import torch

from toonifygb.geometry import skinning
from toonifygb.geometry.rotations import axis_angle_to_matrix

PARENTS = (-1, 0, 1, 1, 1)


def setup(n: int = 40) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    points = torch.randn(n, 3, dtype=torch.float64)
    weights = torch.rand(n, 5, dtype=torch.float64)
    joints = torch.randn(5, 3, dtype=torch.float64)
    return points, weights / weights.sum(1, keepdim=True), joints


def test_identity_pose_moves_nothing():
    points, weights, joints = setup()
    identity = torch.eye(3, dtype=torch.float64).expand(5, 3, 3)
    transforms = skinning.joint_transforms(identity, joints, PARENTS)
    assert (transforms == torch.eye(4, dtype=torch.float64)).all()
    torch.testing.assert_close(skinning.skin(points, weights, transforms), points)
    assert (skinning.pose_feature(identity) == 0).all()


def test_root_turns_everything_about_the_root_joint():
    points, weights, joints = setup()
    rotations = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1)
    rotations[0] = axis_angle_to_matrix(torch.tensor([0.3, -0.4, 0.5], dtype=torch.float64))
    moved = skinning.skin(points, weights, skinning.joint_transforms(rotations, joints, PARENTS))
    torch.testing.assert_close(moved, (points - joints[0]) @ rotations[0].T + joints[0])


def test_transforms_agree_with_the_chain_of_local_matrices():
    """The textbook twin: G = G_parent · [R | J - J_parent], A = G · [I | -J]."""
    _, _, joints = setup()
    rotations = axis_angle_to_matrix(torch.randn(5, 3, dtype=torch.float64))
    chain: list[torch.Tensor] = []
    for joint, parent in enumerate(PARENTS):
        local = torch.eye(4, dtype=torch.float64)
        local[:3, :3] = rotations[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        chain.append(local if parent < 0 else chain[parent] @ local)
    expected = []
    for joint, matrix in enumerate(chain):
        to_joint = torch.eye(4, dtype=torch.float64)
        to_joint[:3, 3] = -joints[joint]
        expected.append(matrix @ to_joint)
    torch.testing.assert_close(skinning.joint_transforms(rotations, joints, PARENTS), torch.stack(expected))


def test_each_joint_keeps_its_place_under_its_own_rotation():
    _, _, joints = setup()
    rotations = axis_angle_to_matrix(torch.randn(5, 3, dtype=torch.float64))
    transforms = skinning.joint_transforms(rotations, joints, PARENTS)
    for joint, parent in enumerate(PARENTS):
        place = torch.cat((joints[joint], joints.new_ones(1)))
        expected = place if parent < 0 else transforms[parent] @ place
        torch.testing.assert_close(transforms[joint] @ place, expected)


def test_a_point_of_one_joint_moves_with_it_alone():
    points, _, joints = setup()
    rotations = axis_angle_to_matrix(torch.randn(5, 3, dtype=torch.float64))
    transforms = skinning.joint_transforms(rotations, joints, PARENTS)
    weights = torch.eye(5, dtype=torch.float64)[torch.arange(40) % 5]
    moved = skinning.skin(points, weights, transforms)
    for i in range(40):
        one = transforms[i % 5]
        torch.testing.assert_close(moved[i], one[:3, :3] @ points[i] + one[:3, 3])


def test_batches_equal_single_frames():
    points, weights, joints = setup()
    rotations = axis_angle_to_matrix(torch.randn(2, 3, 5, 3, dtype=torch.float64))
    transforms = skinning.joint_transforms(rotations, joints.expand(2, 3, 5, 3), PARENTS)
    assert transforms.shape == (2, 3, 5, 4, 4)
    moved = skinning.skin(points, weights, transforms)
    assert moved.shape == (2, 3, 40, 3) and skinning.pose_feature(rotations).shape == (2, 3, 36)
    one = skinning.joint_transforms(rotations[1, 2], joints, PARENTS)
    torch.testing.assert_close(transforms[1, 2], one)
    torch.testing.assert_close(moved[1, 2], skinning.skin(points, weights, one))
    torch.testing.assert_close(
        skinning.blend_transforms(weights, transforms)[1, 2], skinning.blend_transforms(weights, one)
    )


def test_gradients_reach_rotations_joints_and_weights():
    points, weights, joints = setup(4)
    vectors = torch.randn(5, 3, dtype=torch.float64)

    def forward(v: torch.Tensor, j: torch.Tensor, w: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        return skinning.skin(p, w, skinning.joint_transforms(axis_angle_to_matrix(v), j, PARENTS))

    inputs = [tensor.requires_grad_() for tensor in (vectors, joints, weights, points)]
    assert torch.autograd.gradcheck(forward, inputs)
