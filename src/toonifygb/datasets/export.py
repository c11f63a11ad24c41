"""A track and its head crops in the layout of INSTA and 3D Gaussian Blendshapes.

    images/%05d.png         RGBA, straight alpha
    checkpoint/%05d.frame   the track, one file per frame, ids from 0
    canonical.obj           the subject with the jaw a little open
    transforms*.json, flame/exp/%05d.txt, meshes/%05d.obj    what INSTA reads besides

Both projects let the head stand and the camera move, with one focal length and one principal point. Crops that
follow the head are therefore put back to where they were in the frame, on one canvas that holds them all.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from toonifygb import video
from toonifygb.atomic import replacing
from toonifygb.datasets.frame_files import write_frame
from toonifygb.datasets.worlds import head_to_camera, to_pytorch3d
from toonifygb.errors import InputError
from toonifygb.geometry.cameras import crop_camera
from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.head import JAW, NECK
from toonifygb.progress import SILENT
from toonifygb.structures import HeadMotion

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jaxtyping import Float, Int, UInt8
    from torch import Tensor

    from toonifygb.head import HeadModel
    from toonifygb.progress import Progress
    from toonifygb.structures import Camera, TrackedSequence

JAW_OPEN = np.deg2rad(12)
"""Of the canonical mesh, rad."""
N_SHAPE, N_EXPRESSION, N_TEXTURE = 300, 100, 140
VALIDATION = 20
"""Frames of INSTA's validation set, the last ones."""
STIFF_NECK = 0.02
"""Turn of the neck that the layout cannot hold and that is worth a sentence, rad."""


@dataclass(frozen=True)
class Exported:
    """What was written."""

    n_frames: int
    n_test: int
    width: int
    height: int
    problems: tuple[str, ...]


@dataclass(frozen=True)
class Crops:
    """Square head crops of a clip with their mattes."""

    boxes: Int[np.ndarray, "t 4"]
    """left, top, right, bottom of each crop in px of the full frame, all of one size."""
    size: int
    """Side of a crop, px."""
    picture: Callable[[int], tuple[UInt8[np.ndarray, "s s 3"], UInt8[np.ndarray, "s s"]]]
    """Colour and matte of a frame."""


def export_dataset(
    sequence: TrackedSequence,
    head: HeadModel,
    crops: Crops,
    out: Path,
    *,
    n_test: int,
    meshes: bool = True,
    progress: Progress = SILENT,
) -> Exported:
    """Writes the dataset into a new or empty folder.

    Args:
        sequence: the track, its head model FLAME.
        head: that model.
        crops: pictures of every frame.
        out: created when absent.
        n_test: frames at the end that are held out.
        meshes: write what INSTA reads besides 3DGB's files: a mesh per frame, expressions and cameras as text.
        progress: told after every frame.

    Raises:
        InputError: the track is of another kind of head, or the folder holds other things.
    """
    if head.n_shape != N_SHAPE or head.n_expression != N_EXPRESSION:
        raise InputError(
            f"the track uses the head model {head.name} with {head.n_shape} shape and {head.n_expression} "
            f"expression coefficients; this layout holds FLAME's {N_SHAPE} and {N_EXPRESSION}",
            "track with FLAME: toonifygb create CLIP --head flame",
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"output {out} exists and is not empty", "pass a new folder with --out")
    canvas = _Canvas(crops)
    camera = canvas.camera(sequence.camera)
    rotation, translation = head_to_camera(
        head.to(torch.float64),
        sequence.shape.double(),
        sequence.motion.to(torch.float64),
        sequence.camera.world_to_camera.double(),
    )
    writer = _Writer(sequence, head, camera, rotation, translation, out)
    for index in range(sequence.n_frames):
        video.save_png(writer.folder("images") / f"{index:05d}.png", canvas.picture(index))
        write_frame(writer.folder("checkpoint") / f"{index:05d}.frame", writer.frame(index))
        if meshes:
            writer.write_mesh(index)
        progress.update(index + 1, sequence.n_frames)
    writer.write_canonical()
    if meshes:
        writer.write_transforms(n_test)
    return Exported(sequence.n_frames, n_test, camera.width, camera.height, tuple(_losses(sequence, canvas)))


