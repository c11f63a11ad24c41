"""Rotations by their axioms, on random ones and on the hard ones: none, tiny, half a turn."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from toonifygb.geometry import rotations as rot

ANGLES = st.floats(-math.pi, math.pi, allow_nan=False)
VECTORS = st.tuples(ANGLES, ANGLES, ANGLES).map(lambda v: torch.tensor(v, dtype=torch.float64))
TINY = [0.0, 1e-30, 1e-12, 1e-8, 1e-4, 0.1, 0.31, 0.32]
relaxed = settings(deadline=None, max_examples=50)


def random_rotations(n: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    quats = torch.randn(n, 4, dtype=torch.float64)
    return rot.quat_to_matrix(rot.quat_normalize(quats)).to(dtype)


@relaxed
@given(VECTORS)
def test_axis_angle_gives_a_rotation(vector: torch.Tensor):
    matrix = rot.axis_angle_to_matrix(vector)
    torch.testing.assert_close(matrix @ matrix.T, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(matrix) > 0
    torch.testing.assert_close(matrix @ vector, vector)  # the axis stays
    torch.testing.assert_close(rot.axis_angle_to_matrix(-vector), matrix.T)  # the inverse


@relaxed
@given(VECTORS)
def test_axis_angle_agrees_with_the_matrix_exponential(vector: torch.Tensor):
    torch.testing.assert_close(rot.axis_angle_to_matrix(vector), torch.linalg.matrix_exp(rot.skew(vector)))


@relaxed
@given(VECTORS)
def test_axis_angle_round_trip(vector: torch.Tensor):
    matrix = rot.axis_angle_to_matrix(vector)
    back = rot.matrix_to_axis_angle(matrix)
    assert back.norm() <= math.pi + 1e-9
    torch.testing.assert_close(rot.axis_angle_to_matrix(back), matrix, atol=1e-7, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", [*TINY, 1.0, math.pi / 2, 3.0, math.pi - 1e-3])
def test_axis_angle_round_trip_at_hard_angles(angle: float, dtype: torch.dtype):
    axes = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    vectors = (angle * axes).to(dtype)
    back = rot.matrix_to_axis_angle(rot.axis_angle_to_matrix(vectors))
    # Relative to the vector, except where float rounding of the matrix's 1 swallows it.
    torch.testing.assert_close(back, vectors, rtol=1e-5, atol=50 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("angle", TINY)
def test_first_and_second_derivatives_are_smooth_at_the_identity(angle: float):
    vector = torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64) * angle
    vector.requires_grad_()
    assert torch.autograd.gradcheck(rot.axis_angle_to_matrix, vector)
    assert torch.autograd.gradgradcheck(rot.axis_angle_to_matrix, vector)
    assert torch.autograd.gradcheck(lambda v: rot.matrix_to_axis_angle(rot.axis_angle_to_matrix(v)), vector)


def test_gradient_at_the_identity_in_float32_is_the_generator():
    vector = torch.zeros(3, requires_grad=True)
    rot.axis_angle_to_matrix(vector)[2, 1].backward()
    assert vector.grad is not None and vector.grad.tolist() == [1.0, 0.0, 0.0]


def test_quaternion_product_is_composition():
    a, b = random_rotations(200), random_rotations(200)
    product = rot.quat_multiply(rot.matrix_to_quat(a), rot.matrix_to_quat(b))
    torch.testing.assert_close(rot.quat_to_matrix(product), a @ b)


def test_quaternion_product_is_associative_with_identity_and_inverse():
    a, b, c = torch.randn(3, 100, 4, dtype=torch.float64)
    left = rot.quat_multiply(rot.quat_multiply(a, b), c)
    torch.testing.assert_close(left, rot.quat_multiply(a, rot.quat_multiply(b, c)))
    one = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(100, 4)
    torch.testing.assert_close(rot.quat_multiply(one, a), a)
    conjugate = a * torch.tensor([1.0, -1, -1, -1], dtype=torch.float64)
    torch.testing.assert_close(rot.quat_multiply(a, conjugate), one * a.square().sum(-1, keepdim=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_quaternion_of_a_matrix_has_its_largest_component_positive(dtype: torch.dtype):
    half_turns = torch.diag_embed(torch.tensor([[1.0, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1]])).to(dtype)
    matrices = torch.cat((half_turns, random_rotations(500, dtype)))
    quats = rot.matrix_to_quat(matrices)
    largest = quats.gather(-1, quats.abs().argmax(-1, keepdim=True))
    assert (largest > 0).all()
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(quats.norm(dim=-1), torch.ones(504, dtype=dtype), atol=8 * eps, rtol=0)
    torch.testing.assert_close(rot.quat_to_matrix(quats), matrices, atol=16 * eps, rtol=0)


def test_quat_to_matrix_does_not_normalise():
    quat = torch.tensor([2.0, 0.0, 0.0, 1.0])
    expected = torch.tensor([[-1.0, -4.0, 0.0], [4.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(rot.quat_to_matrix(quat), expected)


def test_quat_normalize_keeps_zero_finite():
    quats = torch.tensor([[0.0, 0, 0, 0], [0.0, 3, 0, 4]], requires_grad=True)
    result = rot.quat_normalize(quats)
    torch.testing.assert_close(result, torch.tensor([[0.0, 0, 0, 0], [0.0, 0.6, 0, 0.8]]))
    result.sum().backward()
    assert quats.grad is not None and quats.grad.isfinite().all()


def test_six_numbers_give_rows_of_a_rotation():
    six = torch.randn(100, 6, dtype=torch.float64)
    matrices = rot.rotation_6d_to_matrix(six)
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3, dtype=torch.float64).expand(100, 3, 3))
    assert (torch.linalg.det(matrices) > 0).all()
    exact = random_rotations(100)
    torch.testing.assert_close(rot.rotation_6d_to_matrix(exact[:, :2].flatten(1)), exact)
    identity = rot.rotation_6d_to_matrix(torch.tensor([1.0, 0, 0, 0, 1, 0]))
    assert (identity == torch.eye(3)).all()


def test_polar_factor_is_the_nearest_rotation():
    rotation = random_rotations(100)
    stretch = torch.diag_embed(torch.rand(100, 3, dtype=torch.float64) * 0.6 + 0.7)
    basis = random_rotations(100)
    matrices = rotation @ basis @ stretch @ basis.mT
    torch.testing.assert_close(rot.polar_factor(matrices), rotation, atol=2e-6, rtol=0)
    torch.testing.assert_close(rot.polar_factor(matrices, iterations=8), rotation)
    torch.testing.assert_close(rot.polar_factor(rotation), rotation)
    assert torch.autograd.gradcheck(rot.polar_factor, matrices[:2].clone().requires_grad_())


def test_polar_factor_agrees_with_the_singular_vectors():
    matrices = np.eye(3) + 0.2 * np.random.default_rng(0).normal(size=(50, 3, 3))
    left, _, right = np.linalg.svd(matrices)
    torch.testing.assert_close(rot.polar_factor(torch.from_numpy(matrices), 10), torch.from_numpy(left @ right))


def test_inverse_transpose_agrees_with_the_general_solver():
    matrices = torch.randn(100, 3, 3, dtype=torch.float64) + 2 * torch.eye(3, dtype=torch.float64)
    expected = torch.linalg.inv(matrices).mT
    torch.testing.assert_close(rot.inverse_transpose(matrices), expected, rtol=1e-8, atol=1e-8)


def test_leading_axes_are_kept():
    vectors = torch.randn(2, 5, 3)
    matrices = rot.axis_angle_to_matrix(vectors)
    assert matrices.shape == (2, 5, 3, 3)
    quats = rot.matrix_to_quat(matrices)
    assert quats.shape == (2, 5, 4) and rot.matrix_to_axis_angle(matrices).shape == (2, 5, 3)
    assert rot.quat_to_matrix(quats).shape == (2, 5, 3, 3) and rot.polar_factor(matrices).shape == (2, 5, 3, 3)
    torch.testing.assert_close(matrices[1, 3], rot.axis_angle_to_matrix(vectors[1, 3]))
