"""Photometric tracking: pose and expression of every frame, fitted to the pixels of the clip.

Landmarks fix the face to about a pixel, but ears, hair and outline stand off the face, and the landmarks of a
nodding head follow it only in part; a degree of rotation or a few millimetres of depth move the outline by pixels.
So a small avatar that only the head model moves is trained on the training frames, and between its steps every
frame takes a Gauss-Newton step towards its own picture, while the avatar grows sharper. Held-out frames follow the
same rule as all others except that the avatar never learns from them, which is what photometric trackers of a whole
clip do as well (3DGB's among them). The direction of gaze stays that of the landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch

from toonifygb import render
from toonifygb.avatar import init_avatar
from toonifygb.avatar.fields import each, rows
from toonifygb.config import TrainConfig
from toonifygb.head import JAW
from toonifygb.progress import SILENT
from toonifygb.structures import HeadMotion
from toonifygb.threads import one_torch_thread
from toonifygb.train.loop import fingerprint
from toonifygb.train.poses import RIGID, Poses, carried
from toonifygb.train.state import TrainState, read_checkpoint, write_checkpoint
from toonifygb.train.step import Stepper
from toonifygb.train.views import TrainingViews

if TYPE_CHECKING:
    from pathlib import Path

    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from toonifygb.avatar import Avatar
    from toonifygb.head import HeadModel
    from toonifygb.progress import Progress
    from toonifygb.render import Renderer
    from toonifygb.structures import Camera, Rendering, Splats, TrackedSequence
    from toonifygb.train.data import Dataset

SIZE = 256
"""Frames are looked at at about this size, px: half a pixel there is far below what is to be corrected."""
STEPS = 700
"""Training steps of the small avatar."""
PASSES = (200, 300, 400, 500, 600)
"""Steps after which all frames are fitted; later passes move the heads by less than a tenth of a degree."""
GAIN = 1.2
"""Share of a Gauss-Newton step that is taken: the curvature is a mean over frames."""
CURVATURE_FRAMES = 5
"""Frames whose curvature is measured: that of an image in its pose hardly depends on which frame it is."""
RIGID_PRIOR = (0.05, 0.05, 0.05, 0.005, 0.005, 0.02)
"""How far the landmark track may be off: rotation vector, rad, and translation, m; standard deviations."""
JAW_PRIOR = (0.03, 0.01, 0.01)
"""The same for the jaw's rotation vector, rad,"""
EXPRESSION_PRIOR = 0.3
"""for expression coefficients, in units of the head model's σ,"""
EYELID_PRIOR = 0.2
"""and for the lids."""
CHIN = 152
"""Landmark at the tip of the chin."""
NOISE = 0.1
"""Standard deviation of a pixel that the avatar cannot explain, 0..1."""
RIGID_DIFFERENCE = 0.08
"""Finite differences, as shares of the prior: of the head's quantities, which move the image by half a pixel,"""
FACE_DIFFERENCE = 0.3
"""and of the face's, which move less of it."""


