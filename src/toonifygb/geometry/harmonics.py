"""Real spherical harmonics up to degree 3, in the sign convention of 3D Gaussian splatting.

Index ``l² + l + m`` for band l and order m, DC first. Directions are unit vectors from the camera's centre to
the Gaussian. Relative to the usual real harmonics every odd index is negated.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

MAX_DEGREE = 3
C0 = 0.28209479177387814
"""The constant band; a DC coefficient c shows as the colour 0.5 + C0·c."""
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def n_coefficients(degree: int) -> int:
    """Coefficients per channel of all bands up to ``degree``."""
    return (degree + 1) ** 2


def degree_of(n: int) -> int:
    """Degree whose bands have ``n`` coefficients together."""
    degree = math.isqrt(n) - 1
    assert n_coefficients(degree) == n and 0 <= degree <= MAX_DEGREE, f"{n} coefficients fill no set of bands"
    return degree


def basis(directions: Float[Tensor, "*b 3"], degree: int) -> Float[Tensor, "*b k"]:
    """Value of every basis function in each unit direction."""
    assert 0 <= degree <= MAX_DEGREE, f"degree {degree} is not within 0..{MAX_DEGREE}"
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            C2[0] * x * y,
            -C2[0] * y * z,
            C2[1] * (2 * zz - xx - yy),
            -C2[0] * x * z,
            C2[2] * (xx - yy),
        ]
        if degree >= 3:
            values += [
                -C3[0] * y * (3 * xx - yy),
                C3[1] * x * y * z,
                -C3[2] * y * (4 * zz - xx - yy),
                C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                -C3[2] * x * (4 * zz - xx - yy),
                C3[4] * z * (xx - yy),
                -C3[0] * x * (xx - 3 * yy),
            ]
    return torch.stack(values, -1)


def color(
    sh: Float[Tensor, "n k 3"], directions: Float[Tensor, "n 3"], degree: int | None = None
) -> Float[Tensor, "n 3"]:
    """Colour seen in each direction: max(0, Σ coefficient·basis + ½), not clamped above.

    Args:
        sh: coefficients, DC first.
        directions: unit vectors from the camera's centre to the Gaussian.
        degree: active degree, at most the stored one; the stored one when ``None``.
    """
    active = degree_of(sh.shape[-2]) if degree is None else degree
    values = basis(directions, active)
    return (torch.einsum("...k,...kc->...c", values, sh[..., : values.shape[-1], :]) + 0.5).clamp_min(0)


def rotate(sh: Float[Tensor, "n k 3"], rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n k 3"]:
    """Coefficients of the function carried along by R: ``f'(d) = f(Rᵀ d)``; the look turns with the Gaussian."""
    bands = [sh[..., :1, :]]
    for band in range(1, degree_of(sh.shape[-2]) + 1):
        block = _band_rotation(rotations, band)
        bands.append(block @ sh[..., band**2 : (band + 1) ** 2, :])
    return torch.cat(bands, -2)


def rotation_matrices(rotations: Float[Tensor, "*b 3 3"], degree: int) -> Float[Tensor, "*b k k"]:
    """Block-diagonal matrices D(R) with ``rotate(sh, R) = D(R) sh``; blocks of 1, 3, 5, 7."""
    k = n_coefficients(degree)
    result = rotations.new_zeros(*rotations.shape[:-2], k, k)
    result[..., 0, 0] = 1
    for band in range(1, degree + 1):
        block = slice(band**2, (band + 1) ** 2)
        result[..., block, block] = _band_rotation(rotations, band)
    return result


def _band_rotation(rotations: Tensor, band: int) -> Tensor:
    """D_l = Y_l(d)⁺ Y_l(Rᵀ d) over a fixed set of probe directions d.

    A band is closed under rotation, so the fit is exact and any set of directions that spans the band would do.
    """
    directions, solve = _probes(band)
    directions, solve = directions.to(rotations), solve.to(rotations)
    turned = torch.einsum("...ab,na->...nb", rotations, directions)
    return solve @ basis(turned, band)[..., band**2 :]


@cache
def _probes(band: int) -> tuple[Tensor, Tensor]:
    """Directions spread evenly over the sphere, and the pseudo-inverse of the band's basis in them.

    Three times as many directions as functions on a golden-angle spiral keep the condition number below 1.5.
    """
    n = 3 * (2 * band + 1)
    i = torch.arange(n, dtype=torch.float64)
    z = 1 - (2 * i + 1) / n
    angle = i * math.pi * (3 - math.sqrt(5))
    radius = (1 - z * z).sqrt()
    directions = torch.stack((radius * angle.cos(), radius * angle.sin(), z), -1)
    return directions, torch.linalg.pinv(basis(directions, band)[:, band**2 :])
