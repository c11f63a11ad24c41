"""Head models with FLAME's functional interface."""

from __future__ import annotations

from functools import partial

from toonifygb.errors import InputError
from toonifygb.head.base import EYE_LEFT, EYE_RIGHT, JAW, JOINTS, NECK, PARENTS, PARTS, ROOT, HeadModel
from toonifygb.head.flame import from_arrays
from toonifygb.head.flame_file import load_flame
from toonifygb.head.open_head import load_open_head

__all__ = [
    "EYE_LEFT",
    "EYE_RIGHT",
    "JAW",
    "JOINTS",
    "NECK",
    "PARENTS",
    "PARTS",
    "ROOT",
    "HeadModel",
    "available",
    "from_arrays",
    "load",
    "load_open_head",
]

_LOADERS = {
    "open": load_open_head,
    "flame": partial(load_flame, "flame"),
    "flame2023": partial(load_flame, "flame2023"),
}


def available() -> tuple[str, ...]:
    """Names that ``load`` knows."""
    return tuple(_LOADERS)


def load(name: str = "open") -> HeadModel:
    """Head model by name, float32 on the CPU.

    Raises:
        InputError: no such model.
        AssetError: it is one that users add themselves, and it has not been added.
    """
    if name not in _LOADERS:
        raise InputError(f"there is no head model {name!r}, known are {', '.join(_LOADERS)}", "use 'open'")
    return _LOADERS[name]()
