"""One training step: blend, skin, render, compare, and send the gradient back.

Only the rasteriser runs under autograd; blending, skinning and the losses have gradients by hand, so that a step
allocates little and its work stays in the fused kernels. ``tests/train`` holds the same step written plainly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from toonifygb.avatar import MouthVolume
from toonifygb.avatar.fields import join
from toonifygb.avatar.skinning import pose_offsets
from toonifygb.render import RenderInfo
from toonifygb.structures import GaussianParams, Rendering, Splats
from toonifygb.train.losses import LossTerms, LossWeights, image_gradients, mouth_gradients
from toonifygb.train.optim import Coefficients, Optimizer, blend, changed, changes, no_changes
from toonifygb.train.state import Counts

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.avatar import Avatar
    from toonifygb.config import TrainConfig
    from toonifygb.render import Renderer
    from toonifygb.render.fused import Kernels
    from toonifygb.structures import HeadMotion, TrackedSequence
    from toonifygb.train.data import Dataset
    from toonifygb.train.state import TrainState

SH_GROWTH = 40
"""The active SH degree rises by one after every this-many-th part of the steps, from 0."""


ImageErrors = Callable[[Rendering, "Tensor", "Tensor"], "tuple[Tensor, Tensor]"]
"""Rendering, colours and matte of a frame → derivatives by the rendering's colour and opacity."""


@dataclass(frozen=True)
class Pull:
    """Derivatives of some loss of one frame's picture."""

    splats: Splats
    """The Gaussians of that frame in the world."""
    world: Splats
    """By those."""
    raw: GaussianParams
    """By the blended raw parameters, which are those of the neutral, and times ψk those of ΔBk."""


@dataclass(frozen=True)
class _Frame:
    """What a motion says to the Gaussians."""

    psi: Coefficients
    features: Float[Tensor, " p"]
    transforms: Float[Tensor, "5 4 4"]


