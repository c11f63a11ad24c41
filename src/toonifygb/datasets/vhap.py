"""VHAP's and GaussianAvatars' layout: ``transforms*.json`` with ``flame_param.npz``, or one such file per frame.

The head moves and the cameras stand; they have OpenGL axes. Poses are axis-angle, the head model is FLAME 2023.
"""

from __future__ import annotations

import zipfile
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from toonifygb.datasets import transforms
from toonifygb.datasets.folders import HELD_OUT, ForeignFolder, Picture, held_out
from toonifygb.datasets.worlds import before_camera, flip
from toonifygb.errors import InputError
from toonifygb.structures import Camera, HeadMotion

if TYPE_CHECKING:
    from pathlib import Path

    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.head import HeadModel

PARAMETERS = "flame_param.npz"
_WIDTHS = {"translation": 3, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "expr": 100}
"""What changes from frame to frame, and in how many numbers."""
_MOST_BYTES = 2**30
"""More than a long clip's parameters need."""
_SMALL_OFFSET = 1e-4


def find_vhap(path: Path) -> ForeignFolder | None:
    """The dataset in a folder, or ``None``; of several cameras the one with most frames."""
    files = [path / name for name in transforms.SPLITS if (path / name).is_file()]
    files = files or [path / "transforms.json"]
    if not files[0].is_file():
        return None
    whole = (path / PARAMETERS).is_file()
    rows = _rows(files)
    if not rows or not (whole or all("flame_param_path" in row for row in rows.values())):
        return None
    numbers = tuple(sorted(rows))
    own = tuple(path / str(rows[number].get("flame_param_path", PARAMETERS)) for number in numbers)
    return ForeignFolder(
        layout="vhap",
        path=path,
        ids=numbers,
        pictures=tuple(_picture(path, rows[number]) for number in numbers),
        parameters=(path / PARAMETERS,) if whole else own,
        n_test=held_out(HELD_OUT, len(numbers)),
        head="flame2023",
    )


def _rows(files: list[Path]) -> dict[int, dict[str, Any]]:
    """One camera's frames by their time step, each with what its file says of all."""
    found: list[dict[str, Any]] = []
    for path in files:
        table = transforms.read_transforms(path)
        common = {key: value for key, value in table.items() if key != "frames"}
        for order, frame in enumerate(table["frames"]):
            found.append({"timestep_index": order, "camera_index": 0, **common, **frame, "table": path})
    try:
        cameras = Counter(int(row["camera_index"]) for row in found)
        chosen = min(cameras, key=lambda camera: (-cameras[camera], camera), default=0)
        return {int(row["timestep_index"]): row for row in found if int(row["camera_index"]) == chosen}
    except (TypeError, ValueError) as error:
        raise InputError(f"{files[0]} numbers its frames by something else than numbers ({error})") from error


def _picture(path: Path, row: dict[str, Any]) -> Picture:
    image = path / str(row.get("file_path", ""))
    if not image.is_file():
        raise InputError(f"picture {image} of {path} does not exist", "copy the dataset's images as well")
    mask = path / str(row.get("fg_mask_path", ""))
    return Picture(image, masks=(mask,)) if "fg_mask_path" in row and mask.is_file() else Picture(image)


def read_vhap(folder: ForeignFolder, head: HeadModel) -> tuple[Float[Tensor, " s"], HeadMotion, Camera, list[str]]:
    """Shape, motion, camera and problems of the dataset."""
    files = [folder.path / name for name in transforms.SPLITS if (folder.path / name).is_file()]
    rows = _rows(files or [folder.path / "transforms.json"])
    arrays, constant = _parameters(folder)
    shape = torch.from_numpy(constant["shape"]).float()
    if shape.shape[0] != head.n_shape or arrays["expr"].shape[1] != head.n_expression:
        raise InputError(
            f"{folder.path} holds {shape.shape[0]} shape and {arrays['expr'].shape[1]} expression coefficients; "
            f"the head model {head.name} has {head.n_shape} and {head.n_expression}",
            "use the head model that it was tracked with",
        )
    given = {name: torch.from_numpy(array).double() for name, array in arrays.items()}
    joints = torch.cat([given[name] for name in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")], -1)
    motion = HeadMotion(
        given["expr"], joints.unflatten(-1, (5, 3)), given["translation"], torch.zeros(len(joints), 2).double()
    )
    poses, intrinsics = [], []
    for number in folder.ids:
        row = rows[number]
        matrix = transforms.camera_to_world(row, row["table"])
        poses.append(transforms.world_to_opencv(matrix, opengl=True))
        intrinsics.append(transforms.intrinsics({}, row, row["table"]))
    pose, K = torch.from_numpy(np.stack(poses)), torch.from_numpy(np.stack(intrinsics)).float()
    first = rows[folder.ids[0]]
    seen = before_camera(head.to(torch.float64), shape.double(), motion, pose[:, :3, :3], pose[:, :3, 3])
    camera = Camera(K[0], torch.block_diag(flip(K), torch.ones(1, 1)), int(first["w"]), int(first["h"]))
    problems = []
    offset = float(np.abs(constant.get("static_offset", np.zeros(1))).max())
    if offset > _SMALL_OFFSET:
        problems.append(
            f"{folder.path.name} moves single vertices by up to {1e3 * offset:.1f} mm (static_offset); "
            "this is left out"
        )
    if float((K - K[0]).abs().amax()) > 0.5:
        problems.append(f"the cameras of {folder.path.name} differ in focal length; that of the first is used")
    return shape, seen.to(torch.float32), camera, problems


def _parameters(folder: ForeignFolder) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What changes, one row per frame of the folder; and what does not."""
    tables = [read_arrays(path) for path in folder.parameters]
    together = len(tables) == 1 and folder.parameters[0].name == PARAMETERS
    arrays = {}
    for name, width in _WIDTHS.items():
        try:
            rows = [np.atleast_2d(table[name]) for table in tables]
            chosen = rows[0][list(folder.ids)] if together else np.concatenate(rows)
        except (KeyError, IndexError, ValueError) as error:
            raise InputError(f"{folder.parameters[0]} lacks {name} of some frame ({error})") from error
        if chosen.shape != (len(folder.ids), width) or not np.isfinite(chosen).all():
            raise InputError(
                f"{folder.parameters[0]}: {name} has shape {list(chosen.shape)}, expected "
                f"{[len(folder.ids), width]} finite numbers"
            )
        arrays[name] = chosen
    if "shape" not in tables[0]:
        raise InputError(f"{folder.parameters[0]} lacks shape; expected parameters of FLAME")
    return arrays, {name: tables[0][name].ravel() for name in ("shape", "static_offset") if name in tables[0]}


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file; pickled objects in it are not opened, and nothing larger than a clip needs.

    Raises:
        InputError: it is damaged, too large, or holds something other than numbers.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _MOST_BYTES:
            raise InputError(f"{path} unpacks to {size / 1e9:.1f} GB; the parameters of a clip need far less")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError, KeyError, MemoryError) as error:
        said = " ".join(str(error).split())[:120]
        raise InputError(f"{path} is damaged or holds more than arrays of numbers ({said})") from error
    odd = [name for name, array in arrays.items() if array.dtype.kind not in "fiub"]
    if odd:
        raise InputError(f"{path} holds {odd[0]}, which is no array of numbers")
    return arrays
