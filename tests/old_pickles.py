"""Pickles as Python 2 wrote them: numpy arrays, scipy's sparse matrices and chumpy's objects, without any of these.

Python 3 cannot write them any more, so the instructions are put together by hand.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Instance:
    """An object of a class by its full name."""

    module: str
    name: str
    state: dict[str, Any] = field(default_factory=dict)


def ch(array: np.ndarray) -> Instance:
    """``chumpy.ch.Ch`` as FLAME's file has it: the array and some caches."""
    caches = {"_dirty_vars": Instance("__builtin__", "set"), "_itr": None, "_parents": {}, "_cache": {"drs": {}}}
    return Instance("chumpy.ch", "Ch", {"x": array, **caches})


def sparse(matrix: np.ndarray, kind: str = "csc") -> Instance:
    """A matrix of ``scipy.sparse``."""
    shape = tuple(int(length) for length in matrix.shape)
    lines = matrix.T if kind == "csc" else matrix
    rows, others = np.nonzero(lines)
    state: dict[str, Any] = {"_shape": shape, "maxprint": 50, "data": lines[rows, others]}
    if kind == "coo":
        state |= {"row": rows.astype("<i4"), "col": others.astype("<i4")}
    else:
        counts = np.bincount(rows, minlength=len(lines))
        state |= {"indices": others.astype("<i4"), "indptr": np.append(0, counts.cumsum()).astype("<i4")}
    return Instance(f"scipy.sparse.{kind}", f"{kind}_matrix", state)


def dumps(value: Any, protocol: int = 2) -> bytes:
    """The pickle; protocol 2 makes objects by NEWOBJ, 1 by ``copy_reg._reconstructor``."""
    return (b"\x80\x02" if protocol == 2 else b"") + _written(value, protocol) + b"."


def _text(value: bytes) -> bytes:
    return b"U" + bytes([len(value)]) + value if len(value) < 256 else b"T" + struct.pack("<i", len(value)) + value


def _written(value: Any, protocol: int) -> bytes:
    def put(item: Any) -> bytes:
        return _written(item, protocol)

    if value is None:
        return b"N"
    if isinstance(value, str):
        return _text(value.encode("latin1"))
    if isinstance(value, bool):
        return b"\x88" if value else b"\x89"
    if isinstance(value, int):
        return b"J" + struct.pack("<i", value)
    if isinstance(value, tuple):
        return b"(" + b"".join(map(put, value)) + b"t"
    if isinstance(value, list):
        return b"](" + b"".join(map(put, value)) + b"e"
    if isinstance(value, dict):
        return b"}(" + b"".join(put(key) + put(item) for key, item in value.items()) + b"u"
    if isinstance(value, np.ndarray):
        return _array(value, protocol)
    assert isinstance(value, Instance)
    named = f"c{value.module}\n{value.name}\n".encode()
    if value.name == "set":
        return named + b"(]tR"
    made = (
        named + b")\x81"
        if protocol == 2
        else b"ccopy_reg\n_reconstructor\n(" + named + b"c__builtin__\nobject\nNtR"
    )
    return made + put(value.state) + b"b"


def _array(value: np.ndarray, protocol: int) -> bytes:
    fortran = not value.flags.c_contiguous and value.flags.f_contiguous
    code = f"{value.dtype.kind}{value.dtype.itemsize}"
    order = (
        "|" if value.dtype.itemsize == 1 else {"=": "<", "|": "|"}.get(value.dtype.byteorder, value.dtype.byteorder)
    )
    dtype = b"cnumpy\ndtype\n(" + _text(code.encode()) + b"I0\nI1\ntR"
    dtype += b"(I3\n" + _text(order.encode()) + b"NNNI-1\nI-1\nI0\ntb"
    shape = _written(tuple(int(length) for length in value.shape), protocol)
    data = value.tobytes("F" if fortran else "C")
    made = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntU\x01btR"
    flag = b"I01\n" if fortran else b"I00\n"
    return made + b"(I1\n" + shape + dtype + flag + _text(data) + b"tb"
