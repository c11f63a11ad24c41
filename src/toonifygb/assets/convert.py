"""Other people's pickles, read without running any of the code that a pickle can hold.

Checkpoints of torch (``.pt``, trackers' ``.frame``) and plain pickles of arrays (models of the SMPL family).

The only file of the package that unpickles. A checkpoint is a pickle, a small program that builds objects, beside
raw numbers. Here the program is first read as a list of instructions and measured (``_inspect``); then it is run by
an unpickler that knows nothing but the names in ``_names``, each of which stands for something of ours: a tensor
becomes a ``StoredTensor``, a note of where its numbers lie. Numbers are touched only when they are written.

Both layouts of ``torch.save`` are read: the zip archive (since torch 1.6) and the older single stream.
Arrays of numpy become ``StoredTensor`` too; objects of scipy and chumpy become dicts of their parts.
"""

from __future__ import annotations

import io
import json
import math
import mmap
import os
import pickle
import pickletools
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from toonifygb.assets import pickled
from toonifygb.assets.archive import StoredArchive
from toonifygb.atomic import replacing
from toonifygb.errors import AssetError
from toonifygb.progress import SILENT

if TYPE_CHECKING:
    from toonifygb.progress import Progress

_STORAGES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}
"""Numbers behind torch's storage classes."""
_NUMPY_SCALARS = {"f8": "<f8", "f4": "<f4", "i8": "<i8", "i4": "<i4", "b1": "?"}
_MOST_PICKLE_BYTES = 32 * 2**20
"""A network of 2000 tensors needs less than one."""
_MOST_MODEL_BYTES = 256 * 2**20
"""A plain pickle holds its numbers itself; those of FLAME take 50."""
_MOST_VALUES, _MOST_DEPTH = 200_000, 32
_MOST_AXES, _MOST_LENGTH = 16, 2**62
_MARK = object()
_KEY_KINDS = (
    pickletools.pyunicode,
    pickletools.pystring,
    pickletools.pybytes_or_str,
    pickletools.pyint,
    pickletools.pylong,
    pickletools.pyinteger_or_bool,
    pickletools.pybool,
)
"""What may be a key: text as any protocol writes it, and whole numbers."""
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001
_ZIP_START = b"PK\x03\x04"
_KEEP_OUT = "do not open this file with other programs; use the file that the authors publish"
Describe = Callable[["Checkpoint"], "tuple[Mapping[str, StoredTensor], Mapping[str, str]]"]
"""What a kind of network makes of a checkpoint: the tensors to keep by name, and the metadata."""


class _Sealed:
    """Base of everything a pickle can lay hands on: its instruction BUILD, which sets attributes, ends here."""

    __slots__ = ()

    def __setstate__(self, state: object) -> None:
        raise AssetError("the checkpoint tries to change an object of the program that reads it", _KEEP_OUT)


