"""Finer head poses from the pixels: the rigid motion of single frames fitted against a trained avatar.

Landmarks fix the face to about a pixel, but ears, hair and outline stand off the face, and a degree of rotation or
a few millimetres of depth move them by pixels. Six numbers per frame, found by Gauss-Newton on the image itself,
put that right. The rule looks at one frame and the avatar, nothing else, so it applies alike to frames the avatar
was trained on, to held-out ones and to new clips; 3DGB's tracker, too, fits every frame's pose to its own pixels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from toonifygb import render
from toonifygb.avatar import Poser
from toonifygb.geometry.rotations import (
    axis_angle_to_matrix,
    matrix_to_axis_angle,
    matrix_to_quat,
    quat_multiply,
)
from toonifygb.progress import SILENT
from toonifygb.structures import Camera, HeadMotion, Splats

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.avatar import Avatar
    from toonifygb.progress import Progress
    from toonifygb.render import Renderer
    from toonifygb.structures import TrackedSequence
    from toonifygb.train.data import Dataset

WORK_SIZE = 256
"""Frames are fitted at about this size, px: half a pixel there is far below what is to be corrected."""
ROUNDS, ITERATIONS = 2, 2
"""Rounds of Gauss-Newton steps; before each the avatar is posed anew, as its pose-driven deltas follow the pose."""
_STEP = torch.tensor([4e-3, 4e-3, 4e-3, 4e-4, 4e-4, 2e-3])
"""Finite differences: rotation, rad, and translation, m; each moves the image by about half a pixel."""
_PRIOR = torch.tensor([0.05, 0.05, 0.05, 0.005, 0.005, 0.02])
"""How far the landmark track may be off, standard deviations, same units."""
_NOISE = 0.1
"""Standard deviation of a pixel the avatar cannot explain, 0..1."""
_SHRINK = 0.5
"""A step that makes the image worse is shortened by this, at most ``_TRIALS`` times."""
_TRIALS = 3


def refine_poses(
    avatar: Avatar,
    dataset: Dataset,
    sequence: TrackedSequence,
    frames: Sequence[int],
    *,
    backend: str = "auto",
    threads: int | None = None,
    progress: Progress = SILENT,
) -> TrackedSequence:
    """The track with the rigid head pose of some frames fitted to their pixels; expressions stay as they are.

    Args:
        avatar: what the frames should look like; not changed.
        dataset: the frames.
        sequence: the landmark track.
        frames: which to fit.
        backend: rasteriser.
        threads: of the native engine.
        progress: told after every frame.
    """
    poser = Poser(avatar, backend=backend, threads=threads)
    renderer = render.get(backend, threads)
    joints, translation = sequence.motion.joints.clone(), sequence.motion.translation.clone()
    for done, index in enumerate(frames, start=1):
        motion = sequence.motion[index]
        target, matte = dataset.target(index)
        camera, image = _working(dataset.camera(index), torch.cat([target, matte[..., None]], dim=-1))
        for _ in range(ROUNDS):
            pivot = _pivot(avatar, motion)
            with torch.no_grad():
                twist = _fit(poser(motion), pivot, camera, image, renderer)
            motion = _moved(avatar, motion, twist, pivot)
        joints[index], translation[index] = motion.joints, motion.translation
        progress.update(done, len(frames))
    return replace(sequence, motion=replace(sequence.motion, joints=joints, translation=translation))


def _fit(
    splats: Splats, pivot: Float[Tensor, " 3"], camera: Camera, image: Float[Tensor, "h w 4"], renderer: Renderer
) -> Float[Tensor, " 6"]:
    """Rotation vector and translation that bring the splats onto the image (colour and matte)."""
    weight = 1 / (_NOISE**2 * image.shape[0] ** 1.0)

    def residual(twist: Tensor) -> Tensor:
        shown = renderer.render(carried(splats, twist, pivot), camera)
        return (torch.cat([shown.color, shown.alpha[..., None]], dim=-1) - image).flatten()

    def energy(error: Tensor, twist: Tensor) -> float:
        return float(weight * error.square().sum() + (twist / _PRIOR).square().sum())

    twist = torch.zeros(6)
    error = residual(twist)
    best = energy(error, twist)
    for _ in range(ITERATIONS):
        slopes = [(residual(twist + row) - error) / row.sum() for row in torch.diag(_STEP)]
        jacobian = torch.stack(slopes)
        normal = weight * jacobian @ jacobian.T + torch.diag(_PRIOR**-2)
        change = torch.linalg.solve(normal, -(weight * jacobian @ error + twist / _PRIOR**2))
        for _ in range(_TRIALS):
            tried = residual(twist + change)
            value = energy(tried, twist + change)
            if value < best:
                twist, error, best = twist + change, tried, value
                break
            change = change * _SHRINK
        else:
            break
    return twist


def carried(splats: Splats, twist: Float[Tensor, " 6"], pivot: Float[Tensor, " 3"]) -> Splats:
    """Splats moved rigidly: turned about the pivot by a rotation vector, then shifted."""
    rotation = axis_angle_to_matrix(twist[:3])
    turn = matrix_to_quat(rotation).expand_as(splats.quats)
    frames = None if splats.sh_frames is None else rotation @ splats.sh_frames
    means = (splats.means - pivot) @ rotation.T + pivot + twist[3:]
    return replace(splats, means=means, quats=quat_multiply(turn, splats.quats), sh_frames=frames)


def _moved(
    avatar: Avatar, motion: HeadMotion, twist: Float[Tensor, " 6"], pivot: Float[Tensor, " 3"]
) -> HeadMotion:
    """Head motion whose posed avatar is the given one's carried by the twist."""
    rotation = axis_angle_to_matrix(twist[:3])
    root = avatar.rest_joints[0] + avatar.joint_expression_basis[0] @ motion.expression
    joints = motion.joints.clone()
    joints[0] = matrix_to_axis_angle(rotation @ axis_angle_to_matrix(motion.joints[0]))
    # The root turns about its own rest position and is then shifted: solve for the shift that carries the whole.
    at = root + motion.translation
    return replace(motion, joints=joints, translation=(at - pivot) @ rotation.T + pivot + twist[3:] - root)


def _pivot(avatar: Avatar, motion: HeadMotion) -> Float[Tensor, " 3"]:
    """Middle of the face: turning about it hardly moves what the landmarks have fixed already."""
    eyes = avatar.transforms(motion)[3:, :3]
    rest = avatar.rest_joints[3:]
    return (torch.einsum("jab,jb->ja", eyes[:, :, :3], rest) + eyes[:, :, 3]).mean(0)


def _working(camera: Camera, image: Float[Tensor, "h w 4"]) -> tuple[Camera, Float[Tensor, "h w 4"]]:
    """Camera and image reduced by whole factors to the working size."""
    factor = max(1, image.shape[0] // WORK_SIZE)
    if factor == 1:
        return camera, image
    size = image.shape[0] // factor
    small = torch.nn.functional.avg_pool2d(image.movedim(-1, 0)[None], factor)[0].movedim(0, -1)
    scale = torch.diag(torch.tensor([1 / factor, 1 / factor, 1.0]))
    return replace(camera, K=scale @ camera.K, width=size, height=size), small.contiguous()