def refine_track(
    dataset: Dataset,
    sequence: TrackedSequence,
    head: HeadModel,
    *,
    seed: int = 0,
    backend: str = "auto",
    threads: int | None = None,
    checkpoint: Path | None = None,
    progress: Progress = SILENT,
) -> TrackedSequence:
    """The track with head pose, jaw, eyelids and expression of every frame of the split fitted to its pixels.

    What all frames have in common (the whole clip turned, shifted in the head's own axes or smiling a little more)
    belongs to the avatar, not to the frames, and is left as the landmarks found it.

    Args:
        dataset: crops and mattes; the avatar is trained on ``split.train``, frames are fitted in both sets.
        sequence: the landmark track.
        head: its head model.
        seed: of the training.
        backend: rasteriser.
        threads: of the native engine.
        checkpoint: file that is written after every pass; a call that finds it goes on from there.
        progress: told after every step and every fitted frame; figure ``turn_deg``, the mean of the last pass.
    """
    small = dataset.reduced(max(f for f in range(1, max(1, dataset.size // SIZE) + 1) if dataset.size % f == 0))
    frames = torch.tensor(sorted(small.split.train + small.split.test))
    config = _settings(small.size, seed)
    renderer = render.get(backend, threads)
    facts = {"fingerprint": fingerprint(config, small, sequence)}
    total = STEPS + len(PASSES) * len(frames)
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
        prior = _prior(avatar, head)
        state = TrainState.start(avatar, seed)
        rigid = _above_chin(state, sequence, head)
        fresh = (state, sequence, torch.zeros(sequence.n_frames, len(prior)), {})
        state, sequence, earlier, figures = _resumed(checkpoint, facts, sequence) or fresh
        state = state.to(kernels.device)
        stepper = Stepper(state, avatar, small, sequence, config, renderer, kernels)
        done = state.step + sum(state.step >= number for number in PASSES) * len(frames)
        while state.step < STEPS:
            stepper.step()
            done += 1
            progress.update(done, total, **figures)
            if state.step not in PASSES:
                continue
            poses = Poses(avatar, head, sequence)
            look = _Look(stepper, small, poses, rigid, renderer)
            curvature = look.curvature(frames, prior)
            changes = torch.zeros_like(earlier)
            for index in frames.tolist():
                changes[index] = _newton(curvature, look.slope(index), earlier[index], prior, small.size)
                done += 1
                progress.update(done, total, **figures)
            changes = poses.without_common(changes, earlier, frames)
            sequence, earlier = poses.moved(changes), earlier + changes
            stepper.follow(sequence)
            figures = {"turn_deg": float(torch.rad2deg(changes[frames, :3].norm(dim=-1)).mean())}
            if checkpoint is not None:
                beside = {"earlier": earlier} | vars(sequence.motion)
                write_checkpoint(state, checkpoint, facts | {"figures": figures}, beside)
    return sequence


_Progressed = tuple[TrainState, "TrackedSequence", "Tensor", dict[str, float]]


def _settings(size: int, seed: int) -> TrainConfig:
    """Those of the small avatar that frames are fitted to; crops of ``size`` px."""
    return TrainConfig(
        n_gaussians=10_000,
        n_mouth_gaussians=1_000,
        resolution=size,
        steps=STEPS,
        delta_frames=1,
        dropout=0.0,
        blendshapes="full",  # the units' own deltas are what the slopes of expressions come from
        seed=seed,
    )


def _resumed(checkpoint: Path | None, wanted: dict[str, str], fitted: TrackedSequence) -> _Progressed | None:
    """State, track, changes since the landmark track and figures after the last pass that was written."""
    if checkpoint is None or not checkpoint.is_file():
        return None
    state, facts, beside = read_checkpoint(checkpoint)
    if facts.get("fingerprint") != wanted["fingerprint"]:
        return None
    earlier = beside.pop("earlier")
    return state, replace(fitted, motion=HeadMotion(**beside)), earlier, facts["figures"]


def _above_chin(state: TrainState, sequence: TrackedSequence, head: HeadModel) -> Bool[Tensor, " n"]:
    """Which Gaussians turn with the skull: those of the neck stay with the shoulders and would hold it back."""
    chin = head.landmarks().subset(torch.tensor([CHIN])).rest(sequence.shape)[0, 1]
    return state.neutral.values.means[:, 1].cpu() > chin


def _prior(avatar: Avatar, head: HeadModel) -> Float[Tensor, " c"]:
    """How far the landmark track may be off in each quantity of a change, standard deviations."""
    units = EXPRESSION_PRIOR * head.expression_sigma[: avatar.n_expressions]
    lids = units.new_full((avatar.n_eyelids,), EYELID_PRIOR)
    return torch.cat([units.new_tensor(RIGID_PRIOR + JAW_PRIOR), units, lids])


def _newton(
    curvature: Float[Tensor, "c c"],
    slope: Float[Tensor, " c"],
    earlier: Float[Tensor, " c"],
    prior: Float[Tensor, " c"],
    size: int,
) -> Float[Tensor, " c"]:
    """Damped step of one frame; images of ``size`` px hold about so many independent witnesses."""
    weight, precision = 1 / (NOISE**2 * size), prior**-2
    system = weight * curvature + torch.diag(precision)
    return -GAIN * torch.linalg.solve(system, weight * slope + precision * earlier)


@dataclass(frozen=True)
class _Look:
    """How the pictures of the avatar, as it stands now, answer to changes of pose and expression."""

    stepper: Stepper
    dataset: Dataset
    poses: Poses
    rigid: Bool[Tensor, " n"]
    """Gaussians that turn with the head."""
    renderer: Renderer

    def slope(self, index: int) -> Float[Tensor, " c"]:
        """Half the derivative of one frame's squared image error by a change, to first order."""
        pull = self.stepper.pull(index, _errors)
        means, forces = pull.splats.means.cpu(), pull.world.means.cpu()
        arm, force = (means - self._pivot[index])[self.rigid], forces[self.rigid]
        lever = self.stepper.state.skin_weights[:, JAW, None].cpu() * (means - self._jaw[index])
        torque = torch.linalg.cross(lever, forces).sum(0)
        blend = torch.zeros(self.poses.width - RIGID - 3)
        for name, delta in each(self.stepper.state.expression.values):
            matrix = rows(delta)
            blend += (matrix @ getattr(pull.raw, name).reshape(-1)[: matrix.shape[1]]).cpu()
        turn = torch.linalg.cross(arm, force).sum(0)
        return torch.cat([turn, force.sum(0), self._rotation[index].mT @ torque, blend])

    def curvature(self, frames: Int[Tensor, " n"], prior: Float[Tensor, " c"]) -> Float[Tensor, "c c"]:
        """Mean Gauss-Newton matrix of the squared image error, over frames spread evenly."""
        spread = torch.linspace(0, len(frames) - 1, min(CURVATURE_FRAMES, len(frames))).round().long()
        total = torch.zeros(len(prior), len(prior))
        with torch.no_grad():
            for index in frames[spread].tolist():
                jacobian = self._jacobian(index, prior)
                total += jacobian @ jacobian.T
        return total / len(spread)

    def _jacobian(self, index: int, prior: Float[Tensor, " c"]) -> Float[Tensor, "c p"]:
        """Derivative of all pixels of one frame by a change, by finite differences."""
        camera, splats = self.dataset.camera(index), self.stepper.splats(index)
        still = _pixels(splats, camera, self.renderer)
        heads, faces = torch.diag(RIGID_DIFFERENCE * prior[:RIGID]), torch.diag(FACE_DIFFERENCE * prior)[RIGID:]
        moved = [carried(splats, head, self._pivot[index], self.rigid) for head in heads]
        changed = self.poses.faces(index, faces)
        moved += [self.stepper.splats_of(changed[number]) for number in range(len(faces))]
        steps = torch.cat([heads.sum(1), faces.sum(1)])
        return torch.stack([_pixels(one, camera, self.renderer).sub_(still) for one in moved]) / steps[:, None]

    @cached_property
    def _pivot(self) -> Float[Tensor, "t 3"]:
        return self.poses.pivot

    @cached_property
    def _jaw(self) -> Float[Tensor, "t 3"]:
        return self.poses.jaw

    @cached_property
    def _rotation(self) -> Float[Tensor, "t 3 3"]:
        return self.poses.rotation


def _errors(shown: Rendering, color: Tensor, matte: Tensor) -> tuple[Tensor, Tensor]:
    """Half the derivative of the squared error by colour and opacity."""
    return (shown.color - color).detach(), (shown.alpha - matte).detach()


def _pixels(splats: Splats, camera: Camera, renderer: Renderer) -> Float[Tensor, " p"]:
    """Colour and opacity of a rendering, flat."""
    shown = renderer.render(splats, camera)
    return torch.cat([shown.color.flatten(), shown.alpha.flatten()])