@dataclass(frozen=True)
class StoredTensor(_Sealed):
    """A tensor in a checkpoint: what it claims to be, checked against the file, and where its numbers lie."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    """In elements."""

    def array(self) -> np.ndarray:
        """The numbers: float32 for anything with a fraction, int64 for the rest; native byte order, contiguous.

        Raises:
            AssetError: the file is damaged there.
        """
        self.storage.check()
        dtype = self.storage.dtype
        steps = [stride * dtype.itemsize for stride in self.strides]
        # This constructor compares shape and strides with the buffer once more.
        view = np.ndarray(self.shape, dtype, self.storage.bytes(), self.offset * dtype.itemsize, steps)
        return np.ascontiguousarray(view, np.float32 if view.dtype.kind == "f" else np.int64)


@dataclass(frozen=True)
class Checkpoint:
    """What ``torch.save`` was given, as plain dicts, lists, strings, numbers and ``StoredTensor``."""

    path: Path
    values: dict[str, Any]


@dataclass(frozen=True)
class _Storage(_Sealed):
    """A run of numbers in the file."""

    dtype: np.dtype
    length: int
    bytes: Callable[[], memoryview]
    check: Callable[[], None]


def convert(source: Path, target: Path, describe: Describe, *, progress: Progress = SILENT) -> None:
    """Writes the tensors that ``describe`` selects from checkpoint ``source`` to the safetensors file ``target``.

    ``target`` appears when it is complete; after an error nothing is left behind.

    Raises:
        AssetError: ``source`` is damaged, holds code or things that no network needs, or is not what ``describe``
            expects.
    """
    tensors, metadata = describe(read_checkpoint(source))
    write_safetensors(target, tensors, metadata, source=source, progress=progress)


def read_checkpoint(path: Path) -> Checkpoint:
    """Everything in a checkpoint but the numbers, which stay in the file until they are asked for.

    Raises:
        AssetError: the file is absent, damaged, or holds more than tensors and plain values.
    """
    return _read(path, "checkpoint of torch", lambda data: _reader(data)(data, path))


def read_pickle(path: Path) -> Checkpoint:
    """A plain pickle of named arrays; they stay in it until they are asked for.

    Raises:
        AssetError: the file is absent, damaged, or holds more than arrays and plain values.
    """

    def outside(*_: object) -> _Storage:
        raise AssetError(f"{path} refers to numbers outside of it")

    def reader(data: memoryview) -> Any:
        return _run(data[: _inspect(data, path, _MOST_MODEL_BYTES)], outside, path)

    return _read(path, "pickle of arrays", reader)


def _reader(data: memoryview) -> Callable[[memoryview, Path], Any]:
    return _read_archive if data[:4] == _ZIP_START else _read_stream


def _read(path: Path, kind: str, reader: Callable[[memoryview], Any]) -> Checkpoint:
    """What the reader makes of a file's bytes, if that is a dict."""
    if not path.is_file():
        raise AssetError(f"{path} does not exist; expected a {kind}", "check the path")
    if path.stat().st_size == 0:
        raise AssetError(f"{path} is empty", "download it again")
    with path.open("rb") as file:
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    try:
        value = reader(data)
    except AssetError:
        raise
    # A damaged pickle fails in any way the interpreter can; all of them mean the same.
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise AssetError(f"{path} is damaged or no {kind} ({said})", "download it again") from error
    if not isinstance(value, dict):
        raise AssetError(f"{path} holds no named tensors; expected a {kind}")
    return Checkpoint(path, value)


