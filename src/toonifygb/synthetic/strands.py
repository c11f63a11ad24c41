"""Thin ribbons that always face the camera: hair, brows and lashes."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from toonifygb.synthetic.light import FILL, GROUND, KEY, RIM, SKY
from toonifygb.synthetic.refine import unit

if TYPE_CHECKING:
    from jaxtyping import Bool, Float32, Int64


@dataclass(frozen=True)
class Strands:
    """Hairs of the same number of points, in some frame of reference."""

    points: Float32[np.ndarray, "s k 3"]
    """From root to tip, m."""
    outward: Float32[np.ndarray, "s k 3"]
    """Unit normal of the body of hair around each point: shades the hair as a whole."""
    width: Float32[np.ndarray, "s k"]
    """m."""
    albedo: Float32[np.ndarray, "s k 3"]
    """Linear light."""
    exposure: Float32[np.ndarray, "s k"]
    """Share of light that reaches each point through the hair around it, 0..1."""

    def moved(self, transform: Float32[np.ndarray, "4 4"]) -> Strands:
        """The same hairs under a rigid motion."""
        turn, shift = transform[:3, :3].T, transform[:3, 3]
        return Strands(self.points @ turn + shift, self.outward @ turn, self.width, self.albedo, self.exposure)

    def facing(self, least_cosine: float) -> Strands:
        """Those hairs with a point whose outward normal is turned to a camera at the origin by at least this."""
        cosine = -np.einsum("ski,ski->sk", self.outward, unit(self.points))
        return self.chosen((cosine > least_cosine).any(1))

    def chosen(self, which: Bool[np.ndarray, " s"] | Int64[np.ndarray, " c"]) -> Strands:
        """Some of the hairs, by mask or by number."""
        return Strands(*(getattr(self, field.name)[which] for field in fields(self)))

    def ribbons(self) -> tuple[Float32[np.ndarray, "n 3"], Int64[np.ndarray, "f 3"]]:
        """Mesh for a camera at the origin: two vertices for each point."""
        along = self.tangents()
        across = unit(np.cross(along, self.points)) * (0.5 * self.width[..., None])
        vertices = np.stack([self.points - across, self.points + across], 2)
        n_strands, n_points = self.width.shape
        first = (np.arange(n_strands)[:, None] * n_points + np.arange(n_points - 1)) * 2
        quads = [np.stack([first, first + 1, first + 2], -1), np.stack([first + 1, first + 3, first + 2], -1)]
        return vertices.reshape(-1, 3), np.concatenate([quad.reshape(-1, 3) for quad in quads])

    def tangents(self) -> Float32[np.ndarray, "s k 3"]:
        """Unit direction from root to tip."""
        points = self.points
        ends = [points[:, 1:2] - points[:, :1], points[:, 2:] - points[:, :-2], points[:, -1:] - points[:, -2:-1]]
        return unit(np.concatenate(ends, 1))

    def shade(self, key_seen: Float32[np.ndarray, "s k"]) -> Float32[np.ndarray, "s k 3"]:
        """Linear light towards a camera at the origin (Kajiya and Kay 1989, with a second, coloured highlight)."""
        along, views = self.tangents(), -unit(self.points)
        view_along = np.einsum("ski,ski->sk", along, views)
        up = 0.5 + 0.5 * self.outward[..., 1]
        diffuse = (GROUND + (SKY - GROUND) * up[..., None]) * self.exposure[..., None]
        glint = np.zeros_like(diffuse)
        for lamp, seen in ((KEY, key_seen), (FILL, 1.0), (RIM, 1.0)):
            towards = unit(np.array(lamp.direction, np.float32))
            color = np.array(lamp.color, np.float32)
            light_along = along @ towards
            facing = np.clip((self.outward @ towards + 0.35) / 1.35, 0, 1) * seen * self.exposure
            across = np.sqrt(np.clip(1 - light_along**2, 0, 1))
            diffuse += color * (facing * (0.35 + 0.65 * across))[..., None]
            # Cosine between the mirrored light and the view, both as angles to the strand; the second lobe is
            # shifted towards the root and carries the hair's colour.
            view_across = np.sqrt(np.clip(1 - view_along**2, 0, 1))
            cosine = np.clip(across * view_across - light_along * view_along, 0, 1)
            shifted = np.clip(cosine - 0.10 * (light_along + view_along), 0, 1)
            lobes = 0.075 * cosine[..., None] ** 60 + 0.55 * self.albedo * shifted[..., None] ** 14
            glint += color * facing[..., None] * lobes
        return self.albedo * diffuse + glint