def _losses(sequence: TrackedSequence, canvas: _Canvas) -> list[str]:
    """What the layout cannot say."""
    sentences = []
    neck = float(sequence.motion.joints[:, NECK].norm(dim=-1).amax())
    if neck > STIFF_NECK:
        sentences.append(
            f"the neck turns by up to {np.rad2deg(neck):.0f} degrees; this layout holds it stiff, so its skin is "
            "placed as if it turned with the head"
        )
    lost = int((~sequence.tracked).sum())
    if lost:
        sentences.append(f"{lost} frames without a face are written with the motion between their neighbours")
    if canvas.moves:
        sentences.append(f"crops that follow the head were put on one canvas of {canvas.size} px")
    return sentences


class _Canvas:
    """One square that holds the crops of all frames where they were in the full frame."""

    def __init__(self, crops: Crops) -> None:
        self._crops = crops
        self._scale = crops.size / int(crops.boxes[0, 2] - crops.boxes[0, 0])
        low, high = crops.boxes[:, :2].min(0), crops.boxes[:, 2:].max(0)
        side = int((high - low).max())
        self._corner = low
        self.moves = side != int(crops.boxes[0, 2] - crops.boxes[0, 0])
        self.size = int(np.ceil(side * self._scale))

    def camera(self, full: Camera) -> Camera:
        """Camera of the canvas."""
        left, top = self._corner
        side = self.size / self._scale
        return crop_camera(full, (left, top, left + side, top + side), self.size)

    def picture(self, index: int) -> UInt8[np.ndarray, "n n 4"]:
        """A frame's crop on the canvas, transparent around it."""
        color, matte = self._crops.picture(index)
        layers = np.concatenate([color, matte[..., None]], -1)
        if not self.moves:
            return layers
        place = (self._crops.boxes[index, :2] - self._corner) * self._scale
        x, y = (int(v) for v in np.floor(place))
        canvas = np.zeros((self.size + 1, self.size + 1, 4), np.float32)
        # Between whole pixels the crop is spread over its neighbours; colours are weighed by their opacity.
        weighed = layers.astype(np.float32)
        weighed[..., :3] *= weighed[..., 3:] / 255
        n = len(color)
        for step_y, share_y in ((0, 1 - (place[1] - y)), (1, place[1] - y)):
            for step_x, share_x in ((0, 1 - (place[0] - x)), (1, place[0] - x)):
                canvas[y + step_y : y + step_y + n, x + step_x : x + step_x + n] += share_y * share_x * weighed
        canvas = canvas[: self.size, : self.size]
        canvas[..., :3] *= 255 / np.maximum(canvas[..., 3:], 1e-6)
        return np.rint(canvas.clip(0, 255)).astype(np.uint8)


