"""Learning rates of every parameter, their schedule, blending, and the Adam step over neutral and deltas.

The rates are 3D Gaussian Blendshapes' (3DGB), made for 40 000 steps. A shorter training covers the same ground in
fewer steps: what would hardly move in so few takes larger ones, delta positions and opacities in proportion,
neutral positions too, to a limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from toonifygb.avatar.bases import Mixer
from toonifygb.avatar.fields import FIELDS, cut, each, rows, width
from toonifygb.structures import GaussianParams
from toonifygb.train.state import Seen

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.render.fused import Kernels
    from toonifygb.train.state import Trained, TrainState

FULL_STEPS = 40_000
"""Steps that the rates were made for."""
NEUTRAL_RATES = {
    "means": 1.6e-4,
    "quats": 1e-3,
    "log_scales": 5e-3,
    "opacity_logits": 2.5e-2,
    "sh_dc": 2.5e-3,
    "sh_rest": 1.25e-4,
}
"""3DGB's, but for opacity, which has half of its rate there, as in later versions of 3D Gaussian Splatting."""
NEUTRAL_TRAVEL = 4.0
"""Largest factor on the rate of the neutral positions in a short training. They start on a bald head; where they do
not get to where hair is, its picture is painted behind it and slips as soon as the head turns. See decision 045."""
DELTA_RATES = {
    "means": 3.2e-7,
    "quats": 1e-4,
    "log_scales": 5e-4,
    "opacity_logits": 5e-5,
    "sh_dc": 1.25e-3,
    "sh_rest": 1.25e-3,
}
"""The seed's list: (3.2e-7, 5e-5, 5e-4, 1e-4, 1.25e-3) for position, opacity, scale, rotation, SH."""
DRIVER_TRAVEL = {
    "means": 1.3e-3,
    "quats": 0.01,
    "log_scales": 0.05,
    "opacity_logits": 0.2,
    "sh_dc": 0.125,
    "sh_rest": 0.125,
}
"""How far the deltas of pose drivers can go in a whole training, however long: the sum of their rates. A clip shows
few of the poses that a head can take, and drivers that may go anywhere explain each frame by its own pose: colours
turn and seams open in poses between and beyond. wojtek_1 at 256 px, 1000 steps, held-out score and that of the
frames turned farthest: at ``DELTA_RATES`` 33.0 and 30.2 dB, at 0.3 of them 33.3 and 31.1, at 0.1 (these) 33.4 and
31.6, without drivers 30.3 and 29.3."""
DELTA_EPS = 1e-6
"""Adam's ε for the deltas. With 3DGB's 1e-15 a Gaussian that is hidden in nearly every frame moves at the full
rate on gradients that are mere noise, and shows it in poses that training never saw; so it stays with the mesh.
Held-out score of a clip whose end turns away from the rest: +0.9 dB."""
BASIS_EPS = 5 * DELTA_EPS
"""The same for the bases of reduced blendshapes, whose weights are about 1 where coefficients are about 0.2."""
MEANS_DECAY = 0.01
"""Final over first rate of the neutral positions; log-linear over the first ``DECAY_SHARE`` of the steps."""
DECAY_SHARE = 0.75
LEARNED = ("hidden", "bias", "out")
"""Fields of a mixer that are trained. The linear part stays what the head model says: trained with the rest it
scores the same on a clip, but eyes that were seldom closed there no longer close when they are told to."""
MIXER_RATE, MIXER_EPS = 1e-3, 1e-8
"""Adam's rate and ε for them."""
SETTLE_FROM, SETTLE_TO = 0.6, 0.1
"""From this share of the steps on all rates fall, log-linear, to this share of themselves: it quiets the noise of
single-image steps."""


@dataclass(frozen=True)
class Coefficients:
    """What one frame multiplies the deltas with."""

    expression: Float[Tensor, " e"]
    driver: Float[Tensor, " d"]
    psi: Float[Tensor, " k"]
    """All of the frame, from which a mixer makes ``expression``."""


