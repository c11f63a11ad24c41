"""Photometric tracking: the head's pose in every frame, fitted to the pixels of the clip.

Landmarks fix the face to about a pixel, but ears, hair and outline stand off the face, and the landmarks of a
nodding head follow it only in part; a degree of rotation or a few millimetres of depth move the outline by pixels.
So a small avatar that only the head model moves is trained on the training frames, and between its steps the pose
of every frame takes a Gauss-Newton step towards its own picture, while the avatar grows sharper. Held-out frames
follow the same rule as all others except that the avatar never learns from them, which is what photometric
trackers of a whole clip do as well (3DGB's among them). Expressions stay those of the landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from toonifygb import render
from toonifygb.avatar import init_avatar
from toonifygb.avatar.model import NECK, ROOT
from toonifygb.config import TrainConfig
from toonifygb.geometry.rotations import (
    axis_angle_to_matrix,
    matrix_to_axis_angle,
    matrix_to_quat,
    quat_multiply,
)
from toonifygb.progress import SILENT
from toonifygb.threads import one_torch_thread
from toonifygb.train.state import TrainState
from toonifygb.train.step import Stepper
from toonifygb.train.views import TrainingViews

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from toonifygb.avatar import Avatar
    from toonifygb.head import HeadModel
    from toonifygb.progress import Progress
    from toonifygb.render import Renderer
    from toonifygb.structures import Camera, Splats, TrackedSequence
    from toonifygb.train.data import Dataset

SIZE = 256
"""Frames are looked at at about this size, px: half a pixel there is far below what is to be corrected."""
STEPS = 700
"""Training steps of the small avatar."""
PASSES = (200, 300, 400, 500, 600)
"""Steps after which all poses are fitted; later passes move them by less than a tenth of a degree."""
GAIN = 0.8
"""Share of a Gauss-Newton step that is taken: the curvature is a mean over frames."""
CURVATURE_FRAMES = 8
"""Frames whose curvature is measured: that of an image in its pose hardly depends on which frame it is."""
PRIOR = (0.05, 0.05, 0.05, 0.005, 0.005, 0.02)
"""How far the landmark track may be off: rotation vector, rad, and translation, m; standard deviations."""
CHIN = 152
"""Landmark at the tip of the chin."""
NOISE = 0.1
"""Standard deviation of a pixel that the avatar cannot explain, 0..1."""
DIFFERENCES = (4e-3, 4e-3, 4e-3, 4e-4, 4e-4, 2e-3)
"""Finite differences for the curvature, same units; each moves the image by about half a pixel."""


def refine_track(
    dataset: Dataset,
    sequence: TrackedSequence,
    head: HeadModel,
    *,
    seed: int = 0,
    backend: str = "auto",
    threads: int | None = None,
    progress: Progress = SILENT,
) -> TrackedSequence:
    """The track with the rigid head pose of every frame of the split fitted to its pixels.

    What all frames have in common (the whole clip turned or shifted in the head's own axes) belongs to the
    avatar, not to the poses, and is left as the landmarks found it.

    Args:
        dataset: crops and mattes; the avatar is trained on ``split.train``, poses are fitted in both sets.
        sequence: the landmark track.
        head: its head model.
        seed: of the training.
        backend: rasteriser.
        threads: of the native engine.
        progress: told after every step and every fitted frame; figure ``turn_deg``, the mean of the last pass.
    """
    small = dataset.reduced(max(f for f in range(1, max(1, dataset.size // SIZE) + 1) if dataset.size % f == 0))
    frames = torch.tensor(sorted(small.split.train + small.split.test))
    config = TrainConfig(n_gaussians=10_000, n_mouth_gaussians=1_000, resolution=small.size, steps=STEPS, seed=seed)
    renderer = render.get(backend, threads)
    done, total, figures = 0, STEPS + len(PASSES) * len(frames), {}
    with one_torch_thread():
        avatar = init_avatar(
            head,
            sequence.shape,
            config,
            camera=small.camera(small.split.train[0]),
            full_camera=small.full_camera,
            views=TrainingViews(small, sequence, head),
        )
        kernels = render.kernels(backend, threads)
        state = TrainState.start(avatar, seed).to(kernels.device)
        stepper = Stepper(state, avatar, small, sequence, config, renderer, kernels)
        rigid = _above_chin(state, sequence, head)
        twists = torch.zeros(sequence.n_frames, 6)
        while state.step < STEPS:
            stepper.step()
            done += 1
            progress.update(done, total, **figures)
            if state.step not in PASSES:
                continue
            poses = _Poses(avatar, sequence)
            pivot = poses.pivot
            curvature = _curvature(stepper, small, poses, frames, rigid, renderer)
            changes = torch.zeros_like(twists)
            for index in frames.tolist():
                slope = _slope(stepper.splats(index), pivot[index], small, index, rigid, renderer)
                changes[index] = _newton(curvature, slope, twists[index], small.size)
                done += 1
                progress.update(done, total, **figures)
            changes = poses.without_common(changes, twists, frames)
            sequence, twists = poses.moved(changes), twists + changes
            stepper.follow(sequence)
            figures = {"turn_deg": float(torch.rad2deg(changes[frames, :3].norm(dim=-1)).mean())}
    return sequence


@dataclass(frozen=True)
class _Poses:
    """The rigid poses of a clip's heads and what moving them needs."""

    avatar: Avatar
    sequence: TrackedSequence

    @property
    def pivot(self) -> Float[Tensor, "t 3"]:
        """Middle of the eyes in the world, m: turning about it hardly moves what the landmarks have fixed."""
        eyes = self.avatar.transforms(self.sequence.motion)[:, 3:, :3]
        rest = self.avatar.rest_joints[3:]
        return (torch.einsum("tjab,jb->tja", eyes[..., :3], rest) + eyes[..., 3]).mean(1)

    @property
    def rotation(self) -> Float[Tensor, "t 3 3"]:
        """Head to world: the root's turn, then the neck's."""
        turns = axis_angle_to_matrix(self.sequence.motion.joints[:, : NECK + 1])
        return turns[:, ROOT] @ turns[:, NECK]

    def without_common(
        self, changes: Float[Tensor, "t 6"], twists: Float[Tensor, "t 6"], frames: Int[Tensor, " n"]
    ) -> Float[Tensor, "t 6"]:
        """Changes after which the twists have no mean in the head's axes.

        Args:
            changes: about to be made, world axes.
            twists: made since the landmark track.
            frames: those that count and change.
        """
        turn = self.rotation[frames]
        both = (changes + twists)[frames].view(-1, 2, 3)
        common = torch.einsum("nba,nkb->nka", turn, both).mean(0)
        left = changes.clone()
        left[frames] -= torch.einsum("nab,kb->nka", turn, common).flatten(1)
        return left

    def moved(self, twists: Float[Tensor, "t 6"]) -> TrackedSequence:
        """The track with every head turned about its pivot by a rotation vector, then shifted, world axes."""
        motion, pivot = self.sequence.motion, self.pivot
        turn = axis_angle_to_matrix(twists[:, :3])
        body = axis_angle_to_matrix(motion.joints[:, ROOT])
        joints = motion.joints.clone()
        joints[:, NECK] = matrix_to_axis_angle(body.mT @ turn @ self.rotation)
        # The head hangs on the neck joint: the body goes where that joint has to go.
        placed = self.avatar.transforms(motion)[:, ROOT]
        rest = self.avatar.rest_joints[NECK] + motion.expression @ self.avatar.joint_expression_basis[NECK].T
        neck = torch.einsum("tab,tb->ta", placed[:, :3, :3], rest) + placed[:, :3, 3]
        arm = neck - pivot
        translation = motion.translation + torch.einsum("tab,tb->ta", turn, arm) - arm + twists[:, 3:]
        return replace(self.sequence, motion=replace(motion, joints=joints, translation=translation))


def _above_chin(state: TrainState, sequence: TrackedSequence, head: HeadModel) -> Bool[Tensor, " n"]:
    """Which Gaussians turn with the skull: those of the neck stay with the shoulders and would hold it back."""
    chin = head.landmarks().subset(torch.tensor([CHIN])).rest(sequence.shape)[0, 1]
    return state.neutral.values.means[:, 1].cpu() > chin


def _newton(
    curvature: Float[Tensor, "6 6"], slope: Float[Tensor, " 6"], twist: Float[Tensor, " 6"], size: int
) -> Float[Tensor, " 6"]:
    """Damped step of one frame's pose; images of ``size`` px hold about so many independent witnesses."""
    weight, precision = 1 / (NOISE**2 * size), torch.tensor(PRIOR) ** -2
    system = weight * curvature + torch.diag(precision)
    return -GAIN * torch.linalg.solve(system, weight * slope + precision * twist)


def _slope(
    splats: Splats,
    pivot: Float[Tensor, " 3"],
    dataset: Dataset,
    index: int,
    rigid: Bool[Tensor, " n"],
    renderer: Renderer,
) -> Float[Tensor, " 6"]:
    """Half the derivative of the squared image error by the pose, as the Gaussians' positions carry it."""
    means = splats.means.detach().requires_grad_()
    shown = renderer.render(replace(splats, means=means), dataset.camera(index))
    color, matte = dataset.target(index)
    errors = [(shown.color - color).detach(), (shown.alpha - matte).detach()]
    (pull,) = torch.autograd.grad([shown.color, shown.alpha], [means], errors)
    arm, pull = (means.detach() - pivot)[rigid], pull[rigid]
    return torch.cat([torch.linalg.cross(arm, pull).sum(0), pull.sum(0)])


def _curvature(
    stepper: Stepper,
    dataset: Dataset,
    poses: _Poses,
    frames: Int[Tensor, " n"],
    rigid: Bool[Tensor, " n"],
    renderer: Renderer,
) -> Float[Tensor, "6 6"]:
    """Mean Gauss-Newton matrix of the squared image error in the pose, over frames spread evenly."""
    spread = torch.linspace(0, len(frames) - 1, min(CURVATURE_FRAMES, len(frames))).round().long()
    pivot = poses.pivot
    total = torch.zeros(6, 6)
    with torch.no_grad():
        for index in frames[spread].tolist():
            splats, camera = stepper.splats(index), dataset.camera(index)
            still = _pixels(splats, camera, renderer)
            jacobian = torch.stack(
                [
                    (_pixels(carried(splats, row, pivot[index], rigid), camera, renderer) - still) / row.sum()
                    for row in torch.diag(torch.tensor(DIFFERENCES))
                ]
            )
            total += jacobian @ jacobian.T
    return total / len(spread)


def _pixels(splats: Splats, camera: Camera, renderer: Renderer) -> Float[Tensor, " p"]:
    """Colour and opacity of a rendering, flat."""
    shown = renderer.render(splats, camera)
    return torch.cat([shown.color.flatten(), shown.alpha.flatten()])


def carried(
    splats: Splats, twist: Float[Tensor, " 6"], pivot: Float[Tensor, " 3"], which: Bool[Tensor, " n"]
) -> Splats:
    """Splats of which some are turned about the pivot by a rotation vector, then shifted."""
    rotation = axis_angle_to_matrix(twist[:3])
    turn = matrix_to_quat(rotation).expand_as(splats.quats)
    some = which[:, None]
    frames = splats.sh_frames
    return replace(
        splats,
        means=torch.where(some, (splats.means - pivot) @ rotation.T + pivot + twist[3:], splats.means),
        quats=torch.where(some, quat_multiply(turn, splats.quats), splats.quats),
        sh_frames=None if frames is None else torch.where(some[..., None], rotation @ frames, frames),
    )
