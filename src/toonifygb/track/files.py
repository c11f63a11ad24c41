"""Tracked sequences on disk: one safetensors file, tensors by dotted name, the rest as JSON in its header."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from toonifygb.atomic import replacing
from toonifygb.errors import InputError
from toonifygb.structures import Camera, HeadMotion, Landmarks, TrackedSequence

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = "toonifygb-track"
VERSION = 1

_AXES = {
    "shape": "s",
    "motion.expression": "te",
    "motion.joints": "t53",
    "motion.translation": "t3",
    "motion.eyelids": "t2",
    "camera.K": "33",
    "camera.world_to_camera": "44",
    "landmarks.points": "tl2",
    "landmarks.score": "t",
    "tracked": "t",
    "error_px": "t",
}
"""Every tensor of the file with its axes: digits are sizes, letters sizes that must agree."""
_FACTS: dict[str, type | tuple[type, ...]] = {
    "head_model": str,
    "fps": (int, float),
    "source_sha256": str,
    "width": int,
    "height": int,
    "landmarks_width": int,
    "landmarks_height": int,
}


def save(sequence: TrackedSequence, path: Path | str) -> None:
    """Writes the sequence; an older file stays whole until the new one is complete."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {name: _member(sequence, name).detach().cpu().contiguous() for name in _AXES}
    facts = {
        "format": FORMAT,
        "version": VERSION,
        "head_model": sequence.head_model,
        "fps": sequence.fps,
        "source_sha256": sequence.source_sha256,
        "width": sequence.camera.width,
        "height": sequence.camera.height,
        "landmarks_width": sequence.landmarks.width,
        "landmarks_height": sequence.landmarks.height,
    }
    with replacing(path) as temporary:
        save_file(tensors, temporary, metadata={"track": json.dumps(facts, sort_keys=True)})


def load(path: Path | str) -> TrackedSequence:
    """Reads a sequence written by ``save``.

    Raises:
        InputError: the file is absent, damaged, or something else.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist, a track file was expected", "run the tracking stage first")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        facts = json.loads(header["track"])
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise _unusable(path, "is damaged or no track file") from error
    _check(path, facts, tensors)
    return TrackedSequence(
        head_model=facts["head_model"],
        shape=tensors["shape"],
        motion=HeadMotion(
            expression=tensors["motion.expression"],
            joints=tensors["motion.joints"],
            translation=tensors["motion.translation"],
            eyelids=tensors["motion.eyelids"],
        ),
        camera=Camera(tensors["camera.K"], tensors["camera.world_to_camera"], facts["width"], facts["height"]),
        landmarks=Landmarks(
            tensors["landmarks.points"],
            tensors["landmarks.score"],
            facts["landmarks_width"],
            facts["landmarks_height"],
        ),
        tracked=tensors["tracked"],
        error_px=tensors["error_px"],
        fps=float(facts["fps"]),
        source_sha256=facts["source_sha256"],
    )


def _member(record: Any, dotted: str) -> Tensor:
    for name in dotted.split("."):
        record = getattr(record, name)
    return record


def _unusable(path: Path, why: str) -> InputError:
    return InputError(
        f"{path} {why}; a track file of format {VERSION} was expected", "delete it and run the tracking stage again"
    )


def _check(path: Path, facts: Any, tensors: dict[str, Tensor]) -> None:
    """Refuses files whose header or tensors are not those of ``save``."""
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise _unusable(path, "is damaged or no track file")
    if facts.get("version") != VERSION:
        raise _unusable(path, f"has format {facts.get('version')}")
    wrong = [name for name, kind in _FACTS.items() if not isinstance(facts.get(name), kind)]
    wrong += sorted(_AXES.keys() ^ tensors.keys())
    if wrong:
        raise _unusable(path, f"lacks or should not have {', '.join(wrong)}")
    sizes: dict[str, int] = {}
    for name, axes in _AXES.items():
        shape = tensors[name].shape
        if len(shape) != len(axes):
            raise _unusable(path, f"holds {name} of shape {tuple(shape)}")
        expected = [
            int(axis) if axis.isdigit() else sizes.setdefault(axis, size)
            for axis, size in zip(axes, shape, strict=True)
        ]
        if list(shape) != expected:
            raise _unusable(path, f"holds {name} of shape {tuple(shape)}")
    if tensors["tracked"].dtype != torch.bool:
        raise _unusable(path, "marks tracked frames by something other than true and false")
