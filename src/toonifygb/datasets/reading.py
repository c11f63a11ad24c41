"""One importer for all layouts: recognise the folder, then read its track."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb import video
from toonifygb.datasets import transforms, vhap
from toonifygb.datasets.folders import (
    ForeignFolder,
    ForeignTrack,
    find_flashavatar,
    find_insta,
    find_tracker,
    held_out,
)
from toonifygb.datasets.frame_files import read_frame
from toonifygb.datasets.worlds import before_camera, flip, from_pytorch3d, pytorch3d_intrinsics
from toonifygb.errors import InputError
from toonifygb.geometry.cameras import project
from toonifygb.geometry.rotations import matrix_to_axis_angle, rotation_6d_to_matrix
from toonifygb.structures import Camera, HeadMotion, Landmarks, TrackedSequence

if TYPE_CHECKING:
    from pathlib import Path

    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.head import HeadModel

FPS = 25.0
"""Pace of the trackers' clips; none of the layouts says it."""
SAME_CAMERA_PX = 0.5
"""Cameras whose images of a head differ by less are the same."""


def recognize(path: Path) -> ForeignFolder | None:
    """The dataset in a folder, or ``None`` when it is none of the known layouts.

    Raises:
        InputError: it is one, but something of it is missing.
    """
    if not path.is_dir():
        return None
    for find in (vhap.find_vhap, find_insta, find_flashavatar, find_tracker):
        found = find(path)
        if found is not None:
            return _with_split(found) if found.layout == "insta" else found
    if any((path / name).is_file() for name in (*transforms.SPLITS, "transforms.json")):
        raise InputError(
            f"{path} has cameras but no tracked heads: neither checkpoint/*.frame nor flame_param.npz",
            f"keep the tracker's checkpoint folder, or track the pictures anew: toonifygb create {path / 'images'}",
        )
    return None


def _with_split(folder: ForeignFolder) -> ForeignFolder:
    """INSTA's folder with as many held-out frames as its own files name at its end."""
    path = folder.path / "transforms_test.json"
    if not path.is_file():
        return folder
    n_test = len(transforms.read_transforms(path)["frames"])
    return replace(folder, n_test=held_out(n_test, len(folder.ids)))


def read_track(
    folder: ForeignFolder, head: HeadModel, *, fps: float = FPS, source_sha256: str = "0" * 64
) -> ForeignTrack:
    """The dataset's track in our world; its landmarks are where the head model has them, none were detected.

    Args:
        folder: as recognised.
        head: the model whose coefficients the track holds.
        fps: pace of the clip.
        source_sha256: checksum of the dataset.

    Raises:
        InputError: a file is damaged or of another kind of head.
    """
    if folder.layout == "vhap":
        tracked = vhap.read_vhap(folder, head)
    else:
        tracked = _read_frames(folder, head)
    shape, motion, camera, problems = tracked
    points, _ = head.landmarks().forward(shape, motion)
    n_frames = len(folder.ids)
    sequence = TrackedSequence(
        head_model=head.name,
        shape=shape,
        motion=motion,
        camera=camera,
        landmarks=Landmarks(project(camera, points)[0], torch.ones(n_frames), camera.width, camera.height),
        tracked=torch.ones(n_frames, dtype=torch.bool),
        error_px=torch.full((n_frames,), torch.nan),
        fps=fps,
        source_sha256=source_sha256,
    )
    return ForeignTrack(sequence, tuple(problems))


