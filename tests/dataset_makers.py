"""Tiny valid datasets in the layout of each project, and where they put every vertex by their own conventions."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from make import tiny_head

from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.head import HeadModel
from toonifygb.structures import HeadMotion

N_FRAMES, WIDTH, HEIGHT = 8, 96, 80
FOCAL, CENTRE = 190.0, (50.5, 38.25)
K = np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]])


def tiny_flame() -> HeadModel:
    """The tiny head with as many coefficients as FLAME, whose joints follow them."""
    random = torch.Generator().manual_seed(11)
    known = tiny_head()
    expression = 2e-5 * torch.randn(known.n_vertices, 3, 100, generator=random)
    expression[..., :4] = 0.4 * known.expression_basis
    return replace(
        known,
        name="flame",
        shape_basis=1e-4 * torch.randn(known.n_vertices, 3, 300, generator=random),
        expression_basis=expression,
        expression_names=tuple(f"expression_{index:03d}" for index in range(100)),
        expression_sigma=torch.ones(100),
        expression_lower=-3 * torch.ones(100),
        expression_upper=3 * torch.ones(100),
        joint_shape_basis=1e-4 * torch.randn(5, 3, 300, generator=random),
        joint_expression_basis=1e-4 * torch.randn(5, 3, 100, generator=random),
        n_blendshapes=5,
    )


@dataclass(frozen=True)
class Truth:
    """What a dataset says: coefficients, and the pixels of all vertices by that project's own formulas."""

    shape: torch.Tensor
    motion: HeadMotion
    """In the dataset's own world."""
    pixels: np.ndarray
    folder: Path


def movements(n: int = N_FRAMES) -> tuple[torch.Tensor, HeadMotion]:
    """A person and a head that stands still and talks."""
    random = torch.Generator().manual_seed(5)
    time = torch.linspace(0, 3, n)
    joints = torch.zeros(n, 5, 3)
    joints[:, 2, 0] = 0.1 + 0.1 * time.sin()
    joints[:, 3:, 1] = 0.15 * time.cos()[:, None]
    joints[:, 4, 0] = 0.05 * time.sin()
    motion = HeadMotion(
        torch.randn(n, 100, generator=random),
        joints,
        torch.zeros(n, 3),
        torch.stack([0.5 + 0.5 * time.sin(), 0.3 * torch.ones(n)], -1),
    )
    return torch.randn(300, generator=random), motion


def cameras(n: int = N_FRAMES) -> tuple[np.ndarray, np.ndarray]:
    """x ↦ R x + t of OpenCV cameras that wander around a head."""
    time = torch.linspace(0, 3, n, dtype=torch.float64)
    angles = torch.stack([0.1 * time.sin(), 0.25 * time.cos(), 0.05 * time], -1)
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)) @ axis_angle_to_matrix(angles)
    translation = torch.stack([0.01 * time.cos(), 0.02 * time.sin(), 0.55 + 0.02 * time], -1)
    return rotation.numpy(), translation.numpy()


