"""Playback in one call of the engine, against the avatar's definition and the reference renderer."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from make import tiny_avatar, tiny_camera, tiny_motion

from toonifygb import render
from toonifygb.avatar import Avatar, Player
from toonifygb.avatar.player import playback_model
from toonifygb.errors import BackendError
from toonifygb.render import library
from toonifygb.render.playback import BLOCK, NativePlayback, PlaybackDeltas
from toonifygb.structures import GaussianParams

MOTION, CAMERA = tiny_motion(), tiny_camera()
RED = torch.tensor([0.7, 0.1, 0.2])

needs_native = pytest.mark.skipif(library.unavailable() is not None, reason=str(library.unavailable()))


def trained(degree: int = 1) -> Avatar:
    """As training leaves it: local deltas in every field, most pairs dead, and pose correctives."""
    avatar = tiny_avatar(300, sh_degree=degree)
    random = torch.Generator().manual_seed(5)
    live = torch.rand(avatar.deltas.opacity_logits.shape, generator=random) < 0.3
    live[:, 2 * BLOCK : 3 * BLOCK] = False

    def shaken(size: float):
        def shake(delta: torch.Tensor) -> torch.Tensor:
            return (delta + size * torch.randn(delta.shape, generator=random)) * live.view(
                *live.shape, *[1] * (delta.ndim - 2)
            )

        return shake

    deltas = avatar.deltas
    deltas = GaussianParams(
        means=shaken(0.002)(deltas.means),
        quats=shaken(0.05)(deltas.quats),
        log_scales=shaken(0.2)(deltas.log_scales),
        opacity_logits=shaken(0.5)(deltas.opacity_logits),
        sh=shaken(0.1)(deltas.sh),
    )
    basis = 0.01 * torch.randn(avatar.pose_basis.shape, generator=random)
    return replace(avatar, deltas=deltas, pose_basis=basis)


def decoded(group: PlaybackDeltas, row: int, n: int) -> torch.Tensor:
    """(n, width) values of one row, read entry by entry as the layout says."""
    width = len(group.steps)
    values = torch.zeros(len(group.begin) - 1, BLOCK, width)
    for block in range(len(group.begin) - 1):
        first, entries = int(group.begin[block]), int(group.begin[block + 1] - group.begin[block])
        for entry in range(entries):
            if int(group.row[first + entry]) != row:
                continue
            for channel in range(width):
                at = (first * width + channel * entries + entry) * BLOCK
                values[block, :, channel] = group.levels[at : at + BLOCK] * group.steps[channel, row]
    return values.flatten(0, 1)[:n]


def rounded(avatar: Avatar) -> Avatar:
    """The avatar with the deltas that playback really has."""
    model, n = playback_model(avatar), avatar.neutral.n
    rows = [torch.cat([decoded(group, row, n) for group in model.deltas], dim=1) for row in range(model.rows)]
    k = len(avatar.deltas.means)
    values = torch.stack(rows[:k])
    means, quats, scales, opacity, sh = values.split([3, 4, 3, 1, values.shape[-1] - 11], dim=-1)
    deltas = GaussianParams(means, quats, scales, opacity[..., 0], sh.unflatten(-1, (-1, 3)))
    assert all((row[:, 3:] == 0).all() for row in rows[k:])
    return replace(avatar, deltas=deltas, pose_basis=torch.stack([row[:, :3] for row in rows[k:]]))


@needs_native
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_an_image_is_that_of_the_definition(degree: int) -> None:
    avatar = trained(degree)
    exact, player = rounded(avatar), Player(avatar, backend="native", threads=1)
    reference = render.get("reference")
    for index in (0, 7):
        [image] = player.render(MOTION[index], [CAMERA], background=RED)
        twin = reference.render(exact.pose(MOTION[index]), CAMERA, background=RED)
        assert (image.color - twin.color).abs().max() < 2e-4
        assert (image.alpha - twin.alpha).abs().max() < 2e-4
        whole = reference.render(avatar.pose(MOTION[index]), CAMERA, background=RED)
        assert 0 < (image.color - whole.color).square().mean() < 1e-5, "rounding deltas shows"


@needs_native
def test_deltas_that_change_nothing_take_no_room() -> None:
    avatar = trained()
    model, blocks = playback_model(avatar), -(-avatar.n // BLOCK)
    k = len(avatar.deltas.means)
    # One block of the face is dead, and the mouth is beyond the face.
    whole = -(-avatar.neutral.n // BLOCK) - 1
    for group in model.deltas[1:]:
        assert int(group.begin[-1]) == k * whole
    assert len(model.deltas[0].row) == k * whole + len(avatar.pose_basis) * (whole + 1)
    assert blocks > whole + 1


@needs_native
def test_every_thread_count_and_way_to_play_gives_the_same_bits() -> None:
    avatar = trained()
    one, two = (Player(avatar, backend="native", threads=threads) for threads in (1, 2))
    frames = list(one.play(MOTION, [CAMERA] * 20))
    assert len(frames) == 20
    for index, frame in enumerate(frames):
        [again] = two.render(MOTION[index], [CAMERA])
        assert (frame.color - again.color).abs().max() < 1e-4  # poses of many frames are rounded differently
    first, second = (next(player.play(MOTION, [CAMERA])) for player in (one, two))
    assert torch.equal(first.color, second.color) and torch.equal(first.alpha, second.alpha)


@needs_native
@pytest.mark.parametrize("isa", ["generic", "avx2", "avx512"])
def test_every_instruction_set_draws_the_same(isa: str) -> None:
    best, avatar = library.isa(), trained(3)
    [expected] = Player(avatar, backend="native").render(MOTION[3], [CAMERA])
    try:
        library.set_isa(isa)
    except BackendError:
        pytest.skip(f"this machine has no {isa}")
    try:
        [image] = Player(avatar, backend="native").render(MOTION[3], [CAMERA])
    finally:
        library.set_isa(best)
    assert (image.color - expected.color).abs().max() < 1e-4


def test_without_the_engine_it_is_the_definition() -> None:
    avatar = trained()
    player = Player(avatar, backend="reference")
    twin = render.get("reference").render(avatar.pose(MOTION[4]), CAMERA, background=RED)
    [image] = player.render(MOTION[4], [CAMERA], background=RED)
    assert (image.color - twin.color).abs().max() < 5e-4
    assert len(list(player.play(MOTION[:3], [CAMERA] * 9))) == 3
    assert len(list(player.play(MOTION, [CAMERA] * 2))) == 2


@needs_native
def test_what_does_not_fit_is_refused() -> None:
    model = playback_model(trained())
    with pytest.raises(ValueError, match="expected"):
        replace(model, n=model.n + BLOCK)
    with pytest.raises(ValueError, match="do not fit together"):
        replace(model, deltas=(replace(model.deltas[0], row=model.deltas[0].row[:-1]), *model.deltas[1:]))
    with pytest.raises(ValueError, match="psi, transforms are"):
        NativePlayback(model, 1).render(torch.zeros(model.rows + 1), torch.eye(4).expand(5, 4, 4), CAMERA)
