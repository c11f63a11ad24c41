"""Photometric tracking finds head poses it knows by pixels alone."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
import torch
from make import TINY, tiny_avatar, tiny_head, tiny_sequence

from toonifygb import render
from toonifygb.avatar import Avatar, init_avatar
from toonifygb.geometry.rotations import matrix_to_axis_angle
from toonifygb.progress import Stopped
from toonifygb.structures import TrackedSequence
from toonifygb.train import Dataset, build_dataset, photometric, refine_track
from toonifygb.train.photometric import _Look
from toonifygb.train.poses import RIGID, Poses, carried
from toonifygb.train.state import TrainState, read_checkpoint
from toonifygb.train.step import Stepper

if TYPE_CHECKING:
    from pathlib import Path

    from torch import Tensor

N = 24
SIZE = 96


def opaque_avatar() -> Avatar:
    """Without pose-driven deltas: a rigid motion then moves exactly the picture it should."""
    avatar = tiny_avatar(n=400, seed=7)
    return replace(
        avatar,
        drivers=None,
        blendshape_names=avatar.blendshape_names[:6],
        deltas=avatar.deltas.map(lambda delta: delta[:6]),
        neutral=replace(avatar.neutral, opacity_logits=avatar.neutral.opacity_logits + 2),
    )


def filmed(avatar: Avatar, sequence: TrackedSequence, folder: Path) -> Dataset:
    def pairs():
        with torch.no_grad():
            for index in range(sequence.n_frames):
                image = render.get("auto", 1).render(avatar.pose(sequence.motion[index]), sequence.camera)
                color = image.color / image.alpha.clamp_min(1e-3)[..., None]
                yield (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy(), image.alpha.clamp(0, 1).numpy()

    config = replace(TINY, crop_scale=5.0, resolution=SIZE)
    return build_dataset(pairs(), sequence, tiny_head(), config, folder)


def shaken(sequence: TrackedSequence) -> TrackedSequence:
    """Every head turned and shifted a little, each in its own way."""
    generator = torch.Generator().manual_seed(3)
    joints = sequence.motion.joints.clone()
    joints[:, 1] += 0.04 * torch.randn(N, 3, generator=generator)
    translation = sequence.motion.translation + 0.003 * torch.randn(N, 3, generator=generator)
    return replace(sequence, motion=replace(sequence.motion, joints=joints, translation=translation))


def scatter(sequence: TrackedSequence, truth: TrackedSequence) -> Tensor:
    """How far each head's turn is off, rad, what all have in common left out."""
    ours, true = (Poses(opaque_avatar(), tiny_head(), s).rotation for s in (sequence, truth))
    off = matrix_to_axis_angle(true.mT @ ours)
    return (off - off.mean(0)).norm(dim=-1)


def test_moved_motion_carries_the_posed_avatar() -> None:
    avatar, sequence = opaque_avatar(), tiny_sequence()
    twist = torch.tensor([0.1, -0.2, 0.05, 0.01, 0.02, -0.03])
    poses = Poses(avatar, tiny_head(), sequence)
    change = torch.cat([twist, torch.zeros(poses.width - RIGID)])
    splats = avatar.pose(sequence.motion[4])
    by_splats = carried(splats, twist, poses.pivot[4], torch.ones(len(splats.means), dtype=torch.bool))
    by_motion = avatar.pose(poses.moved(change.expand(sequence.n_frames, -1)).motion[4])
    on_head = torch.ones(len(splats.means), dtype=torch.bool)
    on_head[: avatar.neutral.n] = avatar.skin_weights[:, 0] == 0  # what hangs on the body stays with it
    assert (by_splats.means - by_motion.means)[on_head].abs().max() < 1e-6
    assert by_splats.sh_frames is not None
    assert by_motion.sh_frames is not None
    assert (by_splats.sh_frames - by_motion.sh_frames)[on_head].abs().max() < 1e-5
    assert (by_splats.means - by_motion.means)[~on_head].norm(dim=-1).mean() > 1e-3


def test_only_the_chosen_are_carried() -> None:
    splats = opaque_avatar().pose(tiny_sequence().motion[0])
    some = torch.arange(len(splats.means)) % 3 == 0
    moved = carried(splats, torch.full((6,), 0.01), torch.zeros(3), some)
    assert ((moved.means != splats.means).any(-1) == some).all()
    assert torch.equal(moved.quats[~some], splats.quats[~some])


def test_common_changes_are_left_to_the_avatar() -> None:
    """A turn of all heads in their own axes does not move them; one that differs from frame to frame does."""
    sequence = tiny_sequence()
    poses, frames = Poses(opaque_avatar(), tiny_head(), sequence), torch.arange(2, 18)
    common = torch.tensor([[0.02, -0.01, 0.03], [0.001, 0.002, -0.004]])
    heads = torch.einsum("tab,kb->tka", poses.rotation, common).flatten(1)
    faces = torch.linspace(-0.1, 0.1, poses.width - RIGID).expand(len(heads), -1)
    same = torch.cat([heads, faces], 1)
    nothing = torch.zeros_like(same)
    assert poses.without_common(same, nothing, frames)[frames].abs().max() < 1e-6
    own = nothing.clone()
    own[5, 0] = 0.1
    assert poses.without_common(own, nothing, frames)[5, 0] > 0.09


