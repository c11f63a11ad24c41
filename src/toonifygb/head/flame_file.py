"""FLAME as its users have it: from the authors' pickle to safetensors, and from there to a head model.

FLAME may be used by those who registered with its authors; the package holds nothing of it. What the authors' file
lacks (landmarks, regions, lids) is taken from the open head while the file is converted.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from toonifygb.assets.convert import StoredTensor, read_pickle
from toonifygb.assets.store import model_path
from toonifygb.atomic import replacing
from toonifygb.errors import AssetError
from toonifygb.head.base import PARENTS, HeadModel
from toonifygb.head.embedding import eyeballs, furnish
from toonifygb.head.flame import from_arrays
from toonifygb.head.open_head import load_open_head
from toonifygb.progress import SILENT

if TYPE_CHECKING:
    from pathlib import Path

    from jaxtyping import Float

    from toonifygb.progress import Progress

FORMAT, VERSION = "toonifygb-flame", "1"
N_VERTICES, N_FACES, N_SHAPE, N_EXPRESSION = 5023, 9976, 300, 100
N_BLENDSHAPES = 50
"""Expression coefficients that get blendshapes of Gaussians, the first ones, as in 3DGB; tracks have all."""
_AXES: dict[str, tuple[int, ...]] = {
    "v_template": (N_VERTICES, 3),
    "f": (N_FACES, 3),
    "shapedirs": (N_VERTICES, 3, N_SHAPE + N_EXPRESSION),
    "posedirs": (N_VERTICES, 3, 36),
    "J_regressor": (5, N_VERTICES),
    "weights": (N_VERTICES, 5),
    "kintree_table": (2, 5),
}
"""Arrays of FLAME 2020 and 2023 and their sizes."""
_HEIGHT = (0.15, 0.6)
"""A head in metres is as tall as this."""
_ROWS = 0.01
"""By how much rows that sum to 1 may be off."""
_KEPT = (
    "template",
    "faces",
    "shape_basis",
    "expression_basis",
    "pose_basis",
    "skin_weights",
    "eyelid_basis",
    "part",
    "landmark_faces",
    "landmark_bary",
    "landmark_offset",
    "landmark_sigma",
    "landmark_mirror",
)
_AUTHORS = "use generic_model.pkl of FLAME 2020 or flame2023.pkl as the authors publish them"


def load_flame(name: str) -> HeadModel:
    """FLAME as the user added it.

    Args:
        name: of the asset: ``flame`` (2020) or ``flame2023``.

    Raises:
        AssetError: it has not been added, or the file is damaged.
    """
    return decode(model_path(name))


def convert_flame(source: Path, target: Path, name: str, *, progress: Progress = SILENT) -> None:
    """Writes the head model of the authors' pickle ``source`` to the safetensors file ``target``.

    Raises:
        AssetError: ``source`` is damaged, holds code, or is not FLAME.
    """
    arrays = read_flame(source)
    rig = make_rig(arrays, name)
    furnished, registration = furnish(rig, load_open_head(), progress=progress)
    tensors = {key: getattr(furnished, key).contiguous() for key in _KEPT}
    tensors["joint_regressor"] = torch.from_numpy(arrays["J_regressor"])
    tensors |= {f"region.{key}": mask.contiguous() for key, mask in furnished.regions.items()}
    facts = {"name": name, "surface_mm": round(1e3 * float(registration.distance.mean()), 3)}
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as temporary:
        metadata = {"flame": json.dumps({"format": FORMAT, "version": VERSION, **facts}, sort_keys=True)}
        save_file(tensors, temporary, metadata=metadata)


def read_flame(path: Path) -> dict[str, np.ndarray]:
    """FLAME's arrays, float32 and int64, of the sizes they must have.

    Raises:
        AssetError: the file is damaged, holds code, or is not FLAME.
    """
    values = read_pickle(path).values
    missing = [key for key in _AXES if key not in values]
    if missing:
        raise AssetError(f"{path} lacks {', '.join(missing)}; expected a FLAME model", _AUTHORS)
    arrays = {}
    for key, shape in _AXES.items():
        array = _array(values[key], f"{path}: {key}")
        if array.shape != shape:
            raise AssetError(
                f"{path}: {key} has shape {list(array.shape)}, FLAME's has {list(shape)}",
                _AUTHORS,
            )
        if not np.isfinite(array).all():
            raise AssetError(f"{path}: {key} holds numbers that are not finite", "download it again")
        arrays[key] = array
    _check(arrays, path)
    return arrays


def _array(value: Any, name: str) -> np.ndarray:
    """The numbers of an array, plain, wrapped by chumpy, or sparse."""
    if isinstance(value, StoredTensor):
        return value.array()
    kind = value.get("class", "") if isinstance(value, dict) else ""
    parts = value if isinstance(value, dict) else {}
    try:
        if kind == "Ch":
            return _array(parts["x"], name)
        if kind == "Select":
            chosen = _array(parts["a"], name).ravel()[_array(parts["idxs"], name)]
            return chosen.reshape(parts["preferred_shape"]) if "preferred_shape" in parts else chosen
        if kind == "Reshape":
            return _array(parts["a"], name).reshape(parts["newshape"])
        if kind[:3] in ("csc", "csr", "coo"):
            return _dense(parts, kind[:3], name)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise AssetError(f"{name} is damaged ({error})", "download it again") from error
    raise AssetError(f"{name} is no array of numbers; expected a FLAME model", _AUTHORS)


def _dense(parts: dict[str, Any], kind: str, name: str) -> Float[np.ndarray, "r c"]:
    """A sparse matrix of scipy; entries at the same place add up."""
    shape = parts["_shape"]
    if list(shape) not in ([5, N_VERTICES], [N_VERTICES, 5]):
        raise AssetError(f"{name} has shape {list(shape)}, FLAME's has {[5, N_VERTICES]}", _AUTHORS)
    data = _array(parts["data"], name)
    if kind == "coo":
        rows, columns = _array(parts["row"], name), _array(parts["col"], name)
    else:
        counts = np.diff(_array(parts["indptr"], name))
        lines, others = np.repeat(np.arange(len(counts)), counts), _array(parts["indices"], name)
        rows, columns = (others, lines) if kind == "csc" else (lines, others)
    matrix = np.zeros(shape, np.float32)
    np.add.at(matrix, (rows, columns), data)
    return matrix


def _check(arrays: dict[str, np.ndarray], path: Path) -> None:
    """Refuses arrays of FLAME's sizes that are no rig of a head."""
    faces = arrays["f"]
    if faces.min() < 0 or faces.max() >= N_VERTICES:
        raise AssetError(f"{path}: f names vertices that do not exist", "download it again")
    parents = tuple(int(parent) for parent in arrays["kintree_table"][0, 1:])
    if parents != PARENTS[1:]:
        raise AssetError(f"{path}: its joints hang on {parents}, FLAME's on {PARENTS[1:]}", _AUTHORS)
    height = float(np.ptp(arrays["v_template"][:, 1]))
    if not _HEIGHT[0] < height < _HEIGHT[1]:
        raise AssetError(f"{path}: the head is {height:.3g} tall; expected metres, {_HEIGHT[0]} to {_HEIGHT[1]}")
    for key in ("weights", "J_regressor"):
        if np.abs(arrays[key].sum(1) - 1).max() > _ROWS:
            raise AssetError(f"{path}: rows of {key} do not sum to 1", "download it again")


