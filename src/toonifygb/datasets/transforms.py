"""``transforms*.json``: cameras as NeRF's descendants write them, in one of two conventions."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from toonifygb.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from jaxtyping import Float

SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")


def read_transforms(path: Path) -> dict[str, Any]:
    """The JSON of one file, with a list of frames.

    Raises:
        InputError: it is damaged or something else.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({str(error)[:100]})", "make the dataset again") from error
    frames = table.get("frames") if isinstance(table, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{path} has no list of frames; expected cameras of a dataset")
    return table


def intrinsics(table: dict[str, Any], frame: dict[str, Any], path: Path) -> Float[np.ndarray, "3 3"]:
    """K of one frame, px; what the frame does not say, the whole file does.

    Raises:
        InputError: no focal length, or one that is no number.
    """
    both = {**table, **frame}
    try:
        width, height = float(both["w"]), float(both["h"])
        focal_x = float(both["fl_x"]) if "fl_x" in both else width / 2 / np.tan(float(both["camera_angle_x"]) / 2)
        focal_y = float(both.get("fl_y", focal_x))
        centre = float(both.get("cx", width / 2)), float(both.get("cy", height / 2))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} lacks the camera's {error}", "make the dataset again") from error
    return np.array([[focal_x, 0, centre[0]], [0, focal_y, centre[1]], [0, 0, 1]])


def camera_to_world(frame: dict[str, Any], path: Path) -> Float[np.ndarray, "4 4"]:
    """The frame's matrix.

    Raises:
        InputError: it is no rigid 4x4 matrix.
    """
    try:
        matrix = np.asarray(frame["transform_matrix"], np.float64)
        turn = matrix[:3, :3]
        rigid = matrix.shape == (4, 4) and np.abs(turn @ turn.T - np.eye(3)).max() < 1e-2
        if not rigid or np.linalg.det(turn) < 0:
            raise ValueError("not rigid")
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(
            f"{path} holds a frame without a camera pose ({error})", "make the dataset again"
        ) from error
    return matrix


def world_to_opencv(matrix: Float[np.ndarray, "4 4"], *, opengl: bool) -> Float[np.ndarray, "4 4"]:
    """World to OpenCV's camera.

    Args:
        matrix: camera to world.
        opengl: its camera looks along -z with y up, as Blender's and VHAP's; INSTA's is OpenCV's own.
    """
    axes = np.diag([1.0, -1.0, -1.0, 1.0]) if opengl else np.eye(4)
    return np.linalg.inv(matrix @ axes)
