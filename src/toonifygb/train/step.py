"""One training step: blend, skin, render, compare, and send the gradient back.

Only the rasteriser runs under autograd; blending, skinning and the losses have gradients by hand, so that a step
allocates little and its work stays in the fused kernels. ``tests/train`` holds the same step written plainly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.avatar import MouthVolume
from toonifygb.avatar.fields import cut, join
from toonifygb.avatar.skinning import pose_offsets
from toonifygb.render import RenderInfo
from toonifygb.structures import GaussianParams, Rendering, Splats
from toonifygb.train.losses import LossTerms, LossWeights, image_gradients, mouth_loss, placed_on
from toonifygb.train.optim import Coefficients, Optimizer, blend
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

    def rebind(self) -> None:
        """Prepares again what depends on the set of Gaussians; after densification."""
        self._optimizer = Optimizer(self.state, self._config.steps, self._kernels)

    @property
    def sh_degree(self) -> int:
        """Active SH degree."""
        return min(self._config.sh_degree, self.state.step * SH_GROWTH // self._config.steps)

    def step(self, info: RenderInfo | None = None) -> LossTerms:
        """One step on the next frame; ``info`` is filled with the densification statistic when given."""
        state = self.state
        index = state.next_frame(self._dataset.split.train)
        background = state.next_background().to(self._kernels.device)
        state.step += 1
        gradient, terms = self._gradient(index, background, info)
        self._optimizer.step(state, gradient, self._frame(index).psi)
        return terms

    def splats(self, index: int) -> Splats:
        """All Gaussians as they stand now, in the pose of one frame, world space; on the processor."""
        return self._posed(self._frame(index))[1].to("cpu")

    def splats_of(self, motion: HeadMotion) -> Splats:
        """The same for any motion, no batch axis."""
        return self._posed(self._motion(motion))[1].to("cpu")

    def pull(
        self,
        index: int,
        errors: ImageErrors,
        info: RenderInfo | None = None,
        background: Float[Tensor, " 3"] | None = None,
    ) -> Pull:
        """How errors of one frame's picture pull at the Gaussians.

        Args:
            index: frame number.
            errors: the rendering, colours and matte of the frame → derivatives of some loss by the rendering's
                colour and opacity.
            info: filled with the densification statistic when given.
            background: what is rendered behind the Gaussians; black when ``None``.
        """
        frame = self._frame(index)
        raw, splats = self._posed(frame)
        leaves = _leaves(splats)
        cut_off = Splats(*leaves, sh_frames=splats.sh_frames)
        camera = self._dataset.camera(index)
        rendering = self._renderer.render(
            cut_off, camera, background=background, sh_degree=self.sh_degree, info=info
        )
        slopes = errors(rendering, *self._dataset.target(index, self._kernels.device))
        world = Splats(*torch.autograd.grad([rendering.color, rendering.alpha], leaves, slopes))
        return Pull(
            splats, world, self._kernels.skin_gradient(raw, self.state.skin_weights, frame.transforms, world)
        )

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
        raw = blend(self.state, frame.psi, self._kernels)
        raw.means[: self.state.counts.face].add_(pose_offsets(frame.features, self.state.pose_basis))
        return raw, self._kernels.skin(raw, self.state.skin_weights, frame.transforms)

    def _gradient(
        self, index: int, background: Float[Tensor, " 3"], info: RenderInfo | None
    ) -> tuple[GaussianParams, LossTerms]:
        """Gradient of the whole objective for the blended raw parameters of one frame."""
        terms = LossTerms(0.0, 0.0, 0.0)

        def errors(rendering: Rendering, target: Tensor, matte: Tensor) -> tuple[Tensor, Tensor]:
            target = placed_on(background, target, matte)
            terms.photo, terms.alpha, v_color, v_alpha = image_gradients(
                rendering, target, matte, self._weights, self._kernels
            )
            return v_color, v_alpha

        gradient = self.pull(index, errors, info, background).raw
        terms.mouth = self._add_mouth_gradient(gradient)
        return gradient, terms

    def _add_mouth_gradient(self, gradient: GaussianParams) -> float:
        """Adds the mouth penalty's gradient in place; returns the penalty."""
        counts, means = self.state.counts, self.state.neutral.values.means
        places = [(counts.face, counts.face + counts.upper), (counts.face + counts.upper, counts.all)]
        upper, lower = (means[start:stop].detach().requires_grad_() for start, stop in places)
        loss = mouth_loss(upper, lower, self._mouth, self._weights)
        for (start, stop), found in zip(places, torch.autograd.grad(loss, [upper, lower]), strict=True):
            cut(gradient, start, stop).means.add_(found)
        return float(loss.detach())


def _leaves(splats: Splats) -> list[torch.Tensor]:
    """What the rasteriser is differentiated in, cut from any graph."""
    tensors = [splats.means, splats.quats, splats.scales, splats.opacities, splats.sh]
    return [tensor.detach().requires_grad_() for tensor in tensors]
