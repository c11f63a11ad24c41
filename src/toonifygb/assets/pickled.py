"""What stands for objects of numpy, scipy and chumpy in a foreign pickle: notes of their parts that run nothing.

Models of the SMPL family (FLAME among them) are dictionaries of numpy arrays, some of them wrapped by chumpy and
one a sparse matrix of scipy, pickled by Python 2. Trackers keep numpy arrays in files of ``torch.save``.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from toonifygb.errors import AssetError

_NUMBERS = re.compile(r"f[248]|[iu][1248]|b1")
_SPARSE = ("csc", "csr", "coo")
PARTS = ("x", "a", "idxs", "preferred_shape", "newshape", "_shape", "data", "indices", "indptr", "row", "col")
"""What is kept of an object; the rest are caches."""


class Dtype:
    """Stands for ``numpy.dtype``."""

    def __init__(self, code: str, *_: object) -> None:
        self.code, self.order = code, "="

    def __setstate__(self, state: Any) -> None:
        """Byte order; alignment and what compound types have are left out."""
        self.order = str(state[1])

    def numpy(self) -> np.dtype:
        """The type itself.

        Raises:
            AssetError: it is none of numbers.
        """
        if (
            type(self.code) is not str
            or not _NUMBERS.fullmatch(self.code)
            or self.order not in ("<", ">", "|", "=")
        ):
            raise AssetError(f"the file holds an array of the type {self.code!r}; only arrays of numbers are read")
        return np.dtype(self.code).newbyteorder("<" if self.order in "|=" else self.order)


class Array:
    """Stands for ``numpy.ndarray``: its claims, compared with its bytes, which are not touched."""

    __slots__ = ("_data", "dtype", "fortran", "shape")

    def __init__(self) -> None:
        self._data: bytes | str | None = None

    def __setstate__(self, state: Any) -> None:
        """Takes the contents, once: version, shape, type, whether columns come first, bytes."""
        _, shape, dtype, fortran, data = state
        if self._data is not None or not isinstance(dtype, Dtype) or type(data) not in (bytes, str):
            raise AssetError("the file holds an array of objects, or changes one; only arrays of numbers are read")
        self.dtype, self.shape, self.fortran = dtype.numpy(), tuple(shape), bool(fortran)
        if not all(type(length) is int and length >= 0 for length in self.shape):
            raise AssetError("an array of the file has sizes that are no counts", "download it again")
        if math.prod(self.shape) * self.dtype.itemsize != len(data):
            raise AssetError(
                f"an array of the file claims shape {list(self.shape)} but has {len(data)} bytes",
                "download it again",
            )
        self._data = data

    @property
    def strides(self) -> tuple[int, ...]:
        """In elements."""
        order = self.shape if self.fortran else self.shape[::-1]
        steps = tuple(math.prod(order[:axis]) for axis in range(len(order)))
        return steps if self.fortran else steps[::-1]

    def bytes(self) -> memoryview:
        """Its contents.

        Raises:
            AssetError: it was never given any, or text where bytes should be.
        """
        if self._data is None:
            raise AssetError("the file holds an array without contents", "download it again")
        try:
            # Python 2 wrote bytes as text.
            return memoryview(self._data.encode("latin1") if isinstance(self._data, str) else self._data)
        except UnicodeEncodeError as error:
            raise AssetError("the file holds text where the numbers of an array should be") from error


class Bag:
    """Stands for an object of a class that keeps arrays: its parts by name."""

    label = ""

    def __init__(self) -> None:
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        """Keeps the attributes as they are."""
        self.state = state

    def parts(self) -> dict[str, Any]:
        """The attributes that matter."""
        state = self.state[0] if isinstance(self.state, tuple) and self.state else self.state
        known = state if isinstance(state, dict) else {}
        return {"class": self.label, **{name: known[name] for name in PARTS if name in known}}


def bags() -> dict[tuple[str, str], type[Bag]]:
    """Classes by the names that pickles give them; new ones each time, so that no pickle can change the next."""
    names = [("chumpy.ch", "Ch"), *(("chumpy.reordering", name) for name in ("Select", "Reshape"))]
    for kind in _SPARSE:
        places = (f"scipy.sparse.{kind}", f"scipy.sparse._{kind}")
        names += [(place, f"{kind}_{form}") for place in places for form in ("matrix", "array")]
    return {name: type("_Bag", (Bag,), {"label": name[1]}) for name in names}


def rebuilt(kind: Any, *_: object) -> Bag:
    """Stands for ``copy_reg._reconstructor``, by which older protocols make objects."""
    if not (isinstance(kind, type) and issubclass(kind, Bag)):
        raise AssetError("the file makes objects of a class that no model needs; nothing of it was run")
    return kind()
