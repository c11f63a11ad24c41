"""The nearest point of a triangle mesh, among those that face the same way."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.meshes import barycentric, face_normals, vertex_normals

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

NEIGHBOURS = 3
"""Nearest vertices whose triangles are searched."""
_POINTS_AT_ONCE = 1024


class Surface:
    """A mesh that can be asked for its nearest points.

    Points on the two sides of something thin (lips, lids, ears) are near each other and face opposite ways. So a
    point of the mesh counts as far as √(d² + reach² (1 - cos)), with the angle between its normal and the asker's.

    Args:
        vertices: m.
        faces: counter-clockwise seen from outside.
        reach: distance that opposite normals are worth, over √2, m.
    """

    def __init__(self, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], reach: float) -> None:
        self.vertices, self.faces = vertices, faces
        self.face_normals = face_normals(vertices, faces)
        self._weight = reach / 2**0.5
        self._ids = faces.unique()
        self._places = self._lifted(vertices, vertex_normals(vertices, faces))[self._ids]
        self._rings = _rings(faces, len(vertices))

    def closest(
        self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
    ) -> tuple[Int[Tensor, " n"], Float[Tensor, "n 3"]]:
        """Face and barycentric coordinates of the point nearest to each given one, whose unit normals count too."""
        face_ids, mixes = [], []
        for block, facing in zip(points.split(_POINTS_AT_ONCE), normals.split(_POINTS_AT_ONCE), strict=True):
            apart = torch.cdist(self._lifted(block, facing), self._places)
            near = apart.topk(min(NEIGHBOURS, len(self._ids)), largest=False).indices
            candidates = self._rings[self._ids[near]].flatten(1)
            corners = self.vertices[self.faces[candidates]]
            asked = block[:, None].expand(-1, candidates.shape[1], -1)
            mix = closest_on_triangle(asked, corners)
            found = torch.einsum("nkc,nkcx->nkx", mix, corners)
            turned = 1 - torch.einsum("nkx,nx->nk", self.face_normals[candidates], facing)
            best = ((found - asked).square().sum(-1) + 2 * self._weight**2 * turned).argmin(-1, keepdim=True)
            face_ids.append(candidates.gather(1, best)[:, 0])
            mixes.append(mix.take_along_dim(best[..., None], 1)[:, 0])
        return torch.cat(face_ids), torch.cat(mixes)

    def at(self, face_ids: Int[Tensor, " n"], mix: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Positions of points of the surface, m."""
        return barycentric(self.vertices, self.faces, face_ids, mix)

    def _lifted(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 6"]:
        return torch.cat([points, self._weight * normals], -1)


def closest_on_triangle(points: Float[Tensor, "*b 3"], corners: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Barycentric coordinates of the point of each triangle nearest to its point.

    The nearest point is the foot on the plane where that lies inside, else it is on one of the edges.
    """
    first, second = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    arm = points - corners[..., 0, :]
    a, b, c = (first * first).sum(-1), (first * second).sum(-1), (second * second).sum(-1)
    d, e = (arm * first).sum(-1), (arm * second).sum(-1)
    area = (a * c - b * b).clamp_min(torch.finfo(points.dtype).tiny)
    v, w = (c * d - b * e) / area, (a * e - b * d) / area
    foot = torch.stack([1 - v - w, v, w], -1)
    options = [torch.where((foot >= 0).all(-1, keepdim=True), foot, torch.inf)]
    for start, end in ((0, 1), (1, 2), (2, 0)):
        along = corners[..., end, :] - corners[..., start, :]
        length = along.square().sum(-1).clamp_min(torch.finfo(points.dtype).tiny)
        share = (((points - corners[..., start, :]) * along).sum(-1) / length).clamp(0, 1)
        mix = torch.zeros_like(foot)
        mix[..., start], mix[..., end] = 1 - share, share
        options.append(mix)
    mixes = torch.stack(options, -2)
    apart = (mixes @ corners - points[..., None, :]).square().sum(-1).nan_to_num(nan=torch.inf)
    best = apart.argmin(-1)[..., None, None]
    return mixes.take_along_dim(best, -2)[..., 0, :]


def _rings(faces: Int[Tensor, "f 3"], n_vertices: int) -> Int[Tensor, "v r"]:
    """Faces around each vertex; short rows repeat their first."""
    owners = faces.flatten()
    order = owners.argsort(stable=True)
    counts = torch.bincount(owners, minlength=n_vertices)
    start = counts.cumsum(0) - counts
    slot = torch.arange(int(counts.max()))
    slot = torch.where(slot < counts[:, None], slot, 0)
    return (order[(start[:, None] + slot).clamp_max(len(order) - 1)] // 3).contiguous()