def _read_frames(
    folder: ForeignFolder, head: HeadModel
) -> tuple[Float[Tensor, " s"], HeadMotion, Camera, list[str]]:
    """Shape, motion, camera and problems of a folder of metrical-tracker's frames."""
    frames = [read_frame(path) for path in folder.parameters]
    n_shape, n_expression = head.n_shape, head.n_expression
    shape = torch.from_numpy(frames[0]["flame.shape"]).float()[:n_shape]
    expression = _stack(frames, "flame.exp")[:, :n_expression]
    if shape.shape[0] < n_shape or expression.shape[1] < n_expression:
        raise InputError(
            f"{folder.path} holds {shape.shape[0]} shape and {expression.shape[1]} expression coefficients; "
            f"the head model {head.name} has {n_shape} and {n_expression}",
            "use the head model that it was tracked with",
        )
    joints = torch.zeros(len(frames), 5, 3)
    turns = torch.cat([_stack(frames, "flame.jaw"), _stack(frames, "flame.eyes")], -1).unflatten(-1, (3, 6))
    joints[:, 2:] = matrix_to_axis_angle(rotation_6d_to_matrix(turns))
    eyelids = [frame.get("flame.eyelids", np.zeros(2)) for frame in frames]
    still = HeadMotion(expression, joints, torch.zeros(len(frames), 3), torch.from_numpy(np.stack(eyelids)).float())
    height, width = (int(size) for size in frames[0]["img_size"])
    rotation, translation, K = _cameras(frames, width, height)
    problems = []
    _check_size(folder, width, height)
    camera = Camera(K[0].float(), torch.eye(4), width, height)
    motion = before_camera(
        head.to(torch.float64), shape.double(), still.to(torch.float64), rotation, translation
    ).to(torch.float32)
    camera = replace(camera, world_to_camera=torch.block_diag(flip(camera.K), torch.ones(1, 1)))
    if float((K - K[0]).abs().amax()) > SAME_CAMERA_PX:
        problems.append(
            f"the focal length of {folder.path.name} changes by up to {float((K - K[0]).abs().amax()):.1f} px "
            "from frame to frame; that of its first frame is used, as by 3DGB"
        )
    problems += _disagreement(folder, rotation, translation)
    return shape, motion, camera, problems


def _stack(frames: list[dict[str, np.ndarray]], name: str) -> Float[Tensor, "t n"]:
    return torch.from_numpy(np.stack([frame[name] for frame in frames])).float()


def _cameras(
    frames: list[dict[str, np.ndarray]], width: int, height: int
) -> tuple[Float[Tensor, "t 3 3"], Float[Tensor, "t 3"], Float[Tensor, "t 3 3"]]:
    """Head to OpenCV's camera, x ↦ R x + t, and K, in double precision."""
    if all("opencv.K" in frame for frame in frames):
        R, t, K = (_stack(frames, f"opencv.{name}").double() for name in ("R", "t", "K"))
        return R.view(-1, 3, 3), t, K.view(-1, 3, 3)
    R, t, focal, principal = (_stack(frames, f"camera.{name}").double() for name in ("R", "t", "fl", "pp"))
    rotation, translation = from_pytorch3d(rotation_6d_to_matrix(R), t)
    return rotation, translation, pytorch3d_intrinsics(focal[:, 0], principal, width, height)


def _check_size(folder: ForeignFolder, width: int, height: int) -> None:
    """Refuses pictures of another size than they were tracked in."""
    image = video.load_rgba(folder.pictures[0].image)
    if image.shape[:2] != (height, width):
        raise InputError(
            f"{folder.pictures[0].image} is {image.shape[1]}x{image.shape[0]} px but was tracked at "
            f"{width}x{height} px",
            "give the pictures that the tracker saw",
        )


def _disagreement(
    folder: ForeignFolder, rotation: Float[Tensor, "t 3 3"], translation: Float[Tensor, "t 3"]
) -> list[str]:
    """Says so where INSTA's own files place the camera elsewhere than the tracker's."""
    poses = {}
    for name in ("transforms.json", *transforms.SPLITS):
        path = folder.path / name
        for frame in transforms.read_transforms(path)["frames"] if path.is_file() else []:
            stem = str(frame.get("file_path", "")).rpartition("/")[2].partition(".")[0]
            if stem.isdecimal():
                matrix = transforms.camera_to_world(frame, path)
                poses[int(stem)] = transforms.world_to_opencv(matrix, opengl=False)
    worst = 0.0
    for row, number in enumerate(folder.ids):
        if number in poses:
            pose = torch.from_numpy(poses[number])
            turned = float((pose[:3, :3] - rotation[row]).abs().amax())
            worst = max(worst, turned, float((pose[:3, 3] - translation[row]).abs().amax()))
    if worst < 2e-3:
        return []
    return [
        f"transforms.json and checkpoint of {folder.path.name} place the camera up to {worst:.3f} m or rad apart; "
        "the checkpoint is used"
    ]
