"""What reduced blendshapes cost beside full ones: changing the deltas in training, posing at playback, disk.

The gradient is noise, which is as dear as a real one; skinning, rendering and loss are the same for both.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.harness import Figure, cpu_seconds
from toonifygb import head, render
from toonifygb.avatar import Avatar, Poser, init_avatar, save
from toonifygb.config import DRAFT, TrainConfig
from toonifygb.structures import GaussianParams, HeadMotion
from toonifygb.synthetic.motion import make_motion
from toonifygb.train.optim import Coefficients, Optimizer, blend
from toonifygb.train.state import TrainState

KINDS = {
    "full": DRAFT,
    **{f"{n} bases": TrainConfig(blendshapes="reduced", n_bases=n) for n in (10, 20, 40)},
}


class _Training:
    """The parts of a training that blendshapes decide, with a gradient of noise."""

    def __init__(self, avatar: Avatar, motion: HeadMotion) -> None:
        self._template = avatar
        self._kernels = render.kernels("native", 1)
        self.state = TrainState.start(avatar, 0)
        # One frame to a step of the deltas: the median of steps would never see one in eight.
        self._optimizer = Optimizer(self.state, DRAFT.steps, 1, self._kernels)
        values = self.state.neutral.values
        generator = torch.Generator().manual_seed(0)
        self._gradient: GaussianParams = values.map(lambda t: 1e-3 * torch.randn(t.shape, generator=generator))
        self._psi = avatar.signals(motion)

    def step(self) -> None:
        """Blends the parameters of the next frame and changes them all."""
        psi = self._psi[self.state.step % len(self._psi)]
        own = self._template.n_expressions + self._template.n_eyelids
        mixer = self.state.mixer
        weights = psi[:own] if mixer is None else mixer.values(psi)
        coefficients = Coefficients(weights, psi[own:], psi)
        blend(self.state, coefficients, self._kernels)
        self.state.step += 1
        self._optimizer.step(self.state, self._gradient, coefficients)

    def avatar(self) -> Avatar:
        """What has become of it."""
        return self.state.avatar(self._template)


def _megabytes(avatar: Avatar) -> dict[str, float]:
    sizes = {}
    with tempfile.TemporaryDirectory() as folder:
        for storage in ("compact", "full"):
            save(avatar, folder, storage=storage)
            sizes[storage] = sum(path.stat().st_size for path in Path(folder).iterdir()) / 1e6
    return sizes


def _measured(config: TrainConfig) -> dict[tuple[str, str], float]:
    """Figures of one kind by claim and unit."""
    model = head.load("open")
    motion = make_motion(model, 300, 25.0, 1)
    # A fitted track has no coefficient at exactly 0, where rows of full blendshapes would be skipped.
    motion = replace(motion, expression=motion.expression + 0.01)
    training = _Training(init_avatar(model, torch.zeros(model.n_shape), config, motion=motion), motion)
    figures = {("blending and Adam, a training step", "ms"): 1e3 * cpu_seconds(training.step, repeats=50)}
    avatar = training.avatar()
    for half in (False, True):
        poser = Poser(avatar, backend="native", threads=1, half=half)
        seconds = cpu_seconds(lambda poser=poser: poser(motion[100]), repeats=100)
        figures["posing a frame" + (", half precision" if half else ""), "ms"] = 1e3 * seconds
    return figures | {(f"{kind} storage", "MB"): size for kind, size in _megabytes(avatar).items()}


def run() -> list[Figure]:
    """Draft avatars on a synthetic motion, processor time of one thread; the baseline is full blendshapes."""
    torch.set_num_threads(1)
    figures, full = [], {}
    for kind, config in KINDS.items():
        measured = _measured(config)
        full = full or measured
        figures += [
            Figure(f"{kind}: {claim}", value, unit, full[claim, unit]) for (claim, unit), value in measured.items()
        ]
    return figures