class Stepper:
    """Takes steps of a training; everything that does not change from step to step is prepared here.

    Args:
        state: changed in place by ``step``; its tensors are where the kernels want them.
        template: the avatar's unchanging parts.
        dataset: crops, mattes, cameras, split.
        sequence: motion of every frame.
        config: weights, degree, number of steps.
        renderer: rasteriser.
        kernels: fused blending, optimiser and photometric loss.
    """

    def __init__(
        self,
        state: TrainState,
        template: Avatar,
        dataset: Dataset,
        sequence: TrackedSequence,
        config: TrainConfig,
        renderer: Renderer,
        kernels: Kernels,
    ) -> None:
        self.state = state
        self.first_counts = Counts.of(template)
        self._dataset = dataset
        self._config = config
        self._renderer = renderer
        self._kernels = kernels
        self._weights = LossWeights.of(config)
        self._template = template
        mouth = MouthVolume.around(join([template.mouth_upper, template.mouth_lower]).means)
        self._mouth = mouth.to(kernels.device)
        self.follow(sequence)
        self.rebind()

    def follow(self, sequence: TrackedSequence) -> None:
        """Takes the motion of every frame from a track."""
        template, device = self._template, self._kernels.device
        self._transforms = template.transforms(sequence.motion).to(device)
        self._features = template.pose_feature(sequence.motion).to(device)
        self._psi = template.signals(sequence.motion).to(device)
        self._changed_in: list[int] = []

    def rebind(self) -> None:
        """Prepares again what depends on the set of Gaussians; after densification."""
        frames = self._config.delta_frames
        self._optimizer = Optimizer(self.state, self._config.steps, frames, self._kernels)
        self._changes = no_changes(self.state, frames)
        self._changed_in = []

    def finish(self) -> None:
        """Gives the deltas what the last frames say of them, before the set of Gaussians changes."""
        self._optimizer.finish(self.state)
        self._changed_in = []

    @property
    def sh_degree(self) -> int:
        """Active SH degree."""
        return min(self._config.sh_degree, self.state.step * SH_GROWTH // self._config.steps)

    def step(self, info: RenderInfo | None = None) -> LossTerms:
        """One step on the next frame; ``info`` is filled with the densification statistic when given."""
        state = self.state
        index = state.next_frame(self._dataset.split.train)
        background = state.next_background().to(self._kernels.device)
        kept = state.next_kept(self._config.dropout)
        state.step += 1
        gradient, terms = self._gradient(index, background, kept, info)
        self._optimizer.step(state, gradient, self._frame(index).psi)
        if not state.seen or state.mixer is not None:  # deltas, or the weights of bases, are others now
            self._changed_in = []
        return terms

    def splats(self, index: int) -> Splats:
        """All Gaussians as they stand now, in the pose of one frame, world space; on the processor."""
        return self._posed(self._frame(index))[1].to("cpu")

    def splats_of(self, motion: HeadMotion) -> Splats:
        """The same for any motion, no batch axis."""
        return self._posed(self._motion(motion))[1].to("cpu")

    def pull(self, index: int, errors: ImageErrors) -> Pull:
        """How errors of one frame's picture, on black, pull at the Gaussians.

        Args:
            index: frame number.
            errors: the rendering, colours and matte of the frame → derivatives of some loss by the rendering's
                colour and opacity.
        """
        black = torch.zeros(3, device=self._kernels.device)
        blended = blend(self.state, self._frame(index).psi, self._kernels)
        return self._pull(self._dataset, index, blended, errors, black, None, None)

    def _pull(
        self,
        dataset: Dataset,
        index: int,
        blended: GaussianParams,
        errors: ImageErrors,
        background: Float[Tensor, " 3"],
        kept: Float[Tensor, " n"] | None,
        info: RenderInfo | None,
    ) -> Pull:
        frame = self._frame(index)
        raw, splats = self._skinned(frame, blended)
        if kept is not None:
            splats = replace(splats, opacities=splats.opacities * kept)
        leaves = _leaves(splats)
        cut_off = Splats(*leaves, sh_frames=splats.sh_frames)
        camera = dataset.camera(index)
        pixels = dataset.pixels(index, self._kernels.device)
        target = self._kernels.place(*pixels, background, dataset.reduction)
        rendering = self._renderer.render(
            cut_off, camera, background=background, sh_degree=self.sh_degree, info=info
        )
        slopes = errors(rendering, *target)
        world = Splats(*torch.autograd.grad([rendering.color, rendering.alpha], leaves, slopes))
        if kept is not None:
            world = replace(world, opacities=world.opacities * kept)
        return Pull(
            splats, world, self._kernels.skin_gradient(raw, self.state.skin_weights, frame.transforms, world)
        )

    def _looked_at(self) -> Dataset:
        """The training set, at half its resolution in the first steps; crops of odd size have no half."""
        coarse = self.state.step <= self._config.coarse_share * self._config.steps
        return self._dataset.reduced(2) if coarse and self._dataset.size % 2 == 0 else self._dataset

    def _frame(self, index: int) -> _Frame:
        return _Frame(self._coefficients(self._psi[index]), self._features[index], self._transforms[index])

    def _coefficients(self, psi: Float[Tensor, " k"]) -> Coefficients:
        own, mixer = self._template.n_expressions + self._template.n_eyelids, self.state.mixer
        return Coefficients(psi[:own] if mixer is None else mixer.values(psi), psi[own:], psi)

    def _motion(self, motion: HeadMotion) -> _Frame:
        template, device = self._template, self._kernels.device
        return _Frame(
            self._coefficients(template.signals(motion).to(device)),
            template.pose_feature(motion).to(device),
            template.transforms(motion).to(device),
        )

    def _posed(self, frame: _Frame) -> tuple[GaussianParams, Splats]:
        """Blended raw parameters of one frame, and the splats they become."""
        return self._skinned(frame, blend(self.state, frame.psi, self._kernels))

    def _blended(self, index: int) -> GaussianParams:
        """Blended raw parameters of a frame; those of the next frames are made ready with it.

        The deltas stay as they are until the optimizer has seen all frames of its next step.
        """
        state = self.state
        if index not in self._changed_in:
            left = self._config.delta_frames - len(state.seen) if state.mixer is None else 1
            soon = state.order[state.position : state.position + left - 1].tolist()
            self._changed_in = [index, *soon]
            coefficients = [self._frame(each_index).psi for each_index in self._changed_in]
            changes(state, coefficients, self._kernels, self._changes)
        place = self._changed_in.index(index)
        by = self._changes.map(lambda tensor: tensor[place])
        return changed(state.neutral.values, by, self._kernels)

    def _skinned(self, frame: _Frame, raw: GaussianParams) -> tuple[GaussianParams, Splats]:
        """Splats of blended raw parameters, which get the corrections for the pose."""
        raw.means[: self.state.counts.face].add_(pose_offsets(frame.features, self.state.pose_basis))
        return raw, self._kernels.skin(raw, self.state.skin_weights, frame.transforms)

    def _gradient(
        self,
        index: int,
        background: Float[Tensor, " 3"],
        kept: Float[Tensor, " n"] | None,
        info: RenderInfo | None,
    ) -> tuple[GaussianParams, LossTerms]:
        """Gradient of the whole objective for the blended raw parameters of one frame."""
        terms = LossTerms(0.0, 0.0, 0.0)

        def errors(rendering: Rendering, target: Tensor, matte: Tensor) -> tuple[Tensor, Tensor]:
            terms.photo, terms.alpha, v_color, v_alpha = image_gradients(
                rendering, target, matte, self._weights, self._kernels
            )
            return v_color, v_alpha

        gradient = self._pull(self._looked_at(), index, self._blended(index), errors, background, kept, info).raw
        terms.mouth = self._add_mouth_gradient(gradient)
        return gradient, terms

    def _add_mouth_gradient(self, gradient: GaussianParams) -> float:
        """Adds the mouth penalty's gradient in place; returns the penalty."""
        counts, mouth = self.state.counts, slice(self.state.counts.face, None)
        loss, slopes = mouth_gradients(
            self.state.neutral.values.means[mouth], counts.upper, self._mouth, self._weights
        )
        gradient.means[mouth].add_(slopes)
        return loss


def _leaves(splats: Splats) -> list[torch.Tensor]:
    """What the rasteriser is differentiated in, cut from any graph."""
    tensors = [splats.means, splats.quats, splats.scales, splats.opacities, splats.sh]
    return [tensor.detach().requires_grad_() for tensor in tensors]
