"""Two damped Gauss-Newton solvers: many faces of one person, and one person's motion through time.

``solve_identity`` moves the poses of unrelated frames together with what they share, identity and focal length;
the poses are eliminated by a Schur complement, so its cost grows linearly with the frames. ``solve_motion`` holds
the person and couples consecutive frames by a prior on acceleration: with observations on both sides of every
frame such smoothing has no lag. Both keep weights fixed while a step is sought, and take only steps that lower
the energy those weights define (iteratively reweighted least squares).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from toonifygb.geometry.rotations import matrix_to_axis_angle
from toonifygb.structures import TensorRecord
from toonifygb.track.energy import MIN_DEPTH, LandmarkEnergy, NormalEquations, Prior, Weights
from toonifygb.track.model import ANGLES, EXPRESSION, EYELIDS, POSITION, Posed, PoseState

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Bool, Float

SHAPE_WEIGHT = 1.0
"""Weight of the identity prior N(0, 1) per frame. The landmarks' errors are mostly the same in every frame of a
person, so more frames must not make the identity bolder."""
FOCAL_SIGMA = 0.05
"""Trust per frame in the expected log focal length, for the same reason as above."""
RIGID_ITERATIONS = 2
"""First iterations that move the head as a whole."""
FOCAL_ITERATION = 4
"""Iteration from which the focal length moves too."""
CONVERGED = 2e-4
"""Relative decrease of the energy that ends the iterations."""
DAMPING_START, DAMPING_LEAST, DAMPING_MOST = 1e-2, 1e-6, 1e4
DAMPING_UP, DAMPING_DOWN = 6.0, 0.35
TRIALS = 5
"""Steps tried with growing damping before an iteration gives up."""

ACCELERATION_FPS = 25.0
"""Frame rate for which the sigmas of second differences below are given; they scale with 1/fps²."""
ACCELERATION_SIGMAS = {
    "rotation": 0.015,
    "across": 0.0015,
    "depth": 0.003,
    "jaw": 0.04,
    "gaze": 0.12,
    "eyelids": 0.6,
    "expression": 0.15,
}
"""How much faces accelerate per frame², rad, m and 1. A blink closes a lid in two or three frames: at this sigma
it costs next to nothing."""
CG_ITERATIONS = 20
CG_TOLERANCE = 1e-2
"""Relative accuracy of a chain step; the next Gauss-Newton step makes up for the rest."""


@dataclass(frozen=True)
class Shared(TensorRecord):
    """What all frames of a clip have in common."""

    shape: Float[Tensor, " s"]
    log_focal: Float[Tensor, ""]


@dataclass(frozen=True)
class FocalBelief:
    """Expected log focal length, log px; ``sigma`` 0 holds it."""

    log_focal: float
    sigma: float = FOCAL_SIGMA


def solve_identity(
    energy: LandmarkEnergy,
    prior: Prior,
    belief: FocalBelief,
    state: PoseState,
    iterations: int,
    *,
    on_iteration: Callable[[int], None] = lambda _: None,
) -> tuple[Shared, PoseState]:
    """Identity and focal length that explain frames taken as unrelated, with those frames' poses."""
    shared = Shared(state.values.new_zeros(energy.model.n_shape), state.values.new_tensor(belief.log_focal))
    damping = DAMPING_START

    def total(trial: Shared, poses: PoseState, posed: Posed, weights: Weights) -> float:
        if not bool((posed.points[..., 2] < -MIN_DEPTH).all()):
            return float("inf")
        frames = energy.energy(energy.residuals(posed, trial.log_focal), weights) + prior.energy(poses.values)
        return float(frames.double().sum()) + poses.n * _shared_energy(trial, belief)

    for iteration in range(iterations):
        rigid = iteration < RIGID_ITERATIONS
        posed = energy.model.pose(shared.shape, state)
        weights = energy.weights(posed, state, shared.log_focal)
        before = total(shared, state, posed, weights)
        system = energy.normal_equations(posed, state, shared.log_focal, weights, rigid=rigid, shared=not rigid)
        if not rigid:
            move_focal = belief.sigma > 0 and iteration >= FOCAL_ITERATION
            system = _with_priors(system, prior, state, shared, belief, move_focal)
        for _ in range(TRIALS):
            step, shared_step = _schur_step(system, damping)
            moved_state, moved_shared = state.moved(_padded(step, state)), shared
            if not rigid:
                shape, focal = shared_step[:-1], shared_step[-1].clamp(-0.15, 0.15)
                moved_shared = Shared(shared.shape + shape, shared.log_focal + focal)
            after = total(moved_shared, moved_state, energy.model.pose(moved_shared.shape, moved_state), weights)
            if after < before:
                break
            damping = min(damping * DAMPING_UP, DAMPING_MOST)
        else:
            break
        state, shared = moved_state, moved_shared
        damping = max(damping * DAMPING_DOWN, DAMPING_LEAST)
        on_iteration(iteration)
        if iteration > FOCAL_ITERATION and before - after < CONVERGED * before:
            break
    return shared, state


