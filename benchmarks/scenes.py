"""The head that speed is measured on: as many Gaussians of the sizes and opacities that training arrives at."""

from __future__ import annotations

import math

import numpy as np
import torch

from toonifygb.structures import Camera, Splats

AXES = np.array([0.085, 0.1, 0.09])
"""Half axes of the ellipsoidal head, m."""
DISTANCE = 0.5
"""Camera to head centre, m."""


def _surface(n: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over a bumpy ellipsoid, and its normals."""
    turn = np.arange(n) + 0.5
    polar, azimuth = np.arccos(1 - 2 * turn / n), math.pi * (1 + math.sqrt(5)) * turn
    directions = np.stack([np.cos(azimuth) * np.sin(polar), np.cos(polar), np.sin(azimuth) * np.sin(polar)], 1)
    directions += random.normal(0, 0.35 * math.sqrt(4 * math.pi / n), directions.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    bumps = 1 + 0.02 * np.sin(7 * directions[:, :1]) * np.cos(5 * directions[:, 1:2])
    normals = directions / AXES
    return directions * AXES * bumps, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _mouth(n: int, random: np.random.Generator) -> np.ndarray:
    """Points in a cylinder behind the lips."""
    radius, angle = 0.028 * np.sqrt(random.random(n)), random.uniform(0, 2 * math.pi, n)
    depth = 0.075 - 0.035 * random.random(n)
    return np.stack([radius * np.cos(angle), -0.038 + 0.7 * radius * np.sin(angle), depth], 1)


def head(n_head: int = 50_000, n_mouth: int = 14_000, degree: int = 3, seed: int = 0) -> Splats:
    """A trained-looking head: flat Gaussians lying on the surface, 45 % of them nearly opaque."""
    random = np.random.default_rng(seed)
    surface, normals = _surface(n_head, random)
    n, up = n_head + n_mouth, random.normal(size=(n_head, 3))
    tangent = np.cross(normals, up)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    spacing = math.sqrt(4 * math.pi * np.prod(AXES) ** (2 / 3) / n_head)
    first = spacing * np.exp(random.normal(0, 0.35, n_head))
    first[random.random(n_head) < 0.06] *= 2.5
    flat = np.stack([first, first * random.uniform(0.4, 1, n_head), 0.25 * first], 1)
    mouth_spacing = (math.pi * 0.028**2 * 0.7 * 0.035 / max(n_mouth, 1)) ** (1 / 3)
    scales = np.concatenate([flat, mouth_spacing * np.exp(random.normal(0, 0.35, (n_mouth, 3)))])

    frames = np.stack([tangent, np.cross(normals, tangent), normals], 2)
    quats = np.concatenate([_quaternions(frames), _unit(random.normal(size=(n_mouth, 4)))])
    faint = random.beta(1.1, 2.5, n) * 0.9 + 0.004
    opacities = np.where(random.random(n) < 0.45, random.uniform(0.75, 0.995, n), faint)
    means = np.concatenate([surface, _mouth(n_mouth, random)])
    sh = random.normal(0, 0.05, (n, (degree + 1) ** 2, 3))
    sh[:, 0] = 0.35 * np.sin(30 * means + np.array([0, 1, 2])) / 0.28209479177387814
    order = random.permutation(n)  # no order in space that a real avatar would not have
    fields = (means, quats, scales, opacities, sh)
    return Splats(*(torch.tensor(field[order], dtype=torch.float32) for field in fields))


def camera(size: int) -> Camera:
    """Square image; the head's silhouette fills about 60 % of it."""
    focal = math.sqrt(0.6 * size * size / (math.pi * AXES[0] * AXES[1])) * math.sqrt(DISTANCE**2 - 0.009)
    K = torch.tensor([[focal, 0, size / 2 + 0.3], [0, focal, size / 2 - 0.2], [0, 0, 1]])
    turn = torch.tensor(0.25)
    transform = torch.eye(4)
    transform[0, 0], transform[0, 2] = turn.cos(), turn.sin()
    transform[2, 0], transform[2, 2] = turn.sin(), -turn.cos()
    transform[1, 1], transform[2, 3] = -1, DISTANCE
    return Camera(K, transform, size, size)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _quaternions(frames: np.ndarray) -> np.ndarray:
    from toonifygb.geometry import rotations

    return rotations.matrix_to_quat(torch.tensor(frames)).numpy()
