"""The tracker's landmark model: equal to the head model, with exact derivatives."""

from __future__ import annotations

import math

import pytest
import torch
from track_scene import open_head

from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.track.energy import LandmarkEnergy, Observation, make_prior, project, projection_slopes
from toonifygb.track.model import EYELIDS, POSITION, LandmarkModel, PoseState, patch_normals
from toonifygb.track.solve import make_acceleration

N_SHAPE = 6
LOG_FOCAL = torch.tensor(math.log(800.0), dtype=torch.float64)
CENTRE = torch.tensor([256.0, 240.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def model() -> LandmarkModel:
    return LandmarkModel.from_head(open_head().to(torch.float64), N_SHAPE)


@pytest.fixture(scope="module")
def state(model: LandmarkModel) -> PoseState:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    values = 0.1 * normal(3, model.n_values)
    values[:, POSITION] = torch.tensor([0.02, 0.03, -0.6], dtype=torch.float64)
    return PoseState(axis_angle_to_matrix(0.3 * normal(3, 3)), values)


def shape_of(model: LandmarkModel) -> torch.Tensor:
    return torch.linspace(-1, 1, model.n_shape, dtype=torch.float64)


def test_points_equal_those_of_the_head_model(model: LandmarkModel, state: PoseState) -> None:
    head = open_head().to(torch.float64)
    padded = torch.nn.functional.pad(shape_of(model), (0, head.n_shape - N_SHAPE))
    points, _ = head.landmarks().forward(padded, model.to_motion(shape_of(model), state))
    # Skinning weights are stored in float32 and sum to 1 within 1e-7; the head's own share absorbs the rest.
    torch.testing.assert_close(model.pose(shape_of(model), state).points, points, rtol=0, atol=3e-8)


def test_a_fixed_identity_is_the_same_person(model: LandmarkModel, state: PoseState) -> None:
    person = model.with_identity(shape_of(model))
    nobody = state.values.new_zeros(0)
    torch.testing.assert_close(
        person.pose(nobody, state).points, model.pose(shape_of(model), state).points, rtol=0, atol=1e-12
    )
    one, other = person.to_motion(nobody, state), model.to_motion(shape_of(model), state)
    torch.testing.assert_close(one.translation, other.translation, rtol=0, atol=1e-12)


def test_derivatives_equal_central_differences(model: LandmarkModel, state: PoseState) -> None:
    shape = shape_of(model)
    posed = model.pose(shape, state)
    jacobian = torch.cat(model.derivatives(posed, state, projection_slopes(posed.points, LOG_FOCAL)), -1)

    def pixels(update: torch.Tensor, identity: torch.Tensor) -> torch.Tensor:
        return project(model.pose(shape + identity, state.moved(update)).points, LOG_FOCAL, CENTRE)

    n_update, step = 3 + model.n_values, 1e-5
    for column in range(n_update + N_SHAPE):
        along = torch.zeros(n_update + N_SHAPE, dtype=torch.float64).index_fill_(0, torch.tensor(column), step)
        update, identity = along[:n_update].expand(state.n, -1), along[n_update:]
        slope = (pixels(update, identity) - pixels(-update, -identity)) / (2 * step)
        # Central differences of second-order smooth functions of size 1e4: truncation 1e-6, rounding 1e-7.
        torch.testing.assert_close(jacobian[..., column], slope, rtol=1e-6, atol=2e-5)


def test_normal_equations_equal_those_of_the_plain_jacobian(model: LandmarkModel, state: PoseState) -> None:
    shape = shape_of(model)
    posed = model.pose(shape, state)
    observed = project(posed.points, LOG_FOCAL, CENTRE) + torch.sin(torch.arange(478.0).double())[:, None]
    energy = LandmarkEnergy(model, Observation(observed, CENTRE))
    weights = energy.weights(posed, state, LOG_FOCAL)
    system = energy.normal_equations(posed, state, LOG_FOCAL, weights, shared=True)

    slopes = projection_slopes(posed.points, LOG_FOCAL)
    focal = (project(posed.points, LOG_FOCAL, 0 * CENTRE))[..., None]
    rows = torch.cat([*model.derivatives(posed, state, slopes), focal], -1)
    residuals = energy.residuals(posed, LOG_FOCAL)
    a, b = energy.pairs.unbind(-1)
    hessian = torch.einsum("nl,nlai,nlaj->ij", weights.landmark, rows, rows)
    hessian += torch.einsum("nk,nkai,nkaj->ij", weights.pair, rows[:, a] - rows[:, b], rows[:, a] - rows[:, b])
    gradient = torch.einsum("nl,nlai,nla->i", weights.landmark, rows, residuals)
    gaps = residuals[:, a] - residuals[:, b]
    gradient += torch.einsum("nk,nkai,nka->i", weights.pair, rows[:, a] - rows[:, b], gaps)
    p = 3 + model.n_values
    torch.testing.assert_close(system.frame.sum(0), hessian[:p, :p])
    torch.testing.assert_close(system.cross.sum(0), hessian[:p, p:])
    torch.testing.assert_close(system.shared, hessian[p:, p:])
    torch.testing.assert_close(system.frame_gradient.sum(0), gradient[:p])
    torch.testing.assert_close(system.shared_gradient, gradient[p:])


def test_prior_gradient_and_curvature_are_those_of_its_energy(model: LandmarkModel, state: PoseState) -> None:
    prior = make_prior(model, open_head().to(torch.float64))
    values = state.values.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(prior.energy(values).sum(), values, create_graph=True)
    torch.testing.assert_close(prior.gradient(values), gradient / 2)
    (row,) = torch.autograd.grad(gradient[0, EYELIDS.start], values)
    torch.testing.assert_close(prior.curvature(values)[0, EYELIDS.start], row[0] / 2)


def test_acceleration_prior_is_zero_on_steady_motion_and_silent_across_gaps(model: LandmarkModel) -> None:
    steady = torch.arange(6, dtype=torch.float64)[:, None] * torch.linspace(0.1, 1, model.n_values).double()
    turn = axis_angle_to_matrix(torch.arange(6, dtype=torch.float64)[:, None] * torch.tensor([[0.0, 0.1, 0.0]]))
    prior = make_acceleration(torch.arange(6), model.n_values, 25.0, model.template)
    assert prior.energy(PoseState(turn, steady)) == pytest.approx(0.0, abs=1e-12)
    bent = steady.clone()
    bent[3] += 1
    assert prior.energy(PoseState(turn, bent)) > 1
    gap = make_acceleration(torch.tensor([0, 1, 2, 7, 8, 9]), model.n_values, 25.0, model.template)
    assert gap.linked.tolist() == [True, False, False, True]


def test_acceleration_product_and_diagonal_agree_with_the_dense_matrix(model: LandmarkModel) -> None:
    frames = torch.tensor([0, 1, 2, 3, 5, 6, 7])
    prior = make_acceleration(frames, model.n_values, 25.0, model.template)
    n, p = len(frames), 3 + model.n_values
    basis = torch.eye(n, dtype=torch.float64)
    columns = [prior.product(column[:, None].expand(n, p)) for column in basis]
    dense = torch.stack(columns, 1)  # row, column, unknown
    torch.testing.assert_close(dense, dense.transpose(0, 1))
    torch.testing.assert_close(torch.einsum("iip->ip", dense), prior.diagonal(n))


def test_patch_normals_of_a_sphere_point_outwards() -> None:
    generator = torch.Generator().manual_seed(1)
    points = torch.nn.functional.normalize(torch.randn(600, 3, generator=generator), dim=-1) * 0.09
    points = points[points[:, 2] > 0.02]
    cosine = (patch_normals(points, 0.02) * points / 0.09).sum(-1)
    # At the rim the patch is one-sided and leans inwards by up to its radius over the sphere's.
    assert cosine.min() > 0.9
    assert cosine.mean() > 0.99