def blend(state: TrainState, psi: Coefficients, kernels: Kernels) -> GaussianParams:
    """Raw parameters of one frame: every Gaussian's neutral, plus the deltas of those that have some."""
    blended = {}
    for name, neutral in each(state.neutral.values):
        values = neutral.clone()
        for trained, coefficients in ((state.driver, psi.driver), (state.expression, psi.expression)):
            deltas = rows(getattr(trained.values, name))
            if len(deltas):
                base = values.view(-1)[: deltas.shape[1]]
                kernels.blend(base, deltas, coefficients, out=base)
        blended[name] = values
    return GaussianParams(**blended)


def changes(state: TrainState, psi: list[Coefficients], kernels: Kernels, out: GaussianParams) -> None:
    """Σ ψk ΔBk of several frames for the Gaussians of the face; all deltas are read only once.

    Args:
        state: holds the deltas.
        psi: coefficients of each frame.
        kernels: where it runs.
        out: gets the sums, one set per frame; see ``no_changes``.
    """
    for name, sums in each(out):
        flat = rows(sums).zero_()
        for trained, coefficients in (
            (state.driver, [frame.driver for frame in psi]),
            (state.expression, [frame.expression for frame in psi]),
        ):
            deltas = rows(getattr(trained.values, name))
            if len(deltas):
                kernels.add_blends(flat[: len(psi)], deltas, torch.stack(coefficients))


def no_changes(state: TrainState, frames: int) -> GaussianParams:
    """Room for ``changes``, kept from step to step: new memory would cost more than the sums."""
    face = cut(state.neutral.values, 0, state.counts.face)
    return face.map(lambda tensor: tensor.new_zeros(frames, *tensor.shape))


def changed(neutral: GaussianParams, by: GaussianParams, kernels: Kernels) -> GaussianParams:
    """The neutral Gaussians, the first of them changed."""
    values = {}
    for name, base in each(neutral):
        offset = getattr(by, name).reshape(1, -1)
        values[name] = torch.empty_like(base)
        flat, from_, p = values[name].view(-1), base.view(-1), offset.shape[1]
        kernels.blend(from_[:p], offset, offset.new_ones(1), out=flat[:p])
        flat[p:] = from_[p:]
    return GaussianParams(**values)


