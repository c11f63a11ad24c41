"""Reduced blendshapes: a few learned bases that all expressions share, and the small network that weighs them.

The idea is RGBAvatar's (arXiv 2503.12886): w = network(ψ) instead of one ΔBk per coefficient ψk. The start here is
not random but the best that few bases can do for the mesh: the principal directions of what the head model's
blendshapes do to the Gaussians in this clip, turned (varimax) until each is as local as it can be. So an untrained
reduced avatar moves like an untrained full one, and locality keeps what it had: a basis is trained only where it
moves the surface, and takes room on disk only there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from toonifygb.avatar.transfer import consistency
from toonifygb.errors import InputError
from toonifygb.structures import GaussianParams, TensorRecord

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.avatar.model import Avatar
    from toonifygb.config import TrainConfig
    from toonifygb.head import HeadModel
    from toonifygb.structures import HeadMotion

N_BASES = 20
"""Bases where no setting says so; RGBAvatar's number."""
HIDDEN = 64
"""Hidden units of the network."""
LEAST_USE = 0.25
"""Share of the head model's σ that a coefficient counts as used at least: it can be driven beyond the clip."""
EYELID_USE = 0.5
"""The same for the lids: they are few Gaussians that seldom move, and a head that cannot blink looks dead."""
N_DRIVERS_SEEN = 1
"""The network looks at the first pose driver, how far the jaw is open; not at the head's place, which would
only give it a way to learn single frames by heart."""
_TURNS = 200
_STILL = 1e-6


@dataclass(frozen=True)
class Mixer(TensorRecord):
    """Weights of b bases from the first k coefficients: w = L x_own + O (tanh(H x + a) - tanh(a)), x = ψ / scale.

    No expression in the mean pose, ψ = 0, gives w = 0 whatever is learned: the neutral stays the neutral. Outside
    the trained range the bounded part keeps its value and the linear one goes on, as blendshapes do.
    """

    scale: Float[Tensor, " k"]
    """Usual size of every coefficient that is looked at: expression, eyelids, jaw opening; not trained."""
    linear: Float[Tensor, "b e"]
    """L: the head model's own blendshapes, expression and eyelids, in terms of the bases; not trained either."""
    hidden: Float[Tensor, "h k"]
    """H."""
    bias: Float[Tensor, " h"]
    """a."""
    out: Float[Tensor, "b h"]
    """O."""

    @property
    def n_bases(self) -> int:
        """Number of weights."""
        return self.linear.shape[0]

    def __call__(self, psi: Float[Tensor, "*t m"]) -> Float[Tensor, "*t b"]:
        """Weights of the bases for the coefficients ψ of expression, eyelids and pose drivers."""
        x = psi[..., : len(self.scale)] / self.scale
        bent = (x @ self.hidden.mT + self.bias).tanh() - self.bias.tanh()
        return x[..., : self.linear.shape[1]] @ self.linear.mT + bent @ self.out.mT


def check_bases(config: TrainConfig, head: HeadModel) -> None:
    """Refuses a number of bases that the head model has no use for.

    Raises:
        InputError: fewer than one basis, or more than the head has blendshapes.
    """
    most = head.n_expression
    if config.blendshapes == "reduced":
        most = (head.n_blendshapes or head.n_expression) + (0 if head.eyelid_basis is None else 2)
    if config.n_bases is not None and not 1 <= config.n_bases <= most:
        raise InputError(
            f"setting train.n_bases is {config.n_bases}; the head model '{head.name}' has {most} blendshapes",
            f"pass a number from 1 to {most}",
        )


def reduced(avatar: Avatar, head: HeadModel, config: TrainConfig, motion: HeadMotion | None) -> Avatar:
    """An untrained avatar with few bases in the place of its expression and eyelid deltas.

    Pose-driven deltas stay as they are, one per driver.

    Args:
        avatar: untrained, with all blendshapes.
        head: its head model.
        config: number of bases, seed.
        motion: the training frames' motion, which says what is used how much.
    """
    n_own = avatar.n_expressions + avatar.n_eyelids
    n_bases = min(config.n_bases or N_BASES, n_own)
    lids = head.expression_sigma.new_full((avatar.n_eyelids,), EYELID_USE)
    scale = torch.cat([LEAST_USE * head.expression_sigma[: avatar.n_expressions], lids])
    if motion is not None:
        scale = scale.maximum(avatar.signals(motion)[:, :n_own].square().mean(0).sqrt())
    turn = _directions(scale[:, None, None] * avatar.deltas.means[:n_own], n_bases)

    def few(delta: Tensor) -> Tensor:
        rows = torch.einsum("bk,k...->b...", turn, torch.einsum("k,k...->k...", scale, delta[:n_own]))
        return torch.cat([rows, delta[n_own:]])

    deltas = _only_moved(avatar.deltas.map(few), n_bases)
    return replace(avatar, deltas=deltas, mixer=_first_mixer(turn, scale, avatar, config.seed))


def _first_mixer(turn: Float[Tensor, "b k"], scale: Float[Tensor, " k"], avatar: Avatar, seed: int) -> Mixer:
    """The network that is the projection on the bases; its bent part is there but says nothing yet."""
    jaw = scale.new_ones(0 if avatar.drivers is None else N_DRIVERS_SEEN)
    generator = torch.Generator().manual_seed(seed)
    n_inputs = len(scale) + len(jaw)
    return Mixer(
        scale=torch.cat([scale, jaw]),
        linear=turn,
        hidden=torch.randn(HIDDEN, n_inputs, generator=generator) / n_inputs**0.5,
        bias=2 * torch.rand(HIDDEN, generator=generator) - 1,
        out=torch.zeros(len(turn), HIDDEN),
    )


def _directions(movement: Float[Tensor, "k n 3"], n: int) -> Float[Tensor, "n k"]:
    """Orthonormal mixtures of the k movements that hold as much of them as n can, each as local as possible."""
    flat = movement.flatten(1).double()
    _, vectors = torch.linalg.eigh(flat @ flat.T)  # ascending
    first = vectors.flip(1)[:, :n].T
    turned = varimax((first @ flat).view(n, *movement.shape[1:])) @ first
    # Signs are the linear algebra library's whim; ours is that the largest share counts as positive.
    largest = turned.gather(1, turned.abs().argmax(1, keepdim=True))
    return (turned * largest.sign()).to(movement.dtype)


def varimax(movement: Float[Tensor, "b n 3"]) -> Float[Tensor, "b b"]:
    """Rotation of bases after which each moves few points much: Kaiser's criterion for vectors.

    It maximises the variance over points of the squared lengths, by the usual fixed-point iteration.

    Args:
        movement: of every point by every basis.
    """
    flat = movement.flatten(1)
    rotation = torch.eye(len(flat), dtype=flat.dtype)
    for _ in range(_TURNS):
        turned = (rotation @ flat).view(movement.shape)
        length = turned.square().sum(-1, keepdim=True)
        left, _, right = torch.linalg.svd((turned * (length - length.mean(1, keepdim=True))).flatten(1) @ flat.T)
        before, rotation = rotation, left @ right
        if (rotation - before).abs().max() < _STILL:
            break
    return rotation


def _only_moved(deltas: GaussianParams, n_bases: int) -> GaussianParams:
    """Bases without what they move by less than what training would leave alone."""
    live = consistency(deltas.means) > 0
    live[n_bases:] = True
    return deltas.map(lambda delta: delta * live.view(*live.shape, *[1] * (delta.ndim - 2)))
