"""Light: two lamps, a light from behind, the room's glow, and what they make of the materials.

Everything is evaluated at vertices, in linear light; ``display`` turns the result into sRGB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb.render.mesh import rasterize_mesh
from toonifygb.structures import Camera
from toonifygb.synthetic.refine import unit

if TYPE_CHECKING:
    from jaxtyping import Float32, Int64

WRAP = np.array((0.34, 0.15, 0.09), np.float32)
"""How far past the terminator red, green and blue light reach in skin."""
SHADOW_MAP_PX = 256
SHADOW_BIAS_M, DEPTH_BIAS_M = 0.004, 0.002
PENUMBRA_PX = 2.2


@dataclass(frozen=True)
class Lamp:
    """A far light."""

    direction: tuple[float, float, float]
    """Towards the lamp, world axes (x right in the image, y up, z to the viewer)."""
    color: tuple[float, float, float]
    """Linear light, strength included."""


KEY = Lamp((-0.62, 0.62, 0.78), (1.02, 0.96, 0.88))
FILL = Lamp((0.85, 0.10, 0.75), (0.19, 0.215, 0.25))
RIM = Lamp((0.75, 0.55, -0.75), (0.70, 0.68, 0.66))
SKY, GROUND = np.array((0.22, 0.24, 0.27), np.float32), np.array((0.125, 0.105, 0.09), np.float32)
"""The room's glow from above and below."""


@dataclass(frozen=True)
class Surface:
    """Points to be lit."""

    normals: Float32[np.ndarray, "n 3"]
    """Unit, world."""
    views: Float32[np.ndarray, "n 3"]
    """Unit, towards the camera."""
    open_sky: Float32[np.ndarray, " n"]
    """Share of the surroundings that each point sees, 0..1."""
    key_seen: Float32[np.ndarray, " n"]
    """Share of the key lamp that each point sees, 0..1."""


def shade(
    surface: Surface, albedo: np.ndarray, shine: np.ndarray, gloss: np.ndarray, softness: np.ndarray
) -> Float32[np.ndarray, "n 3"]:
    """Linear light leaving each point towards the camera."""
    normals = surface.normals
    sky = surface.open_sky[:, None]
    # Light that bounces in hollows of skin comes back redder.
    glow = sky ** (1 + softness[:, None] * np.array((-0.25, 0.15, 0.25), np.float32))
    up = 0.5 + 0.5 * normals[:, 1:2]
    diffuse = (GROUND + (SKY - GROUND) * up) * glow
    wrap = softness[:, None] * WRAP
    key_seen = surface.key_seen[:, None] ** (1 - 0.45 * softness[:, None] * np.array((1.0, 0.25, 0.0), np.float32))
    glint = np.zeros((len(normals), 3), np.float32)
    grazing = (1 - np.clip(np.einsum("ni,ni->n", normals, surface.views), 0, 1)) ** 4
    for lamp, seen in ((KEY, key_seen), (FILL, sky), (RIM, sky)):
        towards = unit(np.array(lamp.direction, np.float32))
        color = np.array(lamp.color, np.float32)
        cosine = (normals @ towards)[:, None]
        diffuse += color * seen * np.clip((cosine + wrap) / (1 + wrap), 0, 1)
        glint += color * seen * highlight(surface, towards, gloss, grazing)[:, None] * np.clip(4 * cosine, 0, 1)
    sheen = (SKY * 0.35) * sky * grazing[:, None]
    return albedo * diffuse + shine[:, None] * (glint + sheen * softness[:, None])


def highlight(
    surface: Surface, towards: Float32[np.ndarray, " 3"], gloss: np.ndarray, grazing: np.ndarray
) -> Float32[np.ndarray, " n"]:
    """Blinn's highlight with a broad and a narrow lobe, stronger at grazing view."""
    half = unit(surface.views + towards)
    cosine = np.clip(np.einsum("ni,ni->n", surface.normals, half), 1e-4, 1)
    broad = cosine**gloss
    return (0.035 + 0.12 * grazing) * (0.55 * (gloss + 8) / 22 * broad + 0.25 * (gloss + 2) / 8 * broad**4)


