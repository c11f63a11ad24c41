"""Checkpoints: every tensor and number of a stage in one safetensors file that is at no moment half there."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from toonifygb.atomic import replacing
from toonifygb.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from torch import Tensor, nn
    from torch.optim import Optimizer

Tensors = dict[str, torch.Tensor]


def module_tensors(prefix: str, module: nn.Module) -> Tensors:
    """State of a network under names that begin with ``prefix``."""
    return {f"{prefix}.{key}": value for key, value in module.state_dict().items()}


def restore_module(prefix: str, module: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Puts back what ``module_tensors`` gave; missing or surplus names raise RuntimeError."""
    module.load_state_dict(_under(prefix, tensors))


def optimizer_tensors(prefix: str, optimizer: Optimizer) -> Tensors:
    """Running means and step counts of an optimiser, by the number of the parameter they belong to."""
    states = optimizer.state_dict()["state"]
    return {f"{prefix}.{number}.{name}": value for number, entry in states.items() for name, value in entry.items()}


def restore_optimizer(prefix: str, optimizer: Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Puts back what ``optimizer_tensors`` gave; learning rates and the like stay as they were built."""
    states: dict[int, dict[str, Tensor]] = {}
    for key, value in _under(prefix, tensors).items():
        number, _, name = key.partition(".")
        states.setdefault(int(number), {})[name] = value
    optimizer.load_state_dict({"state": states, "param_groups": optimizer.state_dict()["param_groups"]})


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> Tensors:
    return {key[len(prefix) + 1 :]: value for key, value in tensors.items() if key.startswith(f"{prefix}.")}


def write_checkpoint(path: Path, tensors: Tensors, notes: dict[str, Any]) -> None:
    """Writes a checkpoint; a process killed at any moment leaves the old file or the new one."""
    # Copied, because safetensors refuses tensors that share memory, as averages and buffers may.
    contiguous = {key: value.detach().to("cpu", copy=True).contiguous() for key, value in tensors.items()}
    with replacing(path) as temporary:
        save_file(contiguous, temporary, metadata={"notes": json.dumps(notes)})


def read_checkpoint(path: Path, fingerprint: str) -> tuple[Tensors, dict[str, Any]] | None:
    """Tensors and notes of a checkpoint; None where there is none.

    Raises:
        InputError: the file is damaged, or belongs to a training of other pictures or settings.
    """
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            notes = json.loads(file.metadata()["notes"])
            tensors = {key: file.get_tensor(key) for key in file.keys()}
        known = notes["fingerprint"]
    except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        raise InputError(f"checkpoint {path} is damaged ({error})", "delete it to train from the start") from error
    if known != fingerprint:
        raise InputError(
            f"{path.parent} holds a training of other pictures, another base or other settings",
            "pass another --out, or delete that folder",
        )
    return tensors, notes
