"""Eyeballs: spheres with a cornea that follow the centre and radius of MakeHuman's helper eyes.

MakeHuman's eyeballs have a radius of 15.5 mm, half as large again as a human's volume. Here they are smaller with
the front pole where it was, and the lids settle back onto them; seen from the front nothing moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SHRINK = 0.9
"""Radius of our eyeball in units of the helper's."""
IRIS_RADIUS = 0.00585
"""Radius of the iris, m: half the human mean of 11.7 mm."""
CORNEA = 0.03
"""How far the cornea stands out at the pole, in radii."""
SEGMENTS = 24
PUPIL_RINGS = (0.0, 0.17, 0.34)
"""Radii of the innermost rings in units of the iris; the pupil ends between the last of them and the next."""
IRIS_RINGS = (0.46, 0.64, 0.82, 1.0)
SCLERA_DEG = (3.0, 7.0, 13.0, 22.0, 36.0, 55.0, 80.0, 110.0)
"""Angles beyond the limbus of the rings outside the iris; the back pole closes the ball."""


@dataclass(frozen=True)
class Eye:
    """One helper eye: its vertices and how centre and radius follow from them."""

    ids: np.ndarray
    centre: np.ndarray
    radius: float
    directions: np.ndarray

    @staticmethod
    def fit(vertices: np.ndarray, ids: np.ndarray) -> Eye:
        """Sphere through the helper's vertices, least squares."""
        points = vertices[ids]
        equations = np.c_[2 * points, np.ones(len(points))]
        solution = np.linalg.lstsq(equations, (points**2).sum(1), rcond=None)[0]
        centre = solution[:3]
        radius = float(np.sqrt(solution[3] + centre @ centre))
        outwards = points - centre
        return Eye(ids, centre, radius, outwards / np.linalg.norm(outwards, axis=1, keepdims=True))

    def follow(self, vertices: np.ndarray) -> tuple[np.ndarray, float]:
        """Centre and radius of the helper in another shape: least squares over its displacement."""
        points = vertices[self.ids]
        # x_i ≈ c + r d_i, linear in (c, r).
        mean_direction = self.directions.mean(0)
        spread = self.directions - mean_direction
        radius = float((spread * (points - points.mean(0))).sum() / (spread**2).sum())
        return points.mean(0) - radius * mean_direction, radius


@dataclass(frozen=True)
class Ball:
    """Unit eyeball looking along +z."""

    points: np.ndarray
    faces: np.ndarray
    ring: np.ndarray

    @property
    def limbus(self) -> int:
        """Number of the ring at the rim of the iris."""
        return len(PUPIL_RINGS) + len(IRIS_RINGS) - 1


def make_ball(radius: float) -> Ball:
    """Ball whose iris has the human size on a globe of the given radius, m."""
    limbus = np.arcsin(IRIS_RADIUS / radius)
    inner = np.array((*PUPIL_RINGS, *IRIS_RINGS)) * limbus
    angles = np.r_[inner, limbus + np.radians(SCLERA_DEG), np.pi]
    points, ring = [], []
    for number, angle in enumerate(angles):
        count = 1 if number in (0, len(angles) - 1) else SEGMENTS
        bulge = 1 + CORNEA * np.clip(1 - (1 - np.cos(angle)) / (1 - np.cos(1.08 * limbus)), 0, 1)
        for turn in 2 * np.pi * np.arange(count) / SEGMENTS:
            direction = (np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle))
            points.append(bulge * np.array(direction))
            ring.append(number)
    return Ball(np.array(points), _ball_faces(len(angles)), np.array(ring))


def _ball_faces(n_rings: int) -> np.ndarray:
    start = [0] + [1 + SEGMENTS * ring for ring in range(n_rings - 1)]
    faces = []
    for j in range(SEGMENTS):
        k = (j + 1) % SEGMENTS
        faces.append((0, 1 + j, 1 + k))
        for ring in range(1, n_rings - 2):
            a, b = start[ring], start[ring + 1]
            faces += [(a + j, b + j, b + k), (a + j, b + k, a + k)]
        faces.append((start[n_rings - 2] + j, start[n_rings - 1], start[n_rings - 2] + k))
    return np.array(faces)


def settle(points: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Points around an eye moved back onto the smaller ball, along z only.

    A point at distance ρ from the eye's axis moves by the difference of the two spheres' depths there; beyond the
    canthi the shift is held and then fades into the face, and behind the ball's equator nothing moves.
    """
    small = SHRINK * radius
    offset = points - centre
    rho = np.hypot(offset[:, 0], offset[:, 1])
    held = np.minimum(rho, 0.82 * radius)
    depth = (small - np.sqrt(small**2 - held**2)) - (radius - np.sqrt(radius**2 - held**2))
    fade = 1 - _smooth((rho - 0.95 * radius) / (0.75 * radius))
    in_front = _smooth((offset[:, 2] + 0.4 * radius) / (0.6 * radius))
    moved = points.copy()
    moved[:, 2] -= depth * fade * in_front
    return moved


def _smooth(t: np.ndarray) -> np.ndarray:
    """Cubic step from 0 to 1 over t = 0..1."""
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)