def _shared_energy(shared: Shared, belief: FocalBelief) -> float:
    """Energy of identity and focal length per frame."""
    energy = SHAPE_WEIGHT * float(shared.shape.double().square().sum())
    if belief.sigma > 0:
        energy += ((float(shared.log_focal) - belief.log_focal) / belief.sigma) ** 2
    return energy


def _with_priors(
    system: NormalEquations, prior: Prior, state: PoseState, shared: Shared, belief: FocalBelief, move_focal: bool
) -> NormalEquations:
    """System of all terms; a focal length that must not move is cut out."""
    frame, gradient = system.frame.clone(), system.frame_gradient.clone()
    frame[:, 3:, 3:] += prior.curvature(state.values)
    gradient[:, 3:] += prior.gradient(state.values)
    common, common_gradient, cross = system.shared.clone(), system.shared_gradient.clone(), system.cross.clone()
    common.diagonal()[:-1] += state.n * SHAPE_WEIGHT
    common_gradient[:-1] += state.n * SHAPE_WEIGHT * shared.shape
    if move_focal:
        common[-1, -1] += state.n / belief.sigma**2
        common_gradient[-1] += state.n * (shared.log_focal - belief.log_focal) / belief.sigma**2
    else:
        common[-1], common[:, -1], cross[..., -1], common_gradient[-1] = 0, 0, 0, 0
        common[-1, -1] = 1
    return replace(
        system,
        frame=frame,
        frame_gradient=gradient,
        shared=common,
        shared_gradient=common_gradient,
        cross=cross,
    )


def _schur_step(system: NormalEquations, damping: float) -> tuple[Float[Tensor, "n p"], Float[Tensor, " s"]]:
    """Damped Gauss-Newton step: the frames' unknowns eliminated, then recovered."""
    frame, common, cross = system.frame.double(), system.shared.double(), system.cross.double()
    frame = frame + damping * torch.diag_embed(frame.diagonal(dim1=1, dim2=2) + 1e-3)
    common = common + damping * torch.diag(common.diagonal())
    factor = torch.linalg.cholesky(frame)
    right = torch.cat([cross, system.frame_gradient.double()[..., None]], -1)
    solved = torch.cholesky_solve(right, factor)
    reduced = common - torch.einsum("nps,npt->st", cross, solved[..., :-1])
    gradient = system.shared_gradient.double() - torch.einsum("nps,np->s", cross, solved[..., -1])
    shared = -torch.linalg.solve(reduced, gradient)
    step = -(solved[..., -1] + solved[..., :-1] @ shared)
    return step.to(system.frame.dtype), shared.to(system.frame.dtype)


def _padded(step: Float[Tensor, "n p"], state: PoseState) -> Float[Tensor, "n q"]:
    """Update of all values from a step that may be rigid."""
    missing = 3 + state.values.shape[1] - step.shape[1]
    return torch.nn.functional.pad(step, (0, missing))


