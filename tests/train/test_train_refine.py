"""Pose refinement finds its way back to a pose it knows, by the frame's pixels alone."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from make import TINY, tiny_avatar, tiny_head, tiny_sequence

from toonifygb import render
from toonifygb.avatar import Avatar
from toonifygb.structures import TrackedSequence
from toonifygb.train import Dataset, build_dataset, evaluate, refine_poses
from toonifygb.train.refine import _moved, _pivot, carried

if TYPE_CHECKING:
    from pathlib import Path


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

    return build_dataset(pairs(), sequence, tiny_head(), replace(TINY, crop_scale=5.0), folder)


def test_moved_motion_carries_the_posed_avatar() -> None:
    avatar, motion = opaque_avatar(), tiny_sequence().motion[4]
    twist = torch.tensor([0.1, -0.2, 0.05, 0.01, 0.02, -0.03])
    pivot = _pivot(avatar, motion)
    by_splats = carried(avatar.pose(motion), twist, pivot)
    by_motion = avatar.pose(_moved(avatar, motion, twist, pivot))
    assert (by_splats.means - by_motion.means).abs().max() < 1e-6
    assert by_splats.sh_frames is not None
    assert by_motion.sh_frames is not None
    assert (by_splats.sh_frames - by_motion.sh_frames).abs().max() < 1e-5


def test_refinement_undoes_a_wrong_pose(tmp_path: Path) -> None:
    sequence, avatar = tiny_sequence(20, 96), opaque_avatar()
    dataset = filmed(avatar, sequence, tmp_path)
    wrong_joints, wrong_place = sequence.motion.joints.clone(), sequence.motion.translation.clone()
    wrong_joints[:, 0] += torch.tensor([0.03, -0.04, 0.02])
    wrong_place += torch.tensor([0.002, -0.003, 0.008])
    wrong = replace(sequence, motion=replace(sequence.motion, joints=wrong_joints, translation=wrong_place))
    frames = [3, 11]
    right = refine_poses(avatar, dataset, wrong, frames)
    before = (wrong.motion.joints[frames, 0] - sequence.motion.joints[frames, 0]).norm(dim=-1)
    after = (right.motion.joints[frames, 0] - sequence.motion.joints[frames, 0]).norm(dim=-1)
    assert (after < 0.35 * before).all()
    scores = [evaluate(avatar, dataset, s, frames, refine=False)["psnr"] for s in (wrong, right)]
    assert scores[1] > scores[0] + 5
    untouched = [index for index in range(20) if index not in frames]
    assert torch.equal(right.motion.joints[untouched], wrong.motion.joints[untouched])
    assert torch.equal(right.motion.expression, wrong.motion.expression)


def test_a_right_pose_stays(tmp_path: Path) -> None:
    sequence, avatar = tiny_sequence(20, 96), opaque_avatar()
    dataset = filmed(avatar, sequence, tmp_path)
    kept = refine_poses(avatar, dataset, sequence, [6])
    assert (kept.motion.joints[6] - sequence.motion.joints[6]).abs().max() < 3e-3
    # Depth shows as size only: 6 mm of 600 are a fifth of a pixel at the edge of a head 40 px wide.
    shift = (kept.motion.translation[6] - sequence.motion.translation[6]).abs()
    assert (shift < torch.tensor([1e-3, 1e-3, 6e-3])).all()
