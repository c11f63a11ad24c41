"""Value noise in space: the same numbers on every machine, without a random generator."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Float32, UInt32

CORNERS = tuple((x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1))


def value_noise(points: Float[np.ndarray, "n 3"], frequency: float, seed: int) -> Float32[np.ndarray, " n"]:
    """Smooth noise, -1..1, of about ``frequency`` bumps per unit length."""
    scaled = np.asarray(points, np.float64) * frequency
    cell = np.floor(scaled).astype(np.int64)
    inside = (scaled - cell).astype(np.float32)
    inside = inside * inside * (3 - 2 * inside)
    total = np.zeros(len(scaled), np.float32)
    for corner in CORNERS:
        weight = np.ones_like(total)
        for axis, side in enumerate(corner):
            weight *= inside[:, axis] if side else 1 - inside[:, axis]
        total += weight * _hash(cell + np.array(corner), seed)
    return 2 * total - 1


def fractal_noise(
    points: Float[np.ndarray, "n 3"], frequency: float, seed: int, octaves: int = 3
) -> Float32[np.ndarray, " n"]:
    """Sum of value noises of doubling frequency and halving strength, about -1..1."""
    total = sum(
        0.5**octave * value_noise(points, frequency * 2.0**octave, seed + 101 * octave) for octave in range(octaves)
    )
    return np.asarray(total, np.float32) / (2 - 0.5 ** (octaves - 1))


def smoothstep(low: float, high: float, x: Float[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
    """0 below ``low``, 1 above ``high``, smooth between; ``low`` may be the greater one."""
    t = np.clip((np.asarray(x, np.float32) - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _hash(cell: np.ndarray, seed: int) -> Float32[np.ndarray, " n"]:
    """0..1 for each whole-numbered cell: mixing steps of MurmurHash3's finaliser."""
    parts = cell.astype(np.uint32)  # negative cells wrap, which is as good as any other number
    h: UInt32[np.ndarray, " n"] = parts[:, 0] * np.uint32(0x8DA6B343)
    h ^= parts[:, 1] * np.uint32(0xD8163841)
    h ^= parts[:, 2] * np.uint32(0xCB1AB31F)
    h ^= np.uint32((seed * 0x9E3779B1) & 0xFFFFFFFF)
    h ^= h >> np.uint32(16)
    h *= np.uint32(0x85EBCA6B)
    h ^= h >> np.uint32(13)
    h *= np.uint32(0xC2B2AE35)
    h ^= h >> np.uint32(16)
    return (h >> np.uint32(8)).astype(np.float32) / np.float32(1 << 24)
