"""Density control: more Gaussians where the image pulls at them, fewer where they are transparent.

After 3D Gaussian Blendshapes (3DGB). The statistic is the mean over views of the length of the colour loss'
gradient for a Gaussian's place on the image. Where it is large, a small Gaussian is cloned and a large one split in
two; children inherit everything else from their parent: deltas, skinning, consistency. Their moments start at zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.avatar.fields import each
from toonifygb.geometry.rotations import quat_normalize, quat_to_matrix
from toonifygb.structures import GaussianParams
from toonifygb.train.state import Counts, Trained

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from toonifygb.render import RenderInfo
    from toonifygb.train.state import TrainState


@dataclass(frozen=True)
class DensifyRules:
    """When and where; shares are of the training's steps (3DGB: iterations 600, 700, … 14 900 of 40 000)."""

    first: float = 0.015
    last: float = 0.3725
    every: int = 100
    """Steps between two rounds: enough views for a mean."""
    face_threshold: float = 1e-3
    """Mean gradient, normalised device units, from which a face Gaussian multiplies."""
    mouth_threshold: float = 2e-4
    clone_below: float = 0.01
    """Largest standard deviation up to which a Gaussian is cloned; larger ones are split, m."""
    split_shrink: float = 1.6
    """The children of a split are smaller by this factor."""
    min_opacity: float = 0.005
    """Fainter Gaussians are removed."""
    max_scale: float = 0.1
    """Larger Gaussians are removed, m, once ``scale_rule_from`` of the steps are done."""
    scale_rule_from: float = 0.075
    max_growth: float = 2.0
    """No set grows beyond this multiple of its first size; the strongest pulls go first."""


@dataclass
class Lineage:
    """Who the Gaussians of the next generation are."""

    parent: Int[Tensor, " m"]
    """Index of each in the old generation; groups stay together and in order."""
    is_new: Bool[Tensor, " m"]
    """Clones and the children of splits; the others live on unchanged."""
    is_split: Bool[Tensor, " m"]
    """Children of splits."""
    counts: Counts


class Densifier:
    """Counts pulls during training and makes new generations.

    Its statistic lives in the ``TrainState``, so that a checkpoint holds it.

    Args:
        first: sizes of the groups at the start of the training.
        steps: length of the training.
        rules: thresholds and times.
    """

    def __init__(self, first: Counts, steps: int, rules: DensifyRules | None = None) -> None:
        self.rules = rules or DensifyRules()
        self._first = first
        self._steps = steps

    def observe(self, state: TrainState, info: RenderInfo) -> None:
        """Adds one view's gradients to the statistic."""
        assert info.mean2d_gradient is not None, "the statistic exists after the backward pass only"
        state.pull += info.mean2d_gradient.norm(dim=-1) * info.visible
        state.views += info.visible

    def wanted(self, step: int) -> bool:
        """Whether the statistic is still needed at this step."""
        return step <= self.rules.last * self._steps

    def due(self, step: int) -> bool:
        """Whether a new generation is made after this step."""
        start, end = (share * self._steps for share in (self.rules.first, self.rules.last))
        return step % self.rules.every == 0 and start <= step <= end

    def apply(self, state: TrainState) -> None:
        """Replaces the Gaussians by their next generation, in place, and clears the statistic."""
        succeed(state, self._lineage(state), self.rules)

    def _lineage(self, state: TrainState) -> Lineage:
        rules, values = self.rules, state.neutral.values
        pull = state.pull / state.views.clamp_min(1)
        largest = values.log_scales.exp().amax(-1)
        dies = values.opacity_logits.sigmoid() < rules.min_opacity
        if state.step > rules.scale_rule_from * self._steps:
            dies |= largest > rules.max_scale
        parents, new, split, counts = [], [], [], []
        start = 0
        for group, (count, first) in enumerate(zip(_sizes(state.counts), _sizes(self._first), strict=True)):
            ids = torch.arange(start, start + count, device=pull.device)
            threshold = rules.face_threshold if group < 2 else rules.mouth_threshold
            grows = _strongest(pull[ids] * ~dies[ids], threshold, int(rules.max_growth * first) - count)
            large = largest[ids] > rules.clone_below
            stays = ids[~dies[ids] & ~(grows & large)]
            clones, splits = ids[grows & ~large], ids[grows & large].repeat_interleave(2)
            # A group never dies out: its most opaque Gaussian stays.
            if len(stays) + len(clones) + len(splits) == 0 and count:
                stays = ids[values.opacity_logits[ids].argmax()][None]
            parents += [stays, clones, splits]
            new += [ids.new_zeros(len(stays)), ids.new_ones(len(clones) + len(splits))]
            split += [ids.new_zeros(len(stays) + len(clones)), ids.new_ones(len(splits))]
            counts.append(len(stays) + len(clones) + len(splits))
            start += count
        return Lineage(torch.cat(parents), torch.cat(new).bool(), torch.cat(split).bool(), Counts(*counts))


def succeed(state: TrainState, lineage: Lineage, rules: DensifyRules) -> None:
    """Makes ``state`` hold the next generation."""
    face, moved = lineage.parent[: lineage.counts.face], lineage.parent[: lineage.counts.moved]
    new = lineage.is_new
    state.neutral = _inherit(state.neutral, lineage.parent, new, axis=0)
    state.expression = _inherit(state.expression, moved, new[: len(moved)], axis=1)
    state.driver = _inherit(state.driver, face, new[: len(face)], axis=1)
    state.scale = state.scale[:, moved].contiguous()
    state.skin_weights = state.skin_weights[lineage.parent]
    state.pose_basis = state.pose_basis[:, face].contiguous()
    state.counts = lineage.counts
    state.pull, state.views = state.pull.new_zeros(lineage.counts.all), state.views.new_zeros(lineage.counts.all)
    _scatter_children(state.neutral.values, lineage.is_split, rules.split_shrink, state.generator)


def _inherit(trained: Trained, parents: Int[Tensor, " m"], new: Bool[Tensor, " m"], axis: int) -> Trained:
    values, first, second = (
        part.map(lambda tensor: tensor.index_select(axis, parents))
        for part in (trained.values, trained.first, trained.second)
    )
    for moments in (first, second):
        for _, tensor in each(moments):
            tensor[new if axis == 0 else (slice(None), new)] = 0.0
    return Trained(values, first, second)


def _scatter_children(
    values: GaussianParams, split: Bool[Tensor, " n"], shrink: float, generator: torch.Generator
) -> None:
    """Places the children of splits at random inside their parent and shrinks them, in place."""
    ids = split.nonzero()[:, 0]
    scales = values.log_scales[ids].exp()
    own = scales * torch.randn(scales.shape, generator=generator).to(scales)
    turned = torch.einsum("nab,nb->na", quat_to_matrix(quat_normalize(values.quats[ids])), own)
    values.means[ids] += turned
    values.log_scales[ids] -= torch.tensor(shrink).log()


def _strongest(pull: Float[Tensor, " n"], threshold: float, room: int) -> Bool[Tensor, " n"]:
    """Those above the threshold, at most ``room`` of them."""
    above = pull > threshold
    if int(above.sum()) <= room:
        return above
    chosen = torch.zeros_like(above)
    chosen[pull.topk(max(room, 0)).indices] = True
    return chosen & above


def _sizes(counts: Counts) -> tuple[int, int, int, int]:
    return counts.moved, counts.still, counts.upper, counts.lower
