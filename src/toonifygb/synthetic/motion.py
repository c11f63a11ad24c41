"""How the subject moves: talking, blinking, looking about, and one expression after another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb.structures import HeadMotion

if TYPE_CHECKING:
    from jaxtyping import Float

    from toonifygb.head import HeadModel

Visemes = tuple[tuple[float, dict[str, float]], ...]

VISEMES: Visemes = (
    (0.24, {}),
    (0.12, {"mouthFunnel": 0.55}),
    (0.05, {"mouthPucker": 0.65}),
    (0.10, {"mouthStretch": 0.40, "mouthUpperUp": 0.35, "mouthLowerDown": 0.40}),
    (0.00, {"mouthPress": 0.35, "mouthRollLower": 0.35, "mouthRollUpper": 0.30}),
    (0.17, {"mouthShrugUpper": 0.30, "mouthLowerDown": 0.25}),
)
"""Jaw opening (rad) and unit weights at the height of each mouth shape of speech."""

FAMILIES: tuple[dict[str, float], ...] = (
    {"mouthSmile": 0.85, "cheekSquint": 0.5, "eyeSquint": 0.25, "mouthUpperUp": 0.15},
    {"browInnerUp": 0.8, "browOuterUp": 0.8, "eyeWide": 0.7},
    {"mouthPucker": 0.85, "mouthFunnel": 0.2},
    {"browDown": 0.65, "eyeSquint": 0.45, "mouthPress": 0.3},
    {"mouthLeft": 0.75, "mouthDimpleLeft": 0.5},
    {"cheekPuff": 0.8, "mouthRollLower": 0.2},
    {"noseSneer": 0.7, "mouthUpperUp": 0.45, "browDown": 0.3},
    {"mouthFrown": 0.8, "browInnerUp": 0.6, "mouthShrugLower": 0.5},
    {"mouthRight": 0.75, "mouthDimpleRight": 0.5},
    {"jaw": 0.36, "browInnerUp": 0.6, "browOuterUp": 0.6, "eyeWide": 0.8},
)
"""Expressions shown in turn; a name without side means both sides, ``jaw`` is the opening in rad."""

YAW_DEG, PITCH_DEG, ROLL_DEG = 25.0, 10.0, 6.0
"""Farthest turns of the head."""
BLINK_EVERY_S, BLINK_S = 2.3, 0.085
FAMILY_S = 0.9
"""Time that each expression takes to come and go."""


@dataclass(frozen=True)
class _Track:
    """Curves under construction."""

    time: Float[np.ndarray, " t"]
    names: tuple[str, ...]
    expression: Float[np.ndarray, "t e"]
    jaw: Float[np.ndarray, " t"]

    def add(self, curve: Float[np.ndarray, " t"], weights: dict[str, float]) -> None:
        """Adds ``curve`` times each weight to its unit, both sides of it, or the jaw."""
        for name, weight in weights.items():
            if name == "jaw":
                self.jaw[:] += weight * curve
                continue
            columns = [i for i, unit in enumerate(self.names) if unit in (name, f"{name}Left", f"{name}Right")]
            assert columns, f"the head model has no expression unit {name}"
            self.expression[:, columns] += weight * curve[:, None]


def make_motion(head: HeadModel, n_frames: int, fps: float, seed: int) -> HeadMotion:
    """Motion of a talking person, leading axis = frame.

    The head turns by its neck joint within ``YAW_DEG`` and ``PITCH_DEG``, the body sways a little with the root,
    the eyes turn against the head. The translation puts the head in front of a ``tracked_camera`` with a focal
    length of 1.42 image heights.
    """
    rng = np.random.Generator(np.random.Philox(seed + 4000))
    time = np.arange(n_frames) / fps
    track = _Track(time, head.expression_names, np.zeros((n_frames, head.n_expression)), np.zeros(n_frames))
    shows = _show_families(track, rng)
    _talk(track, rng, quiet=shows)
    _brows_and_smile(track, rng)
    joints = _pose(track, rng)
    lids = _blinks(time, rng)
    sway = np.stack(
        [_wave(time, rng, rate, size) for rate, size in ((0.10, 0.008), (0.12, 0.005), (0.08, 0.014))], 1
    )
    translation = sway + np.array((0.0, -0.004, -0.585))

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    return HeadMotion(tensor(track.expression.clip(0, 1)), tensor(joints), tensor(translation), tensor(lids))


def _show_families(track: _Track, rng: np.random.Generator) -> Float[np.ndarray, " t"]:
    """Adds one expression after another, with a second of speech between them; returns where they show, 0..1."""
    shows = np.zeros_like(track.time)
    start = 0.9
    index = 0
    while start < track.time[-1] if len(track.time) else False:
        rise = _plateau(track.time, start, FAMILY_S)
        track.add(rise * rng.uniform(0.8, 1.0), FAMILIES[index % len(FAMILIES)])
        shows = np.maximum(shows, rise)
        start += FAMILY_S + rng.uniform(0.35, 0.8)
        index += 1
    return shows


def _talk(track: _Track, rng: np.random.Generator, quiet: Float[np.ndarray, " t"]) -> None:
    """Adds mouth shapes, four to eight a second, in phrases."""
    time = track.time
    end = time[-1] if len(time) else 0.0
    phrases = np.clip(0.75 + 0.7 * np.sin(2 * np.pi * 0.21 * time + rng.uniform(0, 6.28)), 0, 1) * (
        1 - 0.85 * quiet
    )
    moment = 0.0
    while moment < end:
        moment += rng.uniform(0.12, 0.25)
        jaw, weights = VISEMES[int(rng.integers(len(VISEMES)))]
        pulse = np.exp(-(((time - moment) / 0.078) ** 2)) * phrases * rng.uniform(0.45, 1.0)
        track.add(pulse, {"jaw": jaw, **weights})


def _brows_and_smile(track: _Track, rng: np.random.Generator) -> None:
    """Adds slow waves of mood."""
    mood = _wave(track.time, rng, 0.14, 0.55) + 0.10
    track.add(np.clip(mood, 0, 0.6), {"mouthSmile": 0.7, "cheekSquint": 0.35})
    brows = _wave(track.time, rng, 0.27, 0.8)
    track.add(np.clip(brows, 0, 1), {"browInnerUp": 0.45, "browOuterUp": 0.5})
    track.add(np.clip(-brows - 0.1, 0, 1), {"browDown": 0.35})


def _pose(track: _Track, rng: np.random.Generator) -> Float[np.ndarray, "t 5 3"]:
    """Joint rotations: root sways, neck turns, jaw opens, eyes turn against the neck."""
    time = track.time
    yaw = _bounded(_wave(time, rng, 0.15, 1.35), np.deg2rad(YAW_DEG))
    pitch = _bounded(_wave(time, rng, 0.19, 1.1), np.deg2rad(PITCH_DEG))
    roll = _bounded(_wave(time, rng, 0.12, 1.0), np.deg2rad(ROLL_DEG))
    joints = np.zeros((len(time), 5, 3))
    joints[:, 0] = np.stack(
        [_wave(time, rng, 0.10, 0.02), _wave(time, rng, 0.12, 0.04), _wave(time, rng, 0.09, 0.02)], 1
    )
    joints[:, 1] = np.stack([pitch, yaw, roll], 1)
    joints[:, 2, 0] = np.clip(track.jaw, 0, 0.42)
    joints[:, 2, 1] = _wave(time, rng, 0.3, 0.015)
    gaze_up = _wave(time, rng, 0.33, 0.10) - 0.35 * pitch
    gaze_side = _wave(time, rng, 0.27, 0.14) - 0.5 * yaw
    joints[:, 3:, 0] = gaze_up[:, None]
    joints[:, 3:, 1] = gaze_side[:, None]
    return joints


def _blinks(time: Float[np.ndarray, " t"], rng: np.random.Generator) -> Float[np.ndarray, "t 2"]:
    """Closure of both lids; each blink stays shut for about two frames at 25 frames a second."""
    closure = np.zeros_like(time)
    moment = rng.uniform(0.5, 1.1)
    while len(time) and moment < time[-1] + BLINK_S:
        closure = np.maximum(closure, np.clip(1.35 * np.exp(-(((time - moment) / BLINK_S) ** 2)), 0, 1))
        moment += BLINK_EVERY_S + rng.uniform(-0.5, 0.5)
    return np.stack([closure, closure], 1)


def _wave(
    time: Float[np.ndarray, " t"], rng: np.random.Generator, rate: float, size: float
) -> Float[np.ndarray, " t"]:
    """Smooth wandering of about ``size``: three sines around ``rate`` Hz."""
    rates, phases = rate * rng.uniform(0.6, 1.7, 3), rng.uniform(0, 2 * np.pi, 3)
    return size * np.sin(2 * np.pi * rates * time[:, None] + phases).mean(1) * 1.4


def _bounded(curve: Float[np.ndarray, " t"], limit: float) -> Float[np.ndarray, " t"]:
    """A curve of unit size, bent smoothly so that it stays within ± ``limit``."""
    return limit * np.tanh(curve)


def _plateau(time: Float[np.ndarray, " t"], start: float, length: float) -> Float[np.ndarray, " t"]:
    """0 → 1 → 0 over ``length`` seconds, held in the middle, smooth."""
    share = (time - start) / length
    ramp = np.clip(np.minimum(share, 1 - share) / 0.35, 0, 1)
    return ramp * ramp * (3 - 2 * ramp)
