"""Intermediates of a run that belong to no single room."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors import SafetensorError, numpy, safe_open
from safetensors.torch import save_file

from toonifygb import head, track, train
from toonifygb.atomic import replacing
from toonifygb.errors import InputError
from toonifygb.structures import Landmarks

if TYPE_CHECKING:
    from toonifygb.pipeline.stages import Run
    from toonifygb.structures import TrackedSequence

LANDMARK_TRACK = "landmark_track.safetensors"
"""Work file: the track before the pixels had their say."""


def open_crops(run: Run, sequence: TrackedSequence) -> train.Dataset:
    """The run's training set, with the necks ending where a track of its clip has them end."""
    cuts = track.neck_cuts(sequence, head.load(sequence.head_model))
    return train.load_dataset(run.work("dataset")).cut_at(cuts)


def save_landmarks(landmarks: Landmarks, path: Path) -> None:
    """Writes landmarks so that the file is at no moment half there."""
    # One entry: several would be written in an order that changes from process to process.
    size = {"size": json.dumps([landmarks.width, landmarks.height])}
    tensors = {"points": landmarks.points.contiguous(), "score": landmarks.score.contiguous()}
    with replacing(path) as temporary:
        save_file(tensors, temporary, metadata=size)


def load_landmarks(path: Path) -> Landmarks:
    """Landmarks from ``save_landmarks``.

    Raises:
        InputError: the file is damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            width, height = json.loads(file.metadata()["size"])
            return Landmarks(file.get_tensor("points"), file.get_tensor("score"), width, height)
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} does not hold landmarks ({error})", "delete it and run again") from error


def save_state(state: dict[str, Any], path: Path) -> None:
    """Writes what a style keeps of a clip, numbers and arrays, exactly."""
    arrays = {name: np.ascontiguousarray(value) for name, value in state.items() if isinstance(value, np.ndarray)}
    plain = {name: value for name, value in state.items() if name not in arrays}
    with replacing(path) as temporary:
        numpy.save_file(arrays, temporary, metadata={"plain": json.dumps(plain)})


def load_state(path: Path) -> dict[str, Any]:
    """The state from ``save_state``.

    Raises:
        InputError: the file is damaged.
    """
    try:
        with safe_open(path, framework="np") as file:
            plain = json.loads(file.metadata()["plain"])
            return plain | {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} does not hold the state of a style ({error})", "delete it and run again"
        ) from error