@dataclass(frozen=True)
class _Writer:
    """The track's files."""

    sequence: TrackedSequence
    head: HeadModel
    camera: Camera
    rotation: Float[Tensor, "t 3 3"]
    translation: Float[Tensor, "t 3"]
    out: Path

    def folder(self, name: str) -> Path:
        """A folder of the dataset, made when needed."""
        path = self.out / name
        path.mkdir(parents=True, exist_ok=True)
        return path

    def frame(self, index: int) -> dict[str, Any]:
        """One frame as metrical-tracker writes it."""
        motion = self.sequence.motion[index]
        turns = axis_angle_to_matrix(motion.joints)[:, :2].flatten(1)  # 6D: the first two rows
        rotation, translation = to_pytorch3d(self.rotation[index], self.translation[index])
        half = min(self.camera.width, self.camera.height) / 2
        K = self.camera.K
        middle = torch.tensor([self.camera.width / 2, self.camera.height / 2])
        tensors = {
            "flame": {
                "exp": motion.expression,
                "shape": self.sequence.shape,
                "tex": torch.zeros(N_TEXTURE),
                "jaw": turns[JAW],
                "eyes": turns[JAW + 1 :].flatten(),
                "eyelids": motion.eyelids,
            },
            "camera": {
                "R": rotation[:2].flatten(),
                "t": translation,
                "fl": K[0, :1] / half,
                "pp": (middle - K[:2, 2]) / half,
            },
            "opencv": {"R": self.rotation[index], "t": self.translation[index], "K": K},
        }
        values: dict[str, Any] = {
            group: {name: tensor[None].float().numpy() for name, tensor in parts.items()}
            for group, parts in tensors.items()
        }
        values["flame"]["sh"] = np.zeros((1, 9, 3), np.float32)
        values["img_size"] = np.array([self.camera.height, self.camera.width], np.int64)
        return values | {"frame_id": f"{index:05d}", "global_step": 0}

    def _posed(self, motion: HeadMotion) -> Float[Tensor, "v 3"]:
        """Vertices of a head that stands still, in the model's own axes, m."""
        joints = motion.joints.clone()
        joints[..., : NECK + 1, :] = 0
        still = replace(motion, joints=joints, translation=torch.zeros_like(motion.translation))
        return self.head.forward(self.sequence.shape, still)[0]

    def write_mesh(self, index: int) -> None:
        """A frame's mesh and expression."""
        motion = self.sequence.motion[index]
        _write_obj(self.folder("meshes") / f"{index:05d}.obj", self._posed(motion), self.head.faces)
        text = "".join(f"{value:.8f}\n" for value in motion.expression.tolist())
        (self.folder("flame/exp") / f"{index:05d}.txt").write_text(text, encoding="utf-8")

    def write_canonical(self) -> None:
        """The subject without expression, the jaw a little open."""
        rest = self.sequence.motion[0].map(torch.zeros_like)
        rest.joints[JAW, 0] = float(JAW_OPEN)
        _write_obj(self.out / "canonical.obj", self._posed(rest), self.head.faces)

    def write_transforms(self, n_test: int) -> None:
        """Cameras for INSTA: camera to world with OpenCV's axes."""
        K, width, height = self.camera.K.double(), self.camera.width, self.camera.height
        angles = [
            2 * float(torch.atan(size / (2 * focal))) for size, focal in ((width, K[0, 0]), (height, K[1, 1]))
        ]
        common = {
            "w": width,
            "h": height,
            "cx": float(K[0, 2]),
            "cy": float(K[1, 2]),
            "fl_x": float(K[0, 0]),
            "fl_y": float(K[1, 1]),
            "camera_angle_x": angles[0],
            "camera_angle_y": angles[1],
            "x_fov": float(np.rad2deg(angles[0])),
            "y_fov": float(np.rad2deg(angles[1])),
            "integer_depth_scale": 0.001,
        }
        pose = torch.eye(4, dtype=torch.float64).repeat(len(self.rotation), 1, 1)
        pose[:, :3, :3], pose[:, :3, 3] = self.rotation, self.translation
        frames = [
            {
                "file_path": f"images/{index:05d}.png",
                "mesh_path": f"meshes/{index:05d}.obj",
                "exp_path": f"flame/exp/{index:05d}.txt",
                "transform_matrix": matrix.tolist(),
            }
            for index, matrix in enumerate(torch.linalg.inv(pose))
        ]
        first = len(frames) - n_test
        parts = {"": frames, "_train": frames[:first], "_test": frames[first:], "_val": frames[-VALIDATION:]}
        for ending, part in parts.items():
            with replacing(self.out / f"transforms{ending}.json") as temporary:
                temporary.write_text(json.dumps({**common, "frames": part}, indent=1) + "\n", encoding="utf-8")


def _write_obj(path: Path, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> None:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