def _read_archive(data: memoryview, path: Path) -> Any:
    """The value in a zip archive."""
    archive = StoredArchive(data, path)
    pickles = [name for name in archive.names() if name == "data.pkl" or name.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise AssetError(f"{path} is a zip archive without a checkpoint of torch inside")
    folder = pickles[0].removesuffix("data.pkl")
    order = f"{folder}byteorder"
    if order in archive.names() and bytes(archive.view(order)) != b"little":
        raise AssetError(f"{path} was written on a machine with another byte order")
    archive.check(pickles[0])

    def storage(kind: str, key: str, length: int) -> _Storage:
        name, dtype = f"{folder}data/{key}", np.dtype(_STORAGES[kind])
        if len(archive.view(name)) != length * dtype.itemsize:
            raise AssetError(
                f"{path} is damaged: storage {key} has {len(archive.view(name))} bytes for {length} numbers of "
                f"{dtype.itemsize}",
                "download it again",
            )
        return _Storage(dtype, length, lambda: archive.view(name), lambda: archive.check(name))

    program = archive.view(pickles[0])
    return _run(program[: _inspect(program, path)], storage, path)


def _read_stream(data: memoryview, path: Path) -> Any:
    """The value in the older layout: five pickles in a row, then length and numbers of each storage."""
    lengths: dict[str, tuple[str, int]] = {}
    places: dict[str, int] = {}

    def storage(kind: str, key: str, length: int) -> _Storage:
        if lengths.setdefault(key, (kind, length)) != (kind, length):
            raise AssetError(f"{path} is damaged: storage {key} has two sizes")
        dtype = np.dtype(_STORAGES[kind])

        def content() -> memoryview:
            return data[places[key] : places[key] + length * dtype.itemsize]

        return _Storage(dtype, length, content, lambda: None)

    values, start = [], 0
    for _ in range(5):
        end = start + _inspect(data[start : start + _MOST_PICKLE_BYTES], path)
        values.append(_run(data[start:end], storage, path))
        start = end
    magic, protocol, _, value, keys = values
    is_named = isinstance(keys, list) and all(isinstance(key, str) for key in keys)
    if (magic, protocol) != (_LEGACY_MAGIC, _LEGACY_PROTOCOL) or not is_named or set(keys) != set(lengths):
        raise AssetError(f"{path} is no checkpoint of torch")
    for key in keys:
        kind, length = lengths[key]
        size = length * np.dtype(_STORAGES[kind]).itemsize
        if start + 8 + size > len(data) or int.from_bytes(data[start : start + 8], "little") != length:
            raise AssetError(f"{path} is damaged or cut short at storage {key}", "download it again")
        places[key], start = start + 8, start + 8 + size
    return value


class _Keys:
    """Follows the unpickler's stack and lets nothing become a key but strings and whole numbers.

    Keys are hashed, and a tuple hashes all it holds, each time: one whose two items are the same tuple, and so on
    60 times, is written in 300 bytes and takes longer than a life.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stack: list[Any] = []
        """For each value whether it may be a key; _MARK where one was set."""
        self._memo: dict[int, bool] = {}

    def follow(self, instruction: pickletools.OpcodeInfo, argument: Any) -> None:
        """Takes in the next instruction.

        Raises:
            AssetError: it would make something else a key.
            IndexError: it takes values that are not there.
        """
        name = instruction.name
        if name == "SETITEM":
            self._check([self._stack[-2]])
        elif name in ("SETITEMS", "DICT"):
            self._check(self._above_mark()[::2])
        elif name in ("ADDITEMS", "FROZENSET"):
            self._check(self._above_mark())
        if name in ("PUT", "BINPUT", "LONG_BINPUT"):
            self._memo[int(argument)] = self._stack[-1]
        elif name == "MEMOIZE":
            self._memo[len(self._memo)] = self._stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            self._stack.append(self._memo.get(int(argument), False))
        elif name == "DUP":
            self._stack.append(self._stack[-1])
        else:
            self._take(instruction)

    def _take(self, instruction: pickletools.OpcodeInfo) -> None:
        """What an ordinary instruction takes off the stack and lays on it."""
        before = instruction.stack_before
        if pickletools.stackslice in before:
            del self._stack[len(self._stack) - len(self._above_mark()) - 1 :]
            before = before[: before.index(pickletools.markobject)]
        for _ in before:
            self._stack.pop()
        for kind in instruction.stack_after:
            self._stack.append(_MARK if kind is pickletools.markobject else kind in _KEY_KINDS)

    def _above_mark(self) -> list[bool]:
        place = len(self._stack) - 1
        while self._stack[place] is not _MARK:
            place -= 1
        return self._stack[place + 1 :]

    def _check(self, keys: list[Any]) -> None:
        if not all(key is True for key in keys):
            raise AssetError(
                f"{self._path} has keys that are neither text nor whole numbers; nothing was run", _KEEP_OUT
            )


def _inspect(program: memoryview, path: Path, most_bytes: int = _MOST_PICKLE_BYTES) -> int:
    """Length of the pickle at the start of ``program``, whose instructions are looked at but not run.

    Raises:
        AssetError: it names anything beyond the names we know, asks for more memory than it can fill, or for the
            hash of more than a text or number.
    """
    known, keys = set(_names()), _Keys(path)
    if len(program) > most_bytes:
        raise AssetError(f"{path} describes its tensors in {len(program)} bytes; more than any network needs")
    for count, (instruction, argument, position) in enumerate(pickletools.genops(program.tobytes())):
        name = instruction.name
        if name == "GLOBAL":  # its successor takes the name off the stack; then the unpickler looks at it
            _check_name(tuple(str(argument).split(" ", 1)), known, path)
        elif name in ("INST", "OBJ", "EXT1", "EXT2", "EXT4"):
            raise AssetError(f"{path} holds the instruction {name}, which can run code; nothing was run", _KEEP_OUT)
        elif name.endswith("PUT") and int(argument) > count:  # type: ignore[arg-type]
            raise AssetError(f"{path} is damaged: it numbers its objects beyond their count")
        elif name == "STOP":
            return (position or 0) + 1
        keys.follow(instruction, argument)
    raise AssetError(f"{path} is damaged or cut short", "download it again")


def _check_name(name: tuple[str, ...], known: set[tuple[str, str]], path: Path) -> None:
    if name not in known:
        raise AssetError(
            f"{path} holds code ({'.'.join(name)}) beside its tensors; nothing of it was run", _KEEP_OUT
        )


class _Namespace:
    """Stands for ``argparse.Namespace``: options by name."""

    def __init__(self) -> None:
        self.options: Any = {}

    def __setstate__(self, state: Any) -> None:
        self.options = state


class _Room:
    """What calls may still copy: a pickle that calls again and again on one long value would fill any memory."""

    def __init__(self, size: int) -> None:
        self._left = size

    def take(self, arguments: tuple[Any, ...]) -> None:
        """Pays for one call, which makes at most as much as it is given.

        Raises:
            AssetError: there is no room left.
        """
        self._left -= sum(len(each) for each in arguments if isinstance(each, str | bytes | list | tuple | dict))
        if self._left < 0:
            raise AssetError("the file copies the same values again and again; no checkpoint does", _KEEP_OUT)


class _Call(_Sealed):
    """A function of ours under a name of the checkpoint's."""

    __slots__ = ("_function", "_room")

    def __init__(self, function: Callable[..., Any], room: _Room) -> None:
        self._function, self._room = function, room

    def __call__(self, *arguments: Any) -> Any:
        """The function's answer."""
        self._room.take(arguments)
        return self._function(*arguments)


def _names(room: _Room | None = None) -> dict[tuple[str, str], Any]:
    """Everything a checkpoint may name, and what stands for it.

    No pickle can change what stands here for the next one: functions are sealed, classes are new each time.
    """
    room = room or _Room(0)
    names: dict[tuple[str, str], Any] = {name: _Call(function, room) for name, function in _FUNCTIONS.items()}
    for place in ("numpy.core.multiarray", "numpy._core.multiarray"):
        names[place, "scalar"] = _Call(_scalar, room)
        names[place, "_reconstruct"] = _Call(lambda *_: pickled.Array(), room)
    names["argparse", "Namespace"] = type("_Namespace", (_Namespace,), {})
    names |= {("numpy", "ndarray"): "array", ("__builtin__", "object"): "object", ("builtins", "object"): "object"}
    return names | pickled.bags() | {("torch", kind): kind for kind in _STORAGES}


def _ordered(pairs: Any = ()) -> OrderedDict[str | int, Any]:
    """An ordered dict of pairs, as Python 2 wrote them."""
    if not all(len(pair) == 2 and isinstance(pair[0], str | int) for pair in pairs):
        raise AssetError("a table of the checkpoint has keys that are neither text nor whole numbers", _KEEP_OUT)
    return OrderedDict(pairs)


def _scalar(dtype: pickled.Dtype, data: bytes) -> float | int | bool:
    """Value of a numpy scalar."""
    if not isinstance(dtype, pickled.Dtype) or type(dtype.code) is not str:
        raise AssetError("a number of the checkpoint has no kind", "download it again")
    return np.frombuffer(data, _NUMPY_SCALARS[dtype.code])[0].item()


def _tensor(storage: Any, offset: int, size: Any, stride: Any, *_: object) -> StoredTensor:
    """A tensor, if all of it lies within its storage."""
    shape, strides = tuple(size), tuple(stride)
    numbers = (offset, *shape, *strides)
    if not isinstance(storage, _Storage) or len(shape) != len(strides) or len(shape) > _MOST_AXES:
        raise AssetError("a tensor of the checkpoint has no storage or no shape", "download it again")
    if not all(type(number) is int and 0 <= number < _MOST_LENGTH for number in numbers):
        raise AssetError("a tensor of the checkpoint has sizes that are no counts", "download it again")
    last = offset + sum((length - 1) * step for length, step in zip(shape, strides, strict=True))
    if math.prod(shape) > storage.length or (0 not in shape and last >= storage.length):
        raise AssetError(
            f"a tensor of the checkpoint claims shape {list(shape)} but its storage has {storage.length} numbers",
            "download it again",
        )
    return StoredTensor(storage, offset, shape, strides)


_FUNCTIONS: dict[tuple[str, str], Callable[..., Any]] = {
    ("collections", "OrderedDict"): _ordered,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_tensor"): _tensor,
    ("torch._utils", "_rebuild_parameter"): lambda value, *_: value,
    ("torch.nn.parameter", "Parameter"): lambda value, *_: value,
    ("torch", "Size"): tuple,
    ("torch", "device"): lambda kind, *_: kind,
    ("numpy", "dtype"): pickled.Dtype,
    ("_codecs", "encode"): lambda text, _: text.encode("latin1"),
    ("copy_reg", "_reconstructor"): pickled.rebuilt,
    ("copyreg", "_reconstructor"): pickled.rebuilt,
    # Sets are caches of chumpy's; nothing of theirs is wanted.
    ("__builtin__", "set"): lambda *_: None,
    ("builtins", "set"): lambda *_: None,
}
"""What stands for the functions that a checkpoint may call."""


def _run(program: memoryview, stored: Callable[[str, str, int], _Storage], path: Path) -> Any:
    """The value that the pickle builds, freed of stand-ins."""
    # Every character of a pickle is worth one: what it writes down once it may turn into something else once.
    names = _names(_Room(len(program)))

    class Restricted(pickle.Unpickler):
        """An unpickler that finds the known names and nothing else."""

        def find_class(self, module: str, name: str) -> Any:
            _check_name((module, name), set(names), path)
            return names[module, name]

        def persistent_load(self, pid: Any) -> _Storage:
            tag, kind, key, _, count = pid[:5]
            kinds = tuple(map(type, (tag, kind, key, count)))
            if kinds != (str, str, str, int) or tag != "storage" or kind not in _STORAGES:
                raise AssetError(f"{path} refers to something other than numbers")
            return stored(kind, key, count)

    return _plain(Restricted(io.BytesIO(program), encoding="latin1").load(), path)


def _plain(value: Any, path: Path) -> Any:
    """``value`` with stand-ins replaced, if it is of bounded size."""
    seen = 0

    def walk(item: Any, depth: int) -> Any:
        nonlocal seen
        seen += 1
        if seen > _MOST_VALUES or depth > _MOST_DEPTH:
            raise AssetError(f"{path} holds more values, or more deeply nested ones, than any network needs")
        if isinstance(item, _Namespace):
            item = item.options
        if isinstance(item, pickled.Bag):
            item = item.parts()
        if isinstance(item, pickled.Array):
            return _stored(item)
        if isinstance(item, dict):
            return {key: walk(inner, depth + 1) for key, inner in item.items()}
        if isinstance(item, list | tuple | set | frozenset):
            return [walk(inner, depth + 1) for inner in item]
        if item is None or isinstance(item, str | bytes | bool | int | float | StoredTensor):
            return item
        raise AssetError(f"{path} holds a {type(item).__name__} where plain values are expected")

    return walk(value, 0)


def _stored(array: pickled.Array) -> StoredTensor:
    """An array of numpy as a tensor whose numbers lie in the pickle itself."""
    array.bytes()
    storage = _Storage(array.dtype, math.prod(array.shape), array.bytes, lambda: None)
    return StoredTensor(storage, 0, array.shape, array.strides)


def write_safetensors(
    target: Path,
    tensors: Mapping[str, StoredTensor],
    metadata: Mapping[str, str],
    *,
    source: Path,
    progress: Progress = SILENT,
) -> None:
    """Writes tensors one after the other, so that memory holds one of them at a time.

    Args:
        target: the file; it appears when it is complete.
        tensors: by name.
        metadata: strings by name.
        source: where they come from, for messages.
        progress: counts bytes.

    Raises:
        AssetError: the source is damaged, or holds numbers that are not finite.
    """
    header: dict[str, Any] = {"__metadata__": dict(metadata)}
    end = 0
    for name, tensor in tensors.items():
        is_float = tensor.storage.dtype.kind == "f"
        start, end = end, end + math.prod(tensor.shape) * (4 if is_float else 8)
        header[name] = {
            "dtype": "F32" if is_float else "I64",
            "shape": list(tensor.shape),
            "data_offsets": [start, end],
        }
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as temporary, temporary.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for name, tensor in tensors.items():
            array = tensor.array()
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise AssetError(f"{source}: {name} holds numbers that are not finite", "download it again")
            file.write(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
            progress.update(header[name]["data_offsets"][1], end)
        file.flush()
        os.fsync(file.fileno())
