"""Density control keeps the books: who is whose child, what they inherit, and that nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from make import tiny_avatar

from toonifygb.avatar.fields import each
from toonifygb.render import RenderInfo
from toonifygb.train.densify import Densifier, DensifyRules
from toonifygb.train.state import Counts, TrainState

RULES = DensifyRules()


@pytest.fixture
def state() -> TrainState:
    """A training whose moments and statistic are not zero."""
    avatar = tiny_avatar()
    calm = replace(avatar, neutral=replace(avatar.neutral, log_scales=avatar.neutral.log_scales.clamp(-7, -5)))
    state = TrainState.start(calm, 0)
    for trained in (state.neutral, state.expression, state.driver):
        for moments in (trained.first, trained.second):
            for _, tensor in each(moments):
                tensor.add_(torch.rand_like(tensor))
    state.views += 2
    state.step = 100
    return state


def densify(state: TrainState, steps: int = 1000) -> None:
    Densifier(state.counts, steps).apply(state)


def snapshot(state: TrainState) -> TrainState:
    def copied(trained):
        return trained.map(torch.clone)

    return replace(
        state,
        neutral=copied(state.neutral),
        expression=copied(state.expression),
        driver=copied(state.driver),
        scale=state.scale.clone(),
    )


def test_nothing_pulls_nothing_changes(state: TrainState) -> None:
    before = snapshot(state)
    densify(state)
    assert state.counts == before.counts
    assert torch.equal(state.neutral.values.means, before.neutral.values.means)
    assert torch.equal(state.driver.second.sh, before.driver.second.sh)


def test_clone_inherits_everything_but_moments(state: TrainState) -> None:
    before, chosen = snapshot(state), 3
    state.pull[chosen] = 2.1 * RULES.face_threshold
    densify(state)
    assert state.counts == replace(before.counts, moved=before.counts.moved + 1)
    child = before.counts.moved
    for name, values in each(state.neutral.values):
        assert torch.equal(values[child], getattr(before.neutral.values, name)[chosen]), name
        assert (getattr(state.neutral.first, name)[child] == 0).all(), name
        assert torch.equal(getattr(state.neutral.first, name)[chosen], getattr(before.neutral.first, name)[chosen])
    for name, deltas in each(state.expression.values):
        assert torch.equal(deltas[:, child], getattr(before.expression.values, name)[:, chosen]), name
        assert (getattr(state.expression.second, name)[:, child] == 0).all(), name
    for name, deltas in each(state.driver.values):
        assert torch.equal(deltas[:, child], getattr(before.driver.values, name)[:, chosen]), name
        # The still group behind the moved one has shifted by one.
        assert torch.equal(deltas[:, child + 1 :], getattr(before.driver.values, name)[:, child:]), name
    assert torch.equal(state.scale[:, child], before.scale[:, chosen])
    assert torch.equal(state.skin_weights[child], before.skin_weights[chosen])
    assert (state.pull == 0).all()
    assert state.pull.shape == (state.counts.all,)


def test_large_gaussian_splits_in_two_smaller_ones(state: TrainState) -> None:
    chosen = state.counts.moved + 5
    state.neutral.values.log_scales[chosen] = torch.tensor(0.02).log()
    state.pull[chosen] = 1.0
    before = snapshot(state)
    densify(state)
    assert state.counts == replace(before.counts, still=before.counts.still + 1)
    children = slice(state.counts.face - 2, state.counts.face)
    parent = before.neutral.values
    assert torch.allclose(state.neutral.values.log_scales[children].exp(), torch.tensor(0.02 / RULES.split_shrink))
    distance = (state.neutral.values.means[children] - parent.means[chosen]).norm(dim=-1)
    assert ((distance > 1e-5) & (distance < 0.12)).all()
    assert torch.equal(state.neutral.values.sh[children], parent.sh[chosen].expand(2, -1, -1))
    assert not (state.neutral.values.means == parent.means[chosen]).all(-1).any(), "the parent is gone"


def test_transparent_and_huge_gaussians_die(state: TrainState) -> None:
    before = snapshot(state)
    state.neutral.values.opacity_logits[[2, 7]] = -8.0
    state.neutral.values.log_scales[before.counts.face - 1] = torch.tensor(0.5).log()
    densify(state)
    assert state.counts == replace(before.counts, moved=before.counts.moved - 2, still=before.counts.still - 1)
    assert torch.equal(state.neutral.values.means[2], before.neutral.values.means[3])
    assert torch.equal(state.expression.values.sh[:, 5], before.expression.values.sh[:, 6])


def test_huge_gaussians_live_early_on(state: TrainState) -> None:
    state.neutral.values.log_scales[0] = torch.tensor(0.5).log()
    before = state.counts
    densify(state, steps=100_000)
    assert state.counts == before


def test_mouth_sets_have_their_own_threshold(state: TrainState) -> None:
    before = state.counts
    state.pull[:] = 2 * 0.5 * RULES.face_threshold
    densify(state)
    assert (state.counts.moved, state.counts.still) == (before.moved, before.still)
    assert (state.counts.upper, state.counts.lower) == (2 * before.upper, 2 * before.lower)


def test_growth_is_limited_and_no_group_dies_out(state: TrainState) -> None:
    before = state.counts
    state.pull[: before.moved] = torch.linspace(1, 2, before.moved)
    state.neutral.values.opacity_logits[before.face :] = -9.0
    densifier = Densifier(before, 1000)
    densifier.apply(state)
    assert state.counts == Counts(2 * before.moved, before.still, 1, 1)
    state.pull[: state.counts.moved] = 1.0
    state.views += 1
    densifier.apply(state)
    assert state.counts.moved == 2 * before.moved


def test_statistic_counts_visible_views_only(state: TrainState) -> None:
    n = state.counts.all
    state.pull.zero_()
    state.views.zero_()
    gradient = torch.zeros(n, 2)
    gradient[0], gradient[1] = torch.tensor([3.0, 4.0]), torch.tensor([1.0, 0.0])
    radii = torch.zeros(n, dtype=torch.int32)
    radii[0] = 5
    densifier = Densifier(state.counts, 1000)
    for _ in range(2):
        densifier.observe(state, RenderInfo(radii=radii, mean2d_gradient=gradient))
    assert state.pull[0] == 10
    assert state.views[0] == 2
    assert state.pull[1] == 0
    assert state.views[1] == 0


def test_schedule_scales_with_the_training() -> None:
    densifier = Densifier(Counts(1, 1, 1, 1), 40_000)
    rounds = [step for step in range(1, 40_001) if densifier.due(step)]
    assert rounds[0] == 600
    assert rounds[-1] == 14_900
    assert len(rounds) == 144
    assert densifier.wanted(14_900)
    assert not densifier.wanted(14_901)