def display(light: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Linear light as sRGB 0..1: faithful in the dark, rolled off towards white."""
    x = np.maximum(light, 0)
    return (x / (1 + x**2.5) ** 0.4) ** (1 / 2.2)


@dataclass(frozen=True)
class ShadowMap:
    """How far a far lamp's rays get: distances to the first face, seen from the lamp."""

    depth: Float32[np.ndarray, "s s"]
    camera: Camera

    def visibility(
        self, points: Float32[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"], taps: int = 4
    ) -> Float32[np.ndarray, " n"]:
        """Share of the lamp that each point sees, 0..1, softened over a few pixels of the map.

        Args:
            points: world, m.
            normals: unit; the points are lifted along them so that a surface does not shade itself.
            taps: looks into the map along each axis.
        """
        transform, size = self.camera.world_to_camera.numpy(), self.camera.width
        seen = (points + SHADOW_BIAS_M * normals) @ transform[:3, :3].T + transform[:3, 3]
        pixels = seen[:, :2] / seen[:, 2:] * float(self.camera.K[0, 0]) + size / 2
        offsets = (np.arange(taps) - (taps - 1) / 2) * (2 * PENUMBRA_PX / max(taps - 1, 1))
        columns, rows = (np.clip(pixels[:, axis, None] + offsets, 0, size - 1).astype(np.int64) for axis in (0, 1))
        first_hits = self.depth.reshape(-1)[rows[:, :, None] * size + columns[:, None, :]]
        return (first_hits > (seen[:, 2] - DEPTH_BIAS_M)[:, None, None]).mean((1, 2), dtype=np.float32)


def cast_shadows(
    vertices: Float32[np.ndarray, "v 3"],
    faces: Int64[np.ndarray, "f 3"],
    direction: tuple[float, float, float],
    *,
    size: int = SHADOW_MAP_PX,
    threads: int | None = None,
) -> ShadowMap:
    """What a lamp in that direction sees of a mesh (world, m)."""
    camera = _lamp_camera(vertices, direction, size)
    hits = rasterize_mesh(torch.from_numpy(vertices), torch.from_numpy(faces), camera, threads=threads)
    return ShadowMap(hits.depth.numpy(), camera)


def _lamp_camera(vertices: np.ndarray, direction: tuple[float, float, float], size: int) -> Camera:
    """A camera so far towards the lamp that its rays are parallel, filled by the mesh."""
    backward = unit(-np.array(direction, np.float64))
    right = unit(np.cross(np.array([0.0, 1.0, 0.0]) + 1e-3, backward))
    rotation = np.stack([right, np.cross(backward, right), backward])
    centre = 0.5 * (vertices.min(0) + vertices.max(0))
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    distance = 40 * radius
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ centre + np.array([0, 0, distance])
    focal = size / 2 / (radius / (distance - radius))
    intrinsics = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(intrinsics, torch.from_numpy(transform).float(), size, size)


def open_sky(
    points: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    vertices: Float32[np.ndarray, "v 3"],
    faces: Int64[np.ndarray, "f 3"],
    n_directions: int = 40,
) -> Float32[np.ndarray, " n"]:
    """Ambient occlusion: cosine-weighted share of the directions around each point that leave the mesh."""
    index = np.arange(n_directions) + 0.5
    height = 1 - 2 * index / n_directions
    turn = np.pi * (1 + 5**0.5) * index  # golden-angle spiral: even cover of the sphere
    flat = np.sqrt(1 - height**2)
    seen, total = np.zeros(len(points), np.float32), np.full(len(points), 1e-6, np.float32)
    for x, y, z in zip(flat * np.cos(turn), height, flat * np.sin(turn), strict=True):
        weight = np.maximum(normals @ np.array((x, y, z), np.float32), 0)
        seen += weight * cast_shadows(vertices, faces, (x, y, z), size=128).visibility(points, normals, taps=2)
        total += weight
    return seen / total
