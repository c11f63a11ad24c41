"""Posing for playback: the splats of ``Avatar.pose``, through the fused kernels and with everything prepared."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb import render
from toonifygb.avatar.fields import cut, cut_deltas, each, join, last_changed, rows
from toonifygb.avatar.skinning import pose_offsets
from toonifygb.structures import GaussianParams

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.avatar.model import Avatar
    from toonifygb.structures import HeadMotion, Splats


def joint_weights(avatar: Avatar) -> Float[Tensor, "n 5"]:
    """Each Gaussian's share of every joint: face, upper mouth, lower mouth."""
    upper = avatar.mouth_upper_weights.expand(avatar.mouth_upper.n, -1)
    lower = avatar.mouth_lower_weights.expand(avatar.mouth_lower.n, -1)
    return torch.cat([avatar.skin_weights, upper, lower])


class Poser:
    """Poses one avatar many times.

    Args:
        avatar: float32, on the CPU.
        backend: of the kernels, see ``render.get``; the splats come out on their device.
        threads: of the native engine.
        half: keep the deltas as bfloat16: half the memory traffic, which is what blending costs.
    """

    def __init__(
        self, avatar: Avatar, *, backend: str = "auto", threads: int | None = None, half: bool = False
    ) -> None:
        self._avatar = avatar
        self._kernels = render.kernels(backend, threads)
        device = self._kernels.device
        self._neutral = join([avatar.neutral, avatar.mouth_upper, avatar.mouth_lower]).to(device)
        self._pose_basis = avatar.pose_basis.to(device)
        self._weights = joint_weights(avatar).to(device)
        self._n_bases = avatar.n_bases
        dtype = torch.bfloat16 if half else torch.float32
        expression = cut(avatar.deltas, 0, self._n_bases)
        driver = avatar.deltas.map(lambda delta: delta[self._n_bases :])
        groups = [cut_deltas(group, 0, last_changed(group)) for group in (expression, driver)]
        self._groups = [group.map(lambda delta: delta.to(device, dtype).contiguous()) for group in groups]

    def __call__(self, motion: HeadMotion) -> Splats:
        """Splats in the world for one frame's motion, as ``Avatar.pose`` gives them; without gradients."""
        avatar = self._avatar
        with torch.no_grad():
            return self.splats(avatar.coefficients(motion), avatar.pose_feature(motion), avatar.transforms(motion))

    def splats(
        self, coefficients: Float[Tensor, " r"], feature: Float[Tensor, " p"], transforms: Float[Tensor, "5 4 4"]
    ) -> Splats:
        """The same from ``coefficients``, ``pose_feature`` and ``transforms`` of the avatar."""
        device = self._kernels.device
        psi, feature, transforms = (tensor.to(device) for tensor in (coefficients, feature, transforms))
        with torch.no_grad():
            raw = self._blend([psi[: self._n_bases].contiguous(), psi[self._n_bases :].contiguous()])
            face = raw.means[: self._avatar.neutral.n]
            face += pose_offsets(feature, self._pose_basis)
            return self._kernels.skin(raw, self._weights, transforms)

    def _blend(self, coefficients: list[Float[Tensor, " k"]]) -> GaussianParams:
        blended = {}
        for name, neutral in each(self._neutral):
            values = neutral.clone()
            for group, psi in zip(self._groups, coefficients, strict=True):
                deltas = rows(getattr(group, name))
                if deltas.numel():
                    base = values.view(-1)[: deltas.shape[1]]
                    self._kernels.blend(base, deltas, psi, out=base)
            blended[name] = values
        return GaussianParams(**blended)
