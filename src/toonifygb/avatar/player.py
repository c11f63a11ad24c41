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
            return self._draw(self._pose(motion), cameras, background)

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
        views = iter(cameras)
        for start in range(0, motion.joints.shape[0], _AHEAD):
            with torch.no_grad():
                poses = zip(*self._pose(motion[start : start + _AHEAD]), strict=True)
            for pose, camera in zip(poses, views, strict=False):
                with torch.no_grad():
                    [image] = self._draw(pose, [camera], background)
                yield image

    def _pose(self, motion: HeadMotion) -> tuple[Tensor, ...]:
        """What motions mean for the rows of the deltas, the pose correctives and the joints."""
        avatar = self._avatar
        return avatar.coefficients(motion), avatar.pose_feature(motion), avatar.transforms(motion)

    def _draw(
        self, pose: tuple[Tensor, ...], cameras: Sequence[Camera], background: Float[Tensor, " 3"] | None
    ) -> list[Rendering]:
        coefficients, feature, transforms = pose
        if self._playback is not None:
            psi = torch.cat([coefficients, feature])
            return [self._playback.render(psi, transforms, camera, background=background) for camera in cameras]
        assert self._poser is not None
        splats = self._poser.splats(coefficients, feature, transforms)
        return [self._renderer.render(splats, camera, background=background) for camera in cameras]


def playback_model(avatar: Avatar) -> PlaybackModel:
    """An avatar as the native engine plays it: rows are its deltas, then its pose correctives."""
    deltas, n_rows = avatar.deltas, len(avatar.deltas.means) + len(avatar.pose_basis)

    def levels(first: int, dtype: torch.dtype, *fields: Tensor) -> PlaybackDeltas:
        """Of channels that lie side by side; one row at a time, because all of them would be another avatar."""
        rows = (torch.cat([field[k].flatten(1) for field in fields], dim=1) for k in range(len(fields[0])))
        return _levels(rows, n_rows, first, dtype, avatar.n)

    opacity, base, rest = deltas.opacity_logits[..., None], deltas.sh[:, :, :1], deltas.sh[:, :, 1:]
    return PlaybackModel(
        n=avatar.n,
        rows=n_rows,
        sh_degree=avatar.sh_degree,
        neutral=_blocks(_channels(join([avatar.neutral, avatar.mouth_upper, avatar.mouth_lower]))),
        weights=_blocks(joint_weights(avatar)),
        deltas=(
            levels(0, torch.int16, torch.cat([deltas.means, avatar.pose_basis])),
            levels(_POSITION, torch.int8, deltas.quats, deltas.log_scales, opacity, base),
            levels(_SHAPE, torch.int8, rest),
        ),
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
    rows: Iterable[Float[Tensor, "f w"]], n_rows: int, first: int, dtype: torch.dtype, n: int
) -> PlaybackDeltas:
    """Channels from ``first`` on of the rows that have them, of which the first f of n Gaussians have any."""
    blocks, steps, found = -(-n // BLOCK), [], []
    live = torch.zeros(n_rows, blocks, dtype=torch.bool)
    for k, row in enumerate(rows):
        steps.append(row.abs().amax(0) / torch.iinfo(dtype).max)
        levels = (row / steps[k].clamp_min(torch.finfo(row.dtype).tiny)).round().to(dtype)
        levels = _blocks(torch.nn.functional.pad(levels, (0, 0, 0, n - len(levels))))
        live[k] = levels.flatten(1).any(1)
        found.append(levels[live[k]])
    width, count = len(steps[0]), live.sum(0)
    block, row_of = live.T.nonzero(as_tuple=True)  # the order of entries; `found` is row by row
    begin = torch.cat([count.new_zeros(1), count.cumsum(0)])
    place = torch.zeros(live.shape, dtype=torch.long)
    place[row_of, block] = torch.arange(len(block)) - begin[block]
    at_block = live.nonzero()[:, 1]
    to = begin[at_block, None] * width + torch.arange(width) * count[at_block, None] + place[live][:, None]
    levels = torch.empty(len(block) * width, BLOCK, dtype=dtype)
    levels[to.flatten()] = torch.cat(found).view(len(levels), BLOCK)
    padded = torch.zeros(width, n_rows)
    padded[:, : len(steps)] = torch.stack(steps, dim=1)
    return PlaybackDeltas(first, begin.int(), row_of.int().contiguous(), padded, levels.flatten())
