"""The reference renderer: what every other renderer must reproduce, in plain torch.

3D Gaussian splatting exactly as 3DGB's rasteriser does it: the tile rectangle of a Gaussian decides which pixels
can meet it, the order is by float32 depth with ties in input order, a pixel stops *before* the Gaussian that would
make it opaque, the clamp of opacity is ignored by the gradient, and a coordinate held at the frustum margin passes
none. Any floating dtype; autograd differentiates it. Memory is bounded by recomputing tiles in the backward pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from toonifygb.geometry import cameras, harmonics, rotations
from toonifygb.render.base import DEFAULT_CONSTANTS, RasterConstants, RenderInfo, check_splats
from toonifygb.structures import Camera, Rendering, Splats

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

CHUNK = 1024
"""Gaussians composited at once over the pixels of a tile."""


@dataclass(frozen=True)
class Projected:
    """Visible Gaussians on the image, front to back."""

    index: Int[Tensor, " m"]
    """Place in the input."""
    centres: Float[Tensor, "m 2"]
    """px, in the frame where pixel (row i, column j) has its centre at (j, i)."""
    conics: Float[Tensor, "m 3"]
    """Entries xx, xy, yy of the inverse covariance, px⁻²."""
    opacities: Float[Tensor, " m"]
    colors: Float[Tensor, "m 3"]
    radii: Float[Tensor, " m"]
    """px."""
    rectangles: Int[Tensor, "m 4"]
    """Tiles it covers: first column, first row, end column, end row."""


def project(splats: Splats, camera: Camera, sh_degree: int, constants: RasterConstants) -> Projected:
    """Gaussians that touch the image, projected and in depth order."""
    # Dropped ones leave before anything is differentiated: 0 × inf in a backward pass would be NaN.
    candidates = _candidates(splats, camera, constants)
    near = splats.map(lambda field: field[candidates])
    R, t = camera.world_to_camera[:3, :3].to(near.means), camera.world_to_camera[:3, 3].to(near.means)
    points = near.means @ R.T + t
    covariances = _covariances(near, points, R, camera, constants)
    a, b, c = covariances.unbind(-1)
    determinant = a * c - b * b
    conics = torch.stack([c, -b, a], -1) / determinant[:, None]
    x, y, z = points.unbind(-1)
    K = camera.K.to(points)
    centres = torch.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], -1) - 0.5
    directions = near.means - cameras.camera_centre(camera).to(near.means)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    if near.sh_frames is not None:
        directions = torch.einsum("nij,ni->nj", near.sh_frames, directions)
    colors = harmonics.color(near.sh, directions, sh_degree)

    with torch.no_grad():
        middle = (a + c) / 2
        largest = middle + (middle * middle - determinant).clamp_min(0.1).sqrt()
        radii = torch.ceil(constants.radius_sigmas * largest.sqrt())
        rectangles = _rectangles(centres, radii, camera, constants)
        area = (rectangles[:, 2:] - rectangles[:, :2]).prod(-1)
        order = torch.sort(z.float(), stable=True).indices
        order = order[(determinant != 0)[order] & (area > 0)[order]]
    return Projected(
        index=candidates[order],
        centres=centres[order],
        conics=conics[order],
        opacities=near.opacities[order],
        colors=colors[order],
        radii=radii[order],
        rectangles=rectangles[order],
    )


def _candidates(splats: Splats, camera: Camera, constants: RasterConstants) -> Int[Tensor, " c"]:
    """Gaussians in front of the near plane whose every field is finite."""
    with torch.no_grad():
        row = camera.world_to_camera[2].to(splats.means)
        keep = splats.means @ row[:3] + row[3] > constants.near
        for field in (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh, splats.sh_frames):
            if field is not None:
                keep &= field.isfinite().reshape(len(field), math.prod(field.shape[1:])).all(-1)
        return keep.nonzero()[:, 0]


def _covariances(
    splats: Splats, points: Tensor, R: Tensor, camera: Camera, constants: RasterConstants
) -> Float[Tensor, "m 3"]:
    """Entries xx, xy, yy of J W Σ Wᵀ Jᵀ plus the low pass, px² (EWA splatting's affine approximation)."""
    K = camera.K.to(points)
    focal = torch.stack([K[0, 0], K[1, 1]])
    size = points.new_tensor([camera.width, camera.height])
    limit = constants.frustum_margin * 0.5 * size / focal
    z = points[:, 2:]
    ratio = points[:, :2] / z
    clamped = torch.maximum(torch.minimum(ratio, limit), -limit) * z
    held = torch.where(ratio.abs() > limit, clamped.detach(), points[:, :2])
    jacobian = points.new_zeros(len(points), 2, 3)
    jacobian[:, 0, 0], jacobian[:, 1, 1] = (focal / z).unbind(-1)
    jacobian[:, :, 2] = -focal * held / (z * z)
    half = rotations.quat_to_matrix(splats.quats) * splats.scales[:, None, :]
    root = jacobian @ R @ half
    covariance = root @ root.transpose(1, 2)
    low_pass = constants.low_pass
    return torch.stack([covariance[:, 0, 0] + low_pass, covariance[:, 0, 1], covariance[:, 1, 1] + low_pass], -1)


def _rectangles(centres: Tensor, radii: Tensor, camera: Camera, constants: RasterConstants) -> Int[Tensor, "m 4"]:
    """Tiles covered by the square of each radius, cut to the image."""
    tile = constants.tile
    tiles = centres.new_tensor([-(-camera.width // tile), -(-camera.height // tile)])
    first = ((centres - radii[:, None]) / tile).clamp_min(0).minimum(tiles)
    end = ((centres + radii[:, None] + (tile - 1)) / tile).clamp_min(0).minimum(tiles)
    return torch.cat([first, end], -1).trunc().long()


def _over(
    pixels: Float[Tensor, "p 2"],
    packed: Float[Tensor, "n 9"],
    color: Float[Tensor, "p 3"],
    transmittance: Float[Tensor, " p"],
    alive: Bool[Tensor, " p"],
    constants: RasterConstants,
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"], Bool[Tensor, " p"]]:
    """Composites Gaussians, front to back, behind what the pixels already show."""
    centres, conics, opacities, colors = packed.split([2, 3, 1, 3], -1)
    dx, dy = (centres[None] - pixels[:, None]).unbind(-1)
    xx, xy, yy = conics.unbind(-1)
    exponent = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    raw = opacities[:, 0] * torch.exp(exponent.clamp_max(0))
    alpha = raw + (raw.clamp_max(constants.alpha_max) - raw).detach()
    alpha = torch.where((exponent <= 0) & (alpha >= constants.alpha_min), alpha, 0)
    with torch.no_grad():
        after = transmittance[:, None] * torch.cumprod(1 - alpha, 1)
        goes_on = alive[:, None] & (after >= constants.transmittance_min)
    alpha = torch.where(goes_on, alpha, 0)
    passed = torch.cumprod(1 - alpha, 1)
    before = transmittance[:, None] * torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], 1)
    return color + (alpha * before) @ colors, transmittance * passed[:, -1], goes_on[:, -1]


def _composite_tile(
    pixels: Float[Tensor, "p 2"], packed: Float[Tensor, "n 9"], constants: RasterConstants
) -> Float[Tensor, "p 4"]:
    """Colour and remaining transmittance of a tile's pixels."""
    color, transmittance = pixels.new_zeros(len(pixels), 3), pixels.new_ones(len(pixels))
    alive = torch.ones(len(pixels), dtype=torch.bool, device=pixels.device)
    for part in packed.split(CHUNK) if len(packed) else ():
        arguments = (pixels, part, color, transmittance, alive, constants)
        if torch.is_grad_enabled() and packed.requires_grad:
            composited = checkpoint(_over, *arguments, use_reentrant=False, preserve_rng_state=False)
        else:
            composited = _over(*arguments)
        color, transmittance, alive = composited
        if not alive.any():
            break
    return torch.cat([color, transmittance[:, None]], -1)


def _composite(projected: Projected, camera: Camera, constants: RasterConstants) -> Float[Tensor, "h w 4"]:
    """Colour over black and remaining transmittance of every pixel."""
    tile = constants.tile
    corners = [(left, top) for top in range(0, camera.height, tile) for left in range(0, camera.width, tile)]
    left, top, right, bottom = projected.rectangles.unbind(-1)
    members = []
    for x, y in ((x // tile, y // tile) for x, y in corners):
        members.append(((left <= x) & (x < right) & (top <= y) & (y < bottom)).nonzero()[:, 0])
    fields = [projected.centres, projected.conics, projected.opacities[:, None], projected.colors]
    packed = torch.cat(fields, -1)[torch.cat(members)].split([len(member) for member in members])
    rows: list[Tensor] = []
    row: list[Tensor] = []
    for (x, y), part in zip(corners, packed, strict=True):
        width, height = min(tile, camera.width - x), min(tile, camera.height - y)
        grid = torch.cartesian_prod(torch.arange(y, y + height), torch.arange(x, x + width)).flip(-1)
        composited = _composite_tile(grid.to(part), part, constants)
        row.append(composited.reshape(height, width, 4))
        if x + width == camera.width:
            rows.append(torch.cat(row, 1))
            row = []
    return torch.cat(rows, 0)


def _record(info: RenderInfo, projected: Projected, color: Tensor, camera: Camera, n: int) -> Tensor:
    """Fills ``info`` with the radii now, and with the rest when the returned ``color`` is differentiated."""
    radii = torch.zeros(n, dtype=torch.int32, device=color.device)
    info.radii = radii.index_put((projected.index,), projected.radii.to(torch.int32))
    if not color.requires_grad:
        return color
    half = color.new_tensor([camera.width / 2, camera.height / 2])

    def keep_statistic(v_color: Tensor) -> None:
        (gradient,) = torch.autograd.grad(color, projected.centres, v_color, retain_graph=True)
        info.mean2d_gradient = color.new_zeros(n, 2).index_put((projected.index,), gradient * half)

    watched = color.view_as(color)
    watched.register_hook(keep_statistic)
    return watched


class ReferenceRenderer:
    """Renders with plain torch on whatever device and in whatever dtype the splats are."""

    name = "reference"

    def render(
        self,
        splats: Splats,
        camera: Camera,
        *,
        background: Float[Tensor, " 3"] | None = None,
        sh_degree: int | None = None,
        constants: RasterConstants = DEFAULT_CONSTANTS,
        info: RenderInfo | None = None,
    ) -> Rendering:
        """Image of ``splats`` seen by ``camera``; see ``Renderer.render``."""
        projected = project(splats, camera, check_splats(splats, sh_degree), constants)
        image = _composite(projected, camera, constants)
        color, transmittance = image[..., :3], image[..., 3]
        if background is not None:
            color = color + transmittance[..., None] * background.to(color)
        if info is not None:
            color = _record(info, projected, color, camera, len(splats.means))
        return Rendering(color=color, alpha=1 - transmittance)