@dataclass(frozen=True)
class Acceleration(TensorRecord):
    """Prior on second differences in time, Σ |x(t−1) − 2 x(t) + x(t+1)|² / σ², over three frames in a row."""

    precision: Float[Tensor, " p"]
    """One per unknown of an update."""
    linked: Bool[Tensor, " m"]
    """For each inner frame: whether its two neighbours in the list are its neighbours in time."""

    def differences(self, state: PoseState) -> Float[Tensor, "m p"]:
        """Second differences of the state; of rotations, the change of the turn from frame to frame, rad."""
        turn = matrix_to_axis_angle(state.rotation[1:] @ state.rotation[:-1].mT)
        return torch.cat([turn.diff(dim=0), state.values.diff(n=2, dim=0)], -1)

    def energy(self, state: PoseState) -> float:
        """Energy of the whole sequence."""
        weighed = self.precision * self.differences(state).square()
        return float(weighed[self.linked].double().sum())

    def gradient(self, state: PoseState) -> Float[Tensor, "n p"]:
        """Half the derivative of ``energy`` by an update (first order in the turn between frames)."""
        return self._spread(self.differences(state), state.n)

    def product(self, vector: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        """Half the second derivative of ``energy`` times ``vector``."""
        return self._spread(vector.diff(n=2, dim=0), vector.shape[0])

    def diagonal(self, n: int) -> Float[Tensor, "n p"]:
        """Diagonal of half the second derivative."""
        linked = self.linked.to(self.precision.dtype)[:, None]
        pad = torch.nn.functional.pad
        count = pad(linked, (0, 0, 0, 2)) + 4 * pad(linked, (0, 0, 1, 1)) + pad(linked, (0, 0, 2, 0))
        return count[:n] * self.precision

    def _spread(self, differences: Float[Tensor, "m p"], n: int) -> Float[Tensor, "n p"]:
        weighed = differences * self.precision * self.linked[:, None]
        pad = torch.nn.functional.pad
        spread = pad(weighed, (0, 0, 0, 2)) - 2 * pad(weighed, (0, 0, 1, 1)) + pad(weighed, (0, 0, 2, 0))
        return spread[:n]  # one frame alone has no differences, yet padding makes two rows


def make_acceleration(frames: Tensor, n_values: int, fps: float, template: Tensor) -> Acceleration:
    """Prior for the listed frame numbers of a clip of that frame rate; dtype and device as ``template``."""
    sigma = template.new_full((3 + n_values,), ACCELERATION_SIGMAS["expression"])
    values = sigma[3:]
    sigma[:3] = ACCELERATION_SIGMAS["rotation"]
    values[POSITION] = values.new_tensor(
        [ACCELERATION_SIGMAS["across"], ACCELERATION_SIGMAS["across"], ACCELERATION_SIGMAS["depth"]]
    )
    values[ANGLES] = ACCELERATION_SIGMAS["gaze"]
    values[ANGLES.start : ANGLES.start + 2] = ACCELERATION_SIGMAS["jaw"]
    values[EYELIDS] = ACCELERATION_SIGMAS["eyelids"]
    values[EXPRESSION] = ACCELERATION_SIGMAS["expression"]
    # Clamped so that slow-motion and time-lapse clips keep a prior that neither freezes nor vanishes.
    scale = min(max((ACCELERATION_FPS / fps) ** 2, 0.1), 4.0)
    steps = frames.diff()
    linked = (steps[1:] == 1) & (steps[:-1] == 1)
    return Acceleration((sigma * scale).pow(-2), linked)


def solve_motion(
    energy: LandmarkEnergy,
    prior: Prior,
    acceleration: Acceleration,
    log_focal: Float[Tensor, ""],
    state: PoseState,
    iterations: int,
) -> PoseState:
    """Motion of a known person: ``energy.model`` has the identity in its template."""
    model = energy.model
    nobody = state.values.new_zeros(0)
    damping = state.values.new_full((state.n,), DAMPING_START)

    def frames(poses: PoseState, posed: Posed, weights: Weights) -> Float[Tensor, " n"]:
        own = energy.energy(energy.residuals(posed, log_focal), weights) + prior.energy(poses.values)
        behind = (posed.points[..., 2] > -MIN_DEPTH).any(-1)
        return own.double().masked_fill(behind, torch.inf)

    for iteration in range(iterations):
        rigid = iteration < RIGID_ITERATIONS
        posed = model.pose(nobody, state)
        weights = energy.weights(posed, state, log_focal)
        before, chain_before = frames(state, posed, weights), 0.0 if rigid else acceleration.energy(state)
        system = energy.normal_equations(posed, state, log_focal, weights, rigid=rigid)
        frame, gradient = system.frame.double(), system.frame_gradient.double()
        if not rigid:
            frame[:, 3:, 3:] += prior.curvature(state.values)
            gradient[:, 3:] += prior.gradient(state.values)
            gradient += acceleration.gradient(state)
        for _ in range(TRIALS):
            damped = frame + damping[:, None, None] * torch.diag_embed(frame.diagonal(dim1=1, dim2=2) + 1e-3)
            step = _factor_solve(damped, gradient) if rigid else _chain_step(damped, gradient, acceleration)
            moved = state.moved(_padded(step.to(state.values.dtype), state))
            after = frames(moved, model.pose(nobody, moved), weights)
            chain_after = 0.0 if rigid else acceleration.energy(moved)
            # A frame alone may rise a little for its neighbours' sake; damping rises where it rises by much.
            worse = after > before * 1.01 + 1.0
            damping = torch.where(worse, damping * DAMPING_UP, damping * DAMPING_DOWN)
            damping = damping.clamp(DAMPING_LEAST, DAMPING_MOST)
            decrease = float((before - after).sum()) + chain_before - chain_after
            if decrease > 0:
                break
            damping = (damping * DAMPING_UP).clamp(max=DAMPING_MOST)
        else:
            break
        state = moved
        if not rigid and decrease < CONVERGED * (float(before.sum()) + chain_before):
            break
    return state


def _factor_solve(matrix: Float[Tensor, "n p p"], gradient: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
    return -torch.cholesky_solve(gradient[..., None], torch.linalg.cholesky(matrix))[..., 0]


def _chain_step(
    frame: Float[Tensor, "n p p"], gradient: Float[Tensor, "n p"], acceleration: Acceleration
) -> Float[Tensor, "n p"]:
    """Solution of (frame blocks + chain) x = −gradient by conjugate gradients, preconditioned frame by frame.

    The landmarks pin most of every frame, so a few iterations propagate what the chain has to say.
    """
    n = frame.shape[0]
    factor = torch.linalg.cholesky(frame + torch.diag_embed(acceleration.diagonal(n).double()))

    def apply(vector: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        return (frame @ vector[..., None])[..., 0] + acceleration.product(vector)

    def precondition(vector: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        return torch.cholesky_solve(vector[..., None], factor)[..., 0]

    solution = torch.zeros_like(gradient)
    residual = -gradient
    direction = precondition(residual)
    product = (residual * direction).sum()
    goal = float(product) * CG_TOLERANCE**2
    for _ in range(CG_ITERATIONS):
        if float(product) <= goal:
            break
        applied = apply(direction)
        length = product / (direction * applied).sum()
        solution = solution + length * direction
        residual = residual - length * applied
        conditioned = precondition(residual)
        previous, product = product, (residual * conditioned).sum()
        direction = conditioned + product / previous * direction
    return solution
