"""Playback: pictures of one avatar, one pose after the other, as fast as the machine can."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb import render
from toonifygb.avatar.fields import join
from toonifygb.avatar.poser import Poser, joint_weights
from toonifygb.render.playback import BLOCK, NativePlayback, PlaybackDeltas, PlaybackModel

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.avatar.model import Avatar
    from toonifygb.structures import Camera, GaussianParams, HeadMotion, Rendering

_POSITION, _SHAPE = 3, 14
"""Channels before which positions end, and shape, opacity and base colour; view-dependent colour is the rest."""

_AHEAD = 32
"""Poses worked out at a time."""


class Player:
    """Draws one avatar many times.

    On the native engine the deltas are kept as whole numbers, positions in 16 bits and everything else in 8, only
    where they change something, and pose and image are one call; on every other backend it is ``Poser`` and
    ``Renderer``, exactly.

    Args:
        avatar: float32, on the CPU.
        backend: see ``render.get``.
        threads: of the native engine.
    """

    def __init__(self, avatar: Avatar, *, backend: str = "auto", threads: int | None = None) -> None:
        self._avatar = avatar
        self._playback = self._poser = None
        if render.resolve_backend(backend) == "native":
            self._playback = NativePlayback(playback_model(avatar), threads)
        else:
            self._poser, self._renderer = Poser(avatar, backend=backend), render.get(backend)

    def render(
        self, motion: HeadMotion, cameras: Sequence[Camera], *, background: Float[Tensor, " 3"] | None = None
    ) -> list[Rendering]:
        """One pose seen by each camera.

        Args:
            motion: expression and pose, no batch axis.
            cameras: in the world of the motion's translation.
            background: see ``Renderer.render``.
        """
        with torch.no_grad():
            if self._playback is None:
                assert self._poser is not None
                splats = self._poser(motion)
                return [self._renderer.render(splats, camera, background=background) for camera in cameras]
            psi, transforms = self._pose(motion)
            return [self._playback.render(psi, transforms, camera, background=background) for camera in cameras]

    def play(
        self, motion: HeadMotion, cameras: Iterable[Camera], *, background: Float[Tensor, " 3"] | None = None
    ) -> Iterator[Rendering]:
        """Pose after pose, each seen by its camera, as ``render`` gives them.

        Poses are worked out some at a time: the few hundred numbers of one cost as much as those of many.

        Args:
            motion: leading axis = time.
            cameras: one per pose; the shorter of both ends the play.
            background: see ``Renderer.render``.
        """
        playback, views = self._playback, iter(cameras)
        for start in range(0, motion.joints.shape[0], _AHEAD):
            some = motion[start : start + _AHEAD]
            if playback is None:
                for index, camera in zip(range(some.joints.shape[0]), views, strict=False):
                    yield self.render(some[index], [camera], background=background)[0]
            else:
                with torch.no_grad():
                    poses = zip(*self._pose(some), strict=True)
                for (psi, transforms), camera in zip(poses, views, strict=False):
                    yield playback.render(psi, transforms, camera, background=background)

    def _pose(self, motion: HeadMotion) -> tuple[Float[Tensor, "*b r"], Float[Tensor, "*b 5 4 4"]]:
        """What a pose means for the rows of the deltas, and for the joints."""
        avatar = self._avatar
        psi = torch.cat([avatar.coefficients(motion), avatar.pose_feature(motion)], dim=-1)
        return psi, avatar.transforms(motion)


def playback_model(avatar: Avatar) -> PlaybackModel:
    """An avatar as the native engine plays it: rows are its deltas, then its pose correctives."""
    neutral = join([avatar.neutral, avatar.mouth_upper, avatar.mouth_lower])
    rows = [_channels(avatar.deltas.map(lambda delta, k=k: delta[k])) for k in range(len(avatar.deltas.means))]
    rows += [torch.nn.functional.pad(moves, (0, rows[0].shape[1] - 3)) for moves in avatar.pose_basis]
    cuts = ((0, _POSITION, torch.int16), (_POSITION, _SHAPE, torch.int8), (_SHAPE, rows[0].shape[1], torch.int8))
    first, second, third = (_levels(rows, *cut, n=avatar.n) for cut in cuts)
    return PlaybackModel(
        n=avatar.n,
        rows=len(rows),
        sh_degree=avatar.sh_degree,
        neutral=_blocks(_channels(neutral)),
        weights=_blocks(joint_weights(avatar)),
        deltas=(first, second, third),
    )


def _channels(params: GaussianParams) -> Float[Tensor, "n c"]:
    """All parameters of a Gaussian side by side, in the order of ``PlaybackModel``."""
    opacity = params.opacity_logits[:, None]
    return torch.cat([params.means, params.quats, params.log_scales, opacity, params.sh.flatten(1)], dim=1)


def _blocks(values: Tensor) -> Tensor:
    """(n, c) to (blocks, c, BLOCK); the last block is filled up with copies of the last row."""
    blocks = -(-len(values) // BLOCK)
    filler = values[-1:].expand(blocks * BLOCK - len(values), -1)
    return torch.cat([values, filler]).view(blocks, BLOCK, values.shape[1]).transpose(1, 2).contiguous()


def _levels(
    rows: list[Float[Tensor, "f c"]], start: int, stop: int, dtype: torch.dtype, *, n: int
) -> PlaybackDeltas:
    """Channels ``start`` to ``stop`` of all rows, of which the first f of n Gaussians have any."""
    width, blocks = stop - start, -(-n // BLOCK)
    steps, found = torch.zeros(width, len(rows)), []
    live = torch.zeros(len(rows), blocks, dtype=torch.bool)
    for k, row in enumerate(rows):
        values = row[:, start:stop]
        steps[:, k] = values.abs().amax(0) / torch.iinfo(dtype).max
        levels = (values / steps[:, k].clamp_min(torch.finfo(torch.float32).tiny)).round().to(dtype)
        levels = _blocks(torch.nn.functional.pad(levels, (0, 0, 0, n - len(levels))))
        live[k] = levels.flatten(1).any(1)
        found.append(levels[live[k]])
    block, row_of = live.T.nonzero(as_tuple=True)  # the order of entries; `found` is row by row
    count = live.sum(0)
    begin = torch.cat([count.new_zeros(1), count.cumsum(0)])
    place = torch.zeros(live.shape, dtype=torch.long)
    place[row_of, block] = torch.arange(len(block)) - begin[block]
    at_block = live.nonzero()[:, 1]
    channel = torch.arange(width)
    to = begin[at_block, None] * width + channel * count[at_block, None] + place[live][:, None]
    levels = torch.empty(len(block) * width, BLOCK, dtype=dtype)
    levels[to.flatten()] = torch.cat(found).view(len(levels), BLOCK)
    return PlaybackDeltas(start, begin.int(), row_of.int().contiguous(), steps, levels.flatten())
