"""Rotations: axis-angle, quaternions, matrices, 6D, and the rotation nearest to a matrix.

Conventions: column vectors (``v' = R v``), right-handed angles in rad, quaternions ``(w, x, y, z)`` with the
Hamilton product. Everything is differentiable, also at the identity, where the textbook formulae divide 0 by 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

_SERIES_BELOW = 0.1
"""Squared angle under which the power series replace the closed forms: with the terms kept their error is
below 1e-15, and above it the closed forms have no cancellation left."""
_SINC_SERIES = (1.0, -1 / 6, 1 / 120, -1 / 5040, 1 / 362_880, -1 / 39_916_800)
"""sin(√t)/√t in powers of t."""
_ATAN_SERIES = tuple((-1) ** k / (2 * k + 1) for k in range(13))
"""atan(√u)/√u in powers of u."""


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation about the vector's direction by its length in rad (Rodrigues' formula)."""
    squared = axis_angle.square().sum(-1)[..., None, None]
    cross = skew(axis_angle)
    # (1 - cos θ)/θ² = sinc²(θ/2)/2: the same smooth function serves both coefficients.
    half = _sinc_of_square(squared / 4)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + _sinc_of_square(squared) * cross + 0.5 * half.square() * (cross @ cross)


def matrix_to_axis_angle(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Vector along the rotation's axis with its angle, 0..π rad, as length.

    At exactly π the axis' sign is arbitrary, as it must be.
    """
    quat = matrix_to_quat(matrix)
    quat = torch.where(quat[..., :1] < 0, -quat, quat)
    w, axis = quat[..., :1], quat[..., 1:]
    squared = axis.square().sum(-1, keepdim=True)
    near = squared < _SERIES_BELOW
    # Both branches see harmless stand-ins where the other is chosen, so that no NaN enters the gradient.
    one = torch.ones_like(w)
    safe_w = torch.where(near, w, one)
    series = _polynomial(torch.where(near, squared / safe_w.square(), 0 * one), _ATAN_SERIES) / safe_w
    sine = torch.where(near, one, squared).sqrt()
    closed = torch.atan2(sine, w) / sine
    return 2 * torch.where(near, series, closed) * axis


def quat_to_matrix(quat: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Matrix of a quaternion taken as it is: the unit formula, *without* normalising first.

    3DGB's rasteriser does the same, so a quaternion of another length gives a matrix that is no rotation, and
    gradients agree with it.
    """
    w, x, y, z = quat.unbind(-1)
    entries = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return torch.stack(entries, -1).unflatten(-1, (3, 3))


def matrix_to_quat(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion of a rotation, its largest component positive.

    The largest component is found first and the others are divided by it, which is accurate for every angle.
    ``w`` is therefore positive up to 90 degrees at least.
    """
    m = matrix.flatten(-2)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m.unbind(-1)
    # Row i is 4·q_i·(w, x, y, z); its own entry is 4·q_i².
    ww, xx = 1 + m00 + m11 + m22, 1 + m00 - m11 - m22
    yy, zz = 1 - m00 + m11 - m22, 1 - m00 - m11 + m22
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m10 + m01, m02 + m20, m21 + m12
    rows = torch.stack((ww, wx, wy, wz, wx, xx, xy, xz, wy, xy, yy, yz, wz, xz, yz, zz), -1).unflatten(-1, (4, 4))
    squares = torch.stack((ww, xx, yy, zz), -1)
    largest = squares.argmax(-1, keepdim=True)
    row = rows.gather(-2, largest[..., None].expand(*largest.shape, 4)).squeeze(-2)
    return row / (2 * squares.gather(-1, largest).sqrt())


def quat_multiply(a: Float[Tensor, "*b 4"], b: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """Hamilton product: the rotation ``b`` followed by ``a``."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    entries = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return torch.stack(entries, -1)


def quat_normalize(quat: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """Quaternion scaled to length 1; zero stays zero."""
    return torch.nn.functional.normalize(quat, dim=-1, eps=1e-12)


def rotation_6d_to_matrix(rotation: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation whose first two *rows* are the Gram-Schmidt orthonormalised halves; 1,0,0,0,1,0 is the identity."""
    first = torch.nn.functional.normalize(rotation[..., :3], dim=-1)
    second = rotation[..., 3:]
    second = second - (first * second).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second)), -2)


def polar_factor(matrix: Float[Tensor, "*b 3 3"], iterations: int = 3) -> Float[Tensor, "*b 3 3"]:
    """Rotation part of a matrix with positive determinant, by Newton's iteration R ← ½(R + R⁻ᵀ).

    Three steps are 3DGB's choice and part of its numbers; they reach 2e-6 for singular values within ±30 %.
    """
    rotation = matrix
    for _ in range(iterations):
        rotation = 0.5 * (rotation + inverse_transpose(rotation))
    return rotation


def inverse_transpose(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """M⁻ᵀ as cofactors over determinant: for many 3×3 matrices far quicker than a general solver."""
    first, second, third = matrix.unbind(-2)
    crosses = (
        torch.linalg.cross(second, third),
        torch.linalg.cross(third, first),
        torch.linalg.cross(first, second),
    )
    determinant = (first * crosses[0]).sum(-1)
    return torch.stack(crosses, -2) / determinant[..., None, None]


def skew(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Matrix that takes the cross product from the left: ``skew(a) b = a × b``."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))


def _sinc_of_square(t: Tensor) -> Tensor:
    """sin(√t)/√t, smooth at 0 with all derivatives."""
    near = t < _SERIES_BELOW
    root = torch.where(near, torch.ones_like(t), t).sqrt()
    return torch.where(
        near, _polynomial(torch.where(near, t, torch.zeros_like(t)), _SINC_SERIES), root.sin() / root
    )


def _polynomial(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """Σ cₖ xᵏ by Horner's rule."""
    value = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * x + coefficient
    return value