class Optimizer:
    """Adam over all parameters of a ``TrainState``; holds rates, no state of its own.

    Args:
        state: whose sizes the rates are laid out for.
        steps: length of the whole training.
        frames: steps, one frame each, to every step of the deltas.
        kernels: where the fused updates run.
    """

    def __init__(self, state: TrainState, steps: int, frames: int, kernels: Kernels) -> None:
        self._kernels = kernels
        self._steps, self._frames = steps, frames
        stretch = max(1.0, FULL_STEPS / steps)
        delta = DELTA_RATES | {name: DELTA_RATES[name] * stretch for name in ("means", "opacity_logits")}
        neutral = NEUTRAL_RATES | {"means": NEUTRAL_RATES["means"] * min(NEUTRAL_TRAVEL, stretch)}
        self._neutral = _rates(state.neutral.values, neutral)
        self._expression = _rates(state.expression.values, delta)
        driver = {name: travel / steps for name, travel in DRIVER_TRAVEL.items()}
        self._driver = _rates(state.driver.values, driver)
        self._mixer = {}
        if state.mixer is not None:
            learned = {name: getattr(state.mixer.values, name).view(-1) for name in LEARNED}
            self._mixer = {name: torch.full_like(values, MIXER_RATE) for name, values in learned.items()}

    def step(self, state: TrainState, gradient: GaussianParams, psi: Coefficients) -> None:
        """One Adam step.

        Args:
            state: changed in place; its ``step`` is the number of this step, from 1.
            gradient: for the blended parameters of all Gaussians: the neutral's own, and times ψk that of ΔBk.
            psi: the frame's coefficients.
        """
        settle = settling(state.step / self._steps)
        means = means_decay(state.step / self._steps)
        if state.mixer is not None:
            self._mixer_step(state, gradient, psi, settle)
        for name, g in each(gradient):
            factor = means if name == "means" else settle
            values, first, second = _parts(state.neutral, name)
            self._kernels.adam_step(
                values.view(-1),
                first.view(-1),
                second.view(-1),
                g.reshape(-1),
                self._neutral[name],
                state.step,
                factor=factor,
            )
        state.seen.append(Seen(psi.expression, psi.driver, cut(gradient, 0, state.counts.face)))
        if len(state.seen) == self._frames or state.step == self._steps:
            self.finish(state)

    def finish(self, state: TrainState) -> None:
        """One Adam step of the deltas with what the frames seen since the last one say.

        It is as long as the steps that each of them alone would have been, together. wojtek_1 at 512 px, 1500
        steps, held out: 32.61 dB / 0.942 frame by frame, 32.66 / 0.944 for 8 frames; with the root of their number,
        as noise alone would ask for, 32.42 / 0.942.
        """
        if not state.seen:
            return
        settle = settling(state.step / self._steps)
        step = -(-state.step // self._frames)
        own_eps = DELTA_EPS if state.mixer is None else BASIS_EPS
        for trained, rates, coefficients, scale, eps in (
            (state.expression, self._expression, [seen.expression for seen in state.seen], state.scale, own_eps),
            (state.driver, self._driver, [seen.driver for seen in state.seen], None, DELTA_EPS),
        ):
            psi = torch.stack(coefficients)
            for name in FIELDS:
                values, first, second = (rows(part) for part in _parts(trained, name))
                if not len(values):
                    continue
                gradients = [getattr(seen.gradient, name).reshape(-1)[: values.shape[1]] for seen in state.seen]
                self._kernels.blend_adam_step(
                    values,
                    first,
                    second,
                    psi,
                    gradients[0][None] if len(gradients) == 1 else torch.stack(gradients),
                    rates[name],
                    step,
                    factor=settle * len(state.seen),
                    eps=eps,
                    scale=scale,
                    widths=(width(name, state.neutral.values.sh.shape[1]),),
                    skip_inactive=True,
                )
        state.seen.clear()

    def _mixer_step(self, state: TrainState, gradient: GaussianParams, psi: Coefficients, settle: float) -> None:
        """Adam on the network that weighs the bases; the derivative by a basis' weight is its product with g."""
        assert state.mixer is not None
        by_weight = torch.zeros_like(psi.expression)
        for name, bases in each(state.expression.values):
            matrix = rows(bases)
            by_weight += matrix @ getattr(gradient, name).reshape(-1)[: matrix.shape[1]]
        for name, found in mixer_gradient(state.mixer.values, psi.psi, by_weight).items():
            values, first, second = (part.view(-1) for part in _parts(state.mixer, name))
            rates = self._mixer[name]
            self._kernels.adam_step(
                values, first, second, found.view(-1), rates, state.step, factor=settle, eps=MIXER_EPS
            )


def mixer_gradient(mixer: Mixer, psi: Float[Tensor, " k"], by_weight: Float[Tensor, " b"]) -> dict[str, Tensor]:
    """Derivatives by what is learned of the network, from that by its weights w."""
    x = psi[: len(mixer.scale)] / mixer.scale
    bent, rest = (mixer.hidden @ x + mixer.bias).tanh(), mixer.bias.tanh()
    by_bent = by_weight @ mixer.out
    by_hidden = by_bent * (1 - bent.square())
    return {
        "hidden": torch.outer(by_hidden, x),
        "bias": by_hidden - by_bent * (1 - rest.square()),
        "out": torch.outer(by_weight, bent - rest),
    }


def means_decay(share: float) -> float:
    """Factor on the rate of the neutral positions after a share 0..1 of the steps."""
    return MEANS_DECAY ** min(1.0, share / DECAY_SHARE)


def settling(share: float) -> float:
    """Factor on all other rates after a share 0..1 of the steps."""
    return SETTLE_TO ** max(0.0, (share - SETTLE_FROM) / (1 - SETTLE_FROM))


def _parts(trained: Trained[Any], name: str) -> tuple[Tensor, Tensor, Tensor]:
    return getattr(trained.values, name), getattr(trained.first, name), getattr(trained.second, name)


def _rates(params: GaussianParams, rates: dict[str, float]) -> dict[str, Tensor]:
    """Learning rate of every float of one row, by field; ``sh`` splits into ``sh_dc`` and ``sh_rest``."""
    n, k = params.sh.shape[-3], params.sh.shape[-2]
    tables = {}
    for name in FIELDS:
        if name == "sh":
            table = params.sh.new_full((n, k, 3), rates["sh_rest"])
            table[:, 0] = rates["sh_dc"]
            tables[name] = table.view(-1)
        else:
            tables[name] = params.sh.new_full((n * width(name, k),), rates[name])
    return tables