def make_rig(arrays: dict[str, np.ndarray], name: str) -> HeadModel:
    """The bare head model: no landmarks, no regions, no lids."""
    given = {key: torch.from_numpy(np.ascontiguousarray(array)) for key, array in arrays.items()}
    weights = given["weights"] / given["weights"].sum(-1, keepdim=True)
    rig = from_arrays(
        given["v_template"],
        given["f"],
        given["shapedirs"][..., :N_SHAPE].contiguous(),
        given["shapedirs"][..., N_SHAPE:].contiguous(),
        given["posedirs"].movedim(-1, 0).contiguous(),
        given["J_regressor"],
        weights,
        name=name,
        part=eyeballs(weights),
    )
    return replace(rig, n_blendshapes=N_BLENDSHAPES)


def decode(path: Path) -> HeadModel:
    """Head model from the file that ``convert_flame`` wrote.

    Raises:
        AssetError: the file is damaged or of another version.
    """
    again = "add FLAME again: toonifygb assets add flame generic_model.pkl"
    try:
        with safe_open(path, framework="pt") as file:
            facts = json.loads((file.metadata() or {})["flame"])
            given = {key: file.get_tensor(key) for key in file.keys()}
        if (facts["format"], facts["version"]) != (FORMAT, VERSION):
            raise AssetError(f"{path} has the version {facts['version']}, expected {VERSION}", again)
        rig = from_arrays(
            given["template"],
            given["faces"],
            given["shape_basis"],
            given["expression_basis"],
            given["pose_basis"],
            given["joint_regressor"],
            given["skin_weights"],
            name=facts["name"],
            eyelid_basis=given["eyelid_basis"],
            part=given["part"],
            regions={key.removeprefix("region."): given[key] for key in given if key.startswith("region.")},
        )
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise AssetError(f"{path} is damaged ({error})", again) from error
    marks = {key: given[key] for key in _KEPT if key.startswith("landmark_")}
    return replace(rig, n_blendshapes=N_BLENDSHAPES, **marks)