def picture(pixels: np.ndarray, shade: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """RGBA: the outline of the vertices filled, softly edged."""
    hull = cv2.convexHull(np.rint(pixels * 16).astype(np.int32))
    matte = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(matte, hull, 255, cv2.LINE_AA, 4)
    rows, columns = np.mgrid[:height, :width]
    color = np.stack([columns * 2, rows * 2, np.full_like(rows, shade)], -1).astype(np.uint8)
    return np.dstack([color, matte])


def save(path: Path, image: np.ndarray) -> None:
    """RGB, RGBA or grey, by the suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    codes = {2: None, 3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    code = codes[image.ndim if image.ndim == 2 else image.shape[2]]
    cv2.imwrite(str(path), image if code is None else cv2.cvtColor(image, code))


def six(rotations: torch.Tensor) -> np.ndarray:
    """6D rotations: the first two rows of each matrix."""
    return axis_angle_to_matrix(rotations)[..., :2, :].flatten(-2).numpy()


def tracker_folder(folder: Path, pictures: str, opencv: bool = True, change: Callable | None = None) -> Truth:
    """metrical-tracker's checkpoints with RGBA pictures in a folder of the given name."""
    head = tiny_flame()
    shape, motion = movements()
    rotation, translation = cameras()
    vertices, _ = head.forward(shape, motion)
    truth = []
    for index in range(N_FRAMES):
        seen = vertices[index].double().numpy() @ rotation[index].T + translation[index]
        truth.append((seen @ K.T)[:, :2] / seen[:, 2:])
        frame = {
            "flame": {
                "exp": motion.expression[index : index + 1].numpy(),
                "shape": shape[None].numpy(),
                "tex": np.zeros((1, 140), np.float32),
                "sh": np.zeros((1, 9, 3), np.float32),
                "jaw": six(motion.joints[index, 2])[None],
                "eyes": six(motion.joints[index, 3:]).reshape(1, 12),
                "eyelids": motion.eyelids[index : index + 1].numpy(),
            },
            "camera": pytorch3d(rotation[index], translation[index]),
            "img_size": np.array([HEIGHT, WIDTH]),
            "frame_id": f"{index:05d}",
            "global_step": 7,
        }
        if opencv:
            parts = {"R": rotation[index], "t": translation[index], "K": K}
            frame["opencv"] = {name: value[None].astype(np.float32) for name, value in parts.items()}
        if change:
            change(index, frame)
        path = folder / "checkpoint" / f"{index:05d}.frame"
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(frame, path)
        save(folder / pictures / f"{index:05d}.png", picture(truth[-1], 20 * index))
    return Truth(shape, motion, np.stack(truth), folder)


def pytorch3d(rotation: np.ndarray, translation: np.ndarray) -> dict[str, np.ndarray]:
    """The camera as PyTorch3D has it, float32: x left, y up, rows, normalised by half the shorter side."""
    half = min(WIDTH, HEIGHT) / 2
    mirrored = rotation.T * np.array([-1.0, -1.0, 1.0])
    parts = {
        "R": mirrored[:2].reshape(1, 6),
        "t": (translation * [-1, -1, 1])[None],
        "fl": np.array([[FOCAL / half]]),
        "pp": ((np.array([WIDTH / 2, HEIGHT / 2]) - CENTRE) / half)[None],
    }
    return {name: value.astype(np.float32) for name, value in parts.items()}


def pytorch3d_pixels(vertices: np.ndarray, camera: dict[str, np.ndarray]) -> np.ndarray:
    """PyTorch3D's projection, literally: X_c = X R + T, NDC = f X/Z + p, screen = size/2 - NDC · half."""
    first, second = camera["R"].reshape(2, 3).astype(np.float64)
    R = np.stack([first, second, np.cross(first, second)])
    seen = vertices @ R + camera["t"][0]
    ndc = camera["fl"][0, 0] * seen[:, :2] / seen[:, 2:] + camera["pp"][0]
    return np.array([WIDTH / 2, HEIGHT / 2]) - ndc * min(WIDTH, HEIGHT) / 2


def insta_folder(folder: Path, n_test: int = 3) -> Truth:
    """INSTA's conversion of the tracker's output, as 3DGB reads it."""
    truth = tracker_folder(folder, "images")
    rotation, translation = cameras()
    frames = []
    for index in range(N_FRAMES):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation[index], translation[index]
        frames.append({"file_path": f"images/{index:05d}.png", "transform_matrix": np.linalg.inv(pose).tolist()})
    common = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": CENTRE[0], "cy": CENTRE[1]}
    splits = {"": frames, "_train": frames[:-n_test], "_test": frames[-n_test:], "_val": frames[-1:]}
    for ending, part in splits.items():
        (folder / f"transforms{ending}.json").write_text(json.dumps({**common, "frames": part}))
    return truth


def flashavatar_folder(folder: Path) -> Truth:
    """FlashAvatar's pictures, which count from 1, beside the tracker's checkpoints."""
    truth = tracker_folder(folder, "tracker_input")
    for index in range(N_FRAMES):
        image = picture(truth.pixels[index], 20 * index)
        save(folder / "imgs" / f"{index + 1:05d}.jpg", image[..., :3])
        save(folder / "alpha" / f"{index + 1:05d}.jpg", image[..., 3])
        without_left = image[..., 3] * (np.arange(WIDTH) > 40).astype(np.uint8)
        save(folder / "parsing" / f"{index + 1:05d}_neckhead.png", without_left)
    for path in (folder / "tracker_input").iterdir():
        path.unlink()
    (folder / "tracker_input").rmdir()
    return truth


def vhap_folder(folder: Path, each: bool = False, offset: float = 0.0) -> Truth:
    """VHAP's export: two cameras of which one has more frames, a moving head, OpenGL axes."""
    head = tiny_flame()
    shape, still = movements()
    time = torch.linspace(0, 2, N_FRAMES)
    joints = still.joints.clone()
    joints[:, 0] = torch.stack([0.2 * time.sin(), 0.3 * time.cos(), 0.1 * time], -1)
    joints[:, 1] = torch.stack([0.1 * time.cos(), 0.1 * time.sin(), 0 * time], -1)
    place = torch.stack([0.02 * time, 0.01 * time.sin(), 0.05 * time.cos()], -1)
    motion = replace(still, joints=joints, translation=place, eyelids=torch.zeros(N_FRAMES, 2))
    vertices, _ = head.forward(shape, motion)
    camera = np.eye(4)
    camera[:3, :3] = axis_angle_to_matrix(torch.tensor([0.05, -0.1, 0.02], dtype=torch.float64)).numpy()
    camera[:3, 3] = [-0.05, 0.02, 0.7]
    pixels, frames = [], []
    for index in range(N_FRAMES):
        seen = (np.append(vertices[index].numpy(), np.ones((head.n_vertices, 1)), 1) @ np.linalg.inv(camera).T)[
            :, :3
        ]
        across = CENTRE[0] + FOCAL * seen[:, 0] / -seen[:, 2]
        down = CENTRE[1] - FOCAL * seen[:, 1] / -seen[:, 2]
        pixels.append(np.stack([across, down], -1))
        image = picture(pixels[-1], 20 * index)
        save(folder / "images" / f"{index:05d}_00.png", image[..., :3])
        save(folder / "fg_masks" / f"{index:05d}_00.png", image[..., 3])
        frames.append(
            {
                "timestep_index": index,
                "camera_index": 3,
                "transform_matrix": camera.tolist(),
                "file_path": f"images/{index:05d}_00.png",
                "fg_mask_path": f"fg_masks/{index:05d}_00.png",
                "flame_param_path": f"flame_param/{index:05d}.npz" if each else "flame_param.npz",
                "camera_angle_x": 2 * math.atan(WIDTH / 2 / FOCAL),
            }
        )
    other = {**frames[0], "camera_index": 1, "transform_matrix": np.eye(4).tolist()}
    common = {"w": WIDTH, "h": HEIGHT, "cx": CENTRE[0], "cy": CENTRE[1]}
    table = {**common, "frames": [other, *frames[:-2]]}
    (folder / "transforms_train.json").write_text(json.dumps(table))
    (folder / "transforms_test.json").write_text(json.dumps({**common, "frames": frames[-2:]}))
    arrays = {
        "translation": place,
        "rotation": joints[:, 0],
        "neck_pose": joints[:, 1],
        "jaw_pose": joints[:, 2],
        "eyes_pose": joints[:, 3:].flatten(1),
        "expr": motion.expression,
    }
    fixed = {"shape": shape.numpy(), "static_offset": np.full((1, 5143, 3), offset, np.float32)}
    if each:
        (folder / "flame_param").mkdir()
        for index in range(N_FRAMES):
            rows = {name: array[index : index + 1].numpy() for name, array in arrays.items()}
            np.savez(folder / "flame_param" / f"{index:05d}.npz", **rows, **fixed)
    else:
        np.savez(folder / "flame_param.npz", **{name: array.numpy() for name, array in arrays.items()}, **fixed)
    return Truth(shape, motion, np.stack(pixels), folder)