def test_faces_stay_within_their_limits() -> None:
    head, sequence = tiny_head(), tiny_sequence()
    poses = Poses(opaque_avatar(), head, sequence)
    far = torch.full((sequence.n_frames, poses.width), 10.0)
    far[:, :9] = 0
    motion = poses.moved(far).motion
    assert torch.equal(motion.expression, head.expression_upper.maximum(sequence.motion.expression))
    assert torch.equal(motion.eyelids, sequence.motion.eyelids.clamp_min(1))
    below = poses.moved(-far).motion
    assert torch.equal(below.expression, head.expression_lower.minimum(sequence.motion.expression))


def test_slope_is_the_derivative_of_the_squared_error(tmp_path: Path) -> None:
    """Of jaw, expression and lids, against central differences through posing and rendering."""
    sequence, head, index = tiny_sequence(N, SIZE), tiny_head(), 4
    dataset = filmed(opaque_avatar(), sequence, tmp_path)
    config = replace(TINY, n_gaussians=400, resolution=SIZE)
    avatar = init_avatar(head, sequence.shape, config, camera=dataset.camera(0), full_camera=dataset.full_camera)
    avatar = replace(
        avatar,
        neutral=replace(avatar.neutral, opacity_logits=avatar.neutral.opacity_logits + 3),
        pose_basis=0 * avatar.pose_basis,
    )
    renderer = render.get("auto", 1)
    state = TrainState.start(avatar, 0)
    stepper = Stepper(state, avatar, dataset, sequence, config, renderer, render.kernels("auto", 1))
    poses = Poses(avatar, head, sequence)
    look = _Look(stepper, dataset, poses, torch.ones(state.counts.all, dtype=torch.bool), renderer)
    slope = look.slope(index)[RIGID:]

    def error(changes: Tensor) -> float:
        shown = renderer.render(stepper.splats_of(poses.faces(index, changes)[0]), dataset.camera(index))
        color, matte = dataset.target(index)
        return float((shown.color - color).double().square().sum() + (shown.alpha - matte).double().square().sum())

    def numeric(number: int) -> float:
        change = torch.zeros(1, poses.width)
        change[0, number] = step = 5e-3 if number < RIGID + 3 else 2e-2
        return (error(change) - error(-change)) / (4 * step)

    exact = torch.tensor([numeric(number) for number in range(RIGID, poses.width)])
    jaw, units = slice(0, 3), slice(3, None)
    # The jaw's is to first order in its own angle, and the turn of what it carries is left out.
    assert (slope[jaw] - exact[jaw]).norm() < 0.25 * exact[jaw].norm()
    # A picture of a few hundred Gaussians with hard cut-offs is rough: the directions agree, the lengths nearly.
    assert torch.cosine_similarity(slope[units], exact[units], dim=0) > 0.97
    assert 0.7 < slope[units].norm() / exact[units].norm() < 1.4


@pytest.mark.slow
def test_poses_are_found_in_both_sets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photometric, "STEPS", 300)
    monkeypatch.setattr(photometric, "PASSES", tuple(range(60, 300, 30)))
    truth, avatar = tiny_sequence(N, SIZE), opaque_avatar()
    dataset = filmed(avatar, truth, tmp_path)
    wrong = shaken(truth)
    found = refine_track(dataset, wrong, tiny_head(), threads=1)
    before, after = scatter(wrong, truth), scatter(found, truth)
    for frames in (list(dataset.split.train), list(dataset.split.test)):
        assert after[frames].mean() < 0.85 * before[frames].mean()
    assert torch.equal(found.motion.joints[:, 3:], wrong.motion.joints[:, 3:])  # gaze
    assert torch.equal(found.motion.joints[:, 0], wrong.motion.joints[:, 0])

    class StopAfterTwoPasses:
        def update(self, done: int, total: int | None, **figures: float) -> None:
            if done == 150 + 2 * N:
                raise Stopped

    checkpoint = tmp_path / "refine.safetensors"
    with pytest.raises(Stopped):
        refine_track(dataset, wrong, tiny_head(), threads=2, checkpoint=checkpoint, progress=StopAfterTwoPasses())
    written = read_checkpoint(checkpoint)[0].step
    assert written in photometric.PASSES
    again = refine_track(dataset, wrong, tiny_head(), threads=2, checkpoint=checkpoint)
    for name, values in vars(found.motion).items():
        assert torch.equal(getattr(again.motion, name), values), name


def test_reduced_targets_are_means_of_pixels(tmp_path: Path) -> None:
    dataset = filmed(opaque_avatar(), tiny_sequence(N, SIZE), tmp_path)
    color, matte = dataset.target(5)
    small = dataset.reduced(2)
    less, less_matte = small.target(5)
    assert small.size == less.shape[0] == SIZE // 2
    assert (less - color.view(SIZE // 2, 2, SIZE // 2, 2, 3).mean((1, 3))).abs().max() < 1e-6
    assert (less_matte - matte.view(SIZE // 2, 2, SIZE // 2, 2).mean((1, 3))).abs().max() < 1e-6
    assert torch.allclose(small.camera(5).K[:2] * 2, dataset.camera(5).K[:2])
