"""The avatar's folder: ``avatar.safetensors`` (every tensor) and ``avatar.json`` (names, sizes, facts).

The pair is self-contained: rendering needs nothing else on disk. Tensor names are the dotted field names of
``Avatar`` (``neutral.means``, ``deltas.sh``, ``camera.K`` …). Two storages: ``full`` keeps every number in single
precision, with deltas only for the first Gaussians, up to the last one that moves; ``compact`` packs the deltas
(``packing.py``) and keeps colours as half floats. The JSON is written last and holds the digest of the tensors, so
a folder is either complete or refused.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from toonifygb.atomic import replacing
from toonifygb.avatar import packing
from toonifygb.avatar.bases import N_DRIVERS_SEEN, Mixer
from toonifygb.avatar.fields import cut_deltas, extended, last_changed
from toonifygb.avatar.model import Avatar, PoseDrivers
from toonifygb.errors import InputError
from toonifygb.structures import Camera, GaussianParams, HeadMotion, TensorRecord

if TYPE_CHECKING:
    from torch import Tensor

    from toonifygb.config import Storage

FORMAT = "toonifygb-avatar"
VERSION = 2
TENSORS = "avatar.safetensors"
FACTS = "avatar.json"
_RECORDS: dict[str, type[TensorRecord]] = {
    "neutral": GaussianParams,
    "deltas": GaussianParams,
    "drivers": PoseDrivers,
    "mixer": Mixer,
    "mouth_upper": GaussianParams,
    "mouth_lower": GaussianParams,
    "motion_lower": HeadMotion,
    "motion_upper": HeadMotion,
    "motion_mean": HeadMotion,
    "camera": Camera,
    "full_camera": Camera,
}
_PLAIN = ("skin_weights", "pose_basis", "rest_joints", "joint_expression_basis", "shape")
_PLAIN_MOUTH = ("mouth_upper_weights", "mouth_lower_weights")
_PACKED = "packed."
_HALF = ("neutral.sh", "mouth_upper.sh", "mouth_lower.sh", "pose_basis")
"""Tensors that compact storage keeps as half floats: colours to a thousandth, corrections to micrometres."""


def save(avatar: Avatar, folder: Path | str, *, storage: Storage = "full") -> None:
    """Writes the avatar; an older one in the folder is replaced only when the new one is complete.

    Args:
        avatar: what to write.
        folder: created when absent.
        storage: full is exact; compact takes about a tenth of the room and costs less than 0.1 dB.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tensors = _compact(avatar) if storage == "compact" else _tensors(_trimmed(avatar))
    with replacing(folder / FACTS) as note, replacing(folder / TENSORS) as temporary:  # the last one comes first
        save_file(_apart(tensors), temporary)
        facts = _facts(avatar) | {"tensors_sha256": _digest(temporary), "storage": storage}
        note.write_text(json.dumps(facts, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def load(folder: Path | str) -> Avatar:
    """Reads an avatar written by ``save``, in either storage; all its floats are single precision.

    Raises:
        InputError: the folder holds no avatar, a damaged one, or one of another version.
    """
    folder = Path(folder)
    facts = _read_facts(folder)
    path = folder / TENSORS
    if not path.is_file():
        raise InputError(f"{path} is missing", "copy the whole avatar folder")
    if _digest(path) != facts["tensors_sha256"]:
        raise InputError(f"{path} does not match {FACTS} beside it", "copy the avatar again or train it anew")
    try:
        tensors = load_file(path)
    except SafetensorError as error:
        raise InputError(f"{path} is damaged ({error})", "copy the avatar again or train it anew") from error
    return _assemble(tensors, facts, path)


def _compact(avatar: Avatar) -> dict[str, Tensor]:
    """All tensors with the deltas packed and what needs no more as half floats."""
    named = {name: tensor for name, tensor in _tensors(avatar).items() if not name.startswith("deltas.")}
    named |= {name: named[name].half() for name in _HALF}
    return named | {f"{_PACKED}{name}": tensor for name, tensor in packing.pack(avatar.deltas).items()}


def _trimmed(avatar: Avatar) -> Avatar:
    """The avatar with deltas cut after the last Gaussian that any of them changes (one is always kept)."""
    return replace(avatar, deltas=cut_deltas(avatar.deltas, 0, max(1, last_changed(avatar.deltas))))


def _tensors(avatar: Avatar) -> dict[str, Tensor]:
    named = {name: getattr(avatar, name) for name in (*_PLAIN, *_PLAIN_MOUTH)}
    for name in _RECORDS:
        record = getattr(avatar, name)
        for part in fields(record) if record is not None else ():
            value = getattr(record, part.name)
            if isinstance(value, torch.Tensor):
                named[f"{name}.{part.name}"] = value
    return named


def _apart(named: dict[str, Tensor]) -> dict[str, Tensor]:
    """Contiguous tensors of which no two share memory, as the file format demands."""
    seen: set[int] = set()
    apart = {}
    for name, tensor in named.items():
        whole = tensor.contiguous()
        place = whole.untyped_storage().data_ptr()
        apart[name] = whole.clone() if place in seen else whole
        seen.add(place)
    return apart


def _facts(avatar: Avatar) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "n_gaussians": avatar.neutral.n,
        "n_mouth": [avatar.mouth_upper.n, avatar.mouth_lower.n],
        "sh_degree": avatar.sh_degree,
        "blendshape_names": list(avatar.blendshape_names),
        "n_expressions": avatar.n_expressions,
        "n_eyelids": avatar.n_eyelids,
        "has_drivers": avatar.drivers is not None,
        "has_mixer": avatar.mixer is not None,
        "pose_features": list(avatar.pose_features),
        "parents": list(avatar.parents),
        "camera_size": [avatar.camera.width, avatar.camera.height],
        "full_camera_size": [avatar.full_camera.width, avatar.full_camera.height],
        "head_model": avatar.head_model,
        "meta": avatar.meta,
    }


def _read_facts(folder: Path) -> dict[str, Any]:
    path = folder / FACTS
    if not path.is_file():
        raise InputError(f"no avatar in {folder}: {FACTS} is missing", "give the folder that holds avatar.json")
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON ({error})", "copy the avatar again or train it anew") from error
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise InputError(f"{path} does not describe an avatar", "give the folder that training wrote")
    if facts.get("version") != VERSION:
        raise InputError(
            f"{path} has format version {facts.get('version')}; this program reads version {VERSION}",
            "update toonifygb or train the avatar anew",
        )
    return facts


def _assemble(tensors: dict[str, Tensor], facts: dict[str, Any], path: Path) -> Avatar:
    """The record from its parts, after checking that exactly the expected tensors are there and fit together."""
    packed = facts["storage"] == "compact"
    left_out = {"deltas"} if packed else set()
    left_out |= set() if facts["has_drivers"] else {"drivers"}
    left_out |= set() if facts.get("has_mixer") else {"mixer"}  # avatars from before there were any do not say
    records = {name: kind for name, kind in _RECORDS.items() if name not in left_out}
    with_rest = any(name.startswith(f"{_PACKED}{packing.REST}.") for name in tensors)
    wanted = {*_PLAIN, *_PLAIN_MOUTH, *(_PACKED + name for name in packing.names(with_rest) if packed)}
    for name, kind in records.items():
        wanted |= {f"{name}.{p.name}" for p in fields(kind) if p.name not in {"width", "height"}}
    if wanted != set(tensors):
        odd = sorted(wanted.symmetric_difference(tensors))
        raise InputError(f"{path} has missing or unknown tensors: {', '.join(odd[:5])}", "train the avatar anew")
    extra = {
        "camera": dict(zip(("width", "height"), facts["camera_size"], strict=True)),
        "full_camera": dict(zip(("width", "height"), facts["full_camera_size"], strict=True)),
    }
    deltas = _unpacked(tensors, facts["n_gaussians"], path) if packed else None
    tensors = {name: tensor.float() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}
    built: dict[str, Any] = {"drivers": None, "mixer": None}
    built |= {name: tensors[name] for name in (*_PLAIN, *_PLAIN_MOUTH)}
    for name, kind in records.items():
        parts = {p.name: tensors[f"{name}.{p.name}"] for p in fields(kind) if f"{name}.{p.name}" in tensors}
        built[name] = kind(**parts, **extra.get(name, {}))
    built["deltas"] = deltas or extended(built["deltas"], facts["n_gaussians"])
    avatar = Avatar(
        **built,
        blendshape_names=tuple(facts["blendshape_names"]),
        n_expressions=facts["n_expressions"],
        n_eyelids=facts["n_eyelids"],
        pose_features=tuple(facts["pose_features"]),
        parents=tuple(facts["parents"]),
        head_model=facts["head_model"],
        meta=facts["meta"],
    )
    _check_sizes(avatar, facts, path)
    return avatar


def _unpacked(tensors: dict[str, Tensor], n: int, path: Path) -> GaussianParams:
    packed = {name.removeprefix(_PACKED): tensor for name, tensor in tensors.items() if name.startswith(_PACKED)}
    try:
        return packing.unpack(packed, n)
    except (ValueError, RuntimeError, IndexError) as error:
        raise InputError(f"{path}: packed deltas do not fit together ({error})", "train the avatar anew") from error


def _check_sizes(avatar: Avatar, facts: dict[str, Any], path: Path) -> None:
    n, k = facts["n_gaussians"], (facts["sh_degree"] + 1) ** 2
    n_psi = len(avatar.blendshape_names)
    n_drivers = n_psi - avatar.n_expressions - avatar.n_eyelids
    expected = {
        "neutral.sh": (avatar.neutral.sh, (n, k, 3)),
        "deltas.sh": (avatar.deltas.sh, (avatar.n_bases + n_drivers, n, k, 3)),
        "skin_weights": (avatar.skin_weights, (n, len(avatar.parents))),
        "pose_basis": (avatar.pose_basis, (len(avatar.pose_features), n, 3)),
    }
    if avatar.mixer is not None:
        mixer, n_hidden = avatar.mixer, len(avatar.mixer.bias)
        n_inputs = n_psi - n_drivers + min(n_drivers, N_DRIVERS_SEEN)
        expected |= {
            "mixer.scale": (mixer.scale, (n_inputs,)),
            "mixer.linear": (mixer.linear, (mixer.n_bases, n_psi - n_drivers)),
            "mixer.hidden": (mixer.hidden, (n_hidden, n_inputs)),
            "mixer.out": (mixer.out, (mixer.n_bases, n_hidden)),
        }
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise InputError(
                f"{path}: {name} has shape {tuple(tensor.shape)}, expected {shape}", "train the avatar anew"
            )


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
