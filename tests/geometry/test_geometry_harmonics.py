"""Spherical harmonics: orthonormal, and carried along by rotations."""

from __future__ import annotations

import math

import pytest
import torch

from toonifygb.geometry import harmonics as sh
from toonifygb.geometry.rotations import axis_angle_to_matrix

COUNTS = {0: 1, 1: 4, 2: 9, 3: 16}


def directions(n: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64), dim=-1)


def turns(n: int) -> torch.Tensor:
    return axis_angle_to_matrix(torch.randn(n, 3, dtype=torch.float64) * 2)


def test_basis_is_orthonormal():
    """Integrated exactly: Gauss-Legendre in z, equal steps around."""
    n = 16
    steps = torch.arange(n, dtype=torch.float64)
    # Nodes and weights from the eigenvalues of the Legendre recurrence (Golub and Welsch).
    k = steps[1:]
    beta = k / (4 * k * k - 1).sqrt()
    nodes, vectors = torch.linalg.eigh(torch.diag(beta, 1) + torch.diag(beta, -1))
    weights = 2 * vectors[0].square() * (2 * math.pi / n)
    angle = 2 * math.pi * steps / n
    z, phi = nodes[:, None].expand(n, n), angle[None].expand(n, n)
    radius = (1 - z * z).sqrt()
    grid = torch.stack((radius * phi.cos(), radius * phi.sin(), z), -1)
    values = sh.basis(grid, 3)
    gram = torch.einsum("i,ijk,ijl->kl", weights, values, values)
    # The published constants have seven to sixteen digits.
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-7, rtol=0)


@pytest.mark.parametrize("degree", COUNTS)
def test_lower_degrees_are_the_first_coefficients(degree: int):
    d = directions(20)
    assert sh.n_coefficients(degree) == COUNTS[degree] and sh.degree_of(COUNTS[degree]) == degree
    torch.testing.assert_close(sh.basis(d, degree), sh.basis(d, 3)[..., : COUNTS[degree]])


@pytest.mark.parametrize("degree", COUNTS)
def test_rotation_carries_the_function_along(degree: int):
    coefficients = torch.randn(50, COUNTS[degree], 3, dtype=torch.float64)
    rotations, d = turns(50), directions(50)
    back = torch.einsum("nij,ni->nj", rotations, d)  # Rᵀ d
    seen = torch.einsum("nk,nkc->nc", sh.basis(d, degree), sh.rotate(coefficients, rotations))
    expected = torch.einsum("nk,nkc->nc", sh.basis(back, degree), coefficients)
    torch.testing.assert_close(seen, expected)


def test_rotation_matrices_are_a_group_of_orthogonal_blocks():
    a, b = turns(30), turns(30)
    matrix = sh.rotation_matrices(a, 3)
    torch.testing.assert_close(matrix @ sh.rotation_matrices(b, 3), sh.rotation_matrices(a @ b, 3))
    identity = torch.eye(16, dtype=torch.float64).expand(30, 16, 16)
    torch.testing.assert_close(matrix @ matrix.mT, identity, atol=1e-6, rtol=0)
    torch.testing.assert_close(sh.rotation_matrices(torch.eye(3, dtype=torch.float64), 3), identity[0])
    outside = torch.ones(16, 16, dtype=torch.bool)
    for band in range(4):
        outside[band**2 : (band + 1) ** 2, band**2 : (band + 1) ** 2] = False
    assert (matrix[:, outside] == 0).all()


def test_rotating_coefficients_equals_the_matrices():
    coefficients, rotations = torch.randn(40, 16, 3, dtype=torch.float64), turns(40)
    torch.testing.assert_close(
        sh.rotate(coefficients, rotations), sh.rotation_matrices(rotations, 3) @ coefficients
    )


def test_float32_rotation_is_accurate():
    coefficients, rotations = torch.randn(200, 16, 3), turns(200)
    exact = sh.rotate(coefficients.double(), rotations)
    torch.testing.assert_close(sh.rotate(coefficients, rotations.float()).double(), exact, atol=5e-6, rtol=0)


def test_color_is_half_grey_without_light_and_never_negative():
    d = directions(10)
    empty = torch.zeros(10, 16, 3, dtype=torch.float64)
    assert (sh.color(empty, d) == 0.5).all()
    dark = empty.clone()
    dark[:, 0] = -10
    assert (sh.color(dark, d) == 0).all()
    bright = empty.clone()
    bright[:, 0] = 10
    assert (sh.color(bright, d) > 3).all()  # not clamped above


def test_color_uses_the_active_degree_only():
    coefficients, d = torch.randn(10, 16, 3, dtype=torch.float64) * 0.1, directions(10)
    cut = coefficients.clone()
    cut[:, 4:] = 0
    torch.testing.assert_close(sh.color(coefficients, d, 1), sh.color(cut, d, 3))
    torch.testing.assert_close(sh.color(coefficients[:, :4], d), sh.color(coefficients, d, 1))


def test_gradients():
    coefficients = torch.rand(3, 9, 3, dtype=torch.float64, requires_grad=True)
    rotations = turns(3).requires_grad_()
    assert torch.autograd.gradcheck(sh.rotate, (coefficients, rotations))
    assert torch.autograd.gradcheck(lambda c, d: sh.color(c, d), (coefficients, directions(3).requires_grad_()))


def test_a_count_between_two_degrees_is_refused():
    with pytest.raises(AssertionError, match="5 coefficients"):
        sh.degree_of(5)
