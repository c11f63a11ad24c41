"""Plain pickles of arrays: every class that models of the SMPL family hold, and every trick that must not work."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from old_pickles import Instance, ch, dumps, sparse

from toonifygb.assets import convert
from toonifygb.assets.convert import StoredTensor
from toonifygb.errors import AssetError

MATRIX = np.diag([1.0, 2.0, 0.0, 3.0])[:, [1, 0, 2, 3]]


def written(folder: Path, content: bytes) -> Path:
    path = folder / "model.pkl"
    path.write_bytes(content)
    return path


def loaded(value: object) -> np.ndarray:
    assert isinstance(value, StoredTensor)
    return value.array()


@pytest.mark.parametrize("protocol", [1, 2])
def test_what_python_2_wrote_comes_through(tmp_path: Path, protocol: int) -> None:
    arrays = {
        "double": np.arange(6.0).reshape(2, 3),
        "columns first": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "unsigned": np.array([0, 4294967295], "<u4"),
        "big endian": np.array([1.5, -2.0], ">f4"),
        "bytes": np.array([[1], [200]], "u1"),
        "truth": np.array([True, False]),
        "long": np.random.default_rng(0).standard_normal((40, 30)),
        "empty": np.zeros((0, 3)),
    }
    content = dumps({**arrays, "wrapped": ch(arrays["long"]), "style": "lbs", "none": None}, protocol)
    values = convert.read_pickle(written(tmp_path, content)).values
    assert values["style"] == "lbs" and values["none"] is None
    for name, array in arrays.items():
        found = loaded(values[name])
        assert found.shape == array.shape, name
        expected = array.astype(np.float32 if array.dtype.kind == "f" else np.int64)
        assert np.array_equal(found, expected) and found.dtype == expected.dtype, name
    assert values["wrapped"]["class"] == "Ch" and set(values["wrapped"]) == {"class", "x"}
    assert np.array_equal(loaded(values["wrapped"]["x"]), arrays["long"].astype(np.float32))


@pytest.mark.parametrize("kind", ["csc", "csr", "coo"])
def test_sparse_matrices_are_noted_part_by_part(tmp_path: Path, kind: str) -> None:
    values = convert.read_pickle(written(tmp_path, dumps({"J": sparse(MATRIX, kind)}))).values["J"]
    assert values["class"] == f"{kind}_matrix" and values["_shape"] == [4, 4]
    assert np.array_equal(np.sort(loaded(values["data"])), [1, 2, 3])


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_what_python_3_writes_comes_through(tmp_path: Path, protocol: int) -> None:
    arrays = {"a": np.arange(12.0).reshape(3, 4), "b": np.asfortranarray(np.ones((2, 3))), "c": np.float32(2.5)}
    values = convert.read_pickle(written(tmp_path, pickle.dumps(arrays, protocol))).values
    assert np.array_equal(loaded(values["a"]), arrays["a"]) and values["c"] == 2.5
    assert np.array_equal(loaded(values["b"]), arrays["b"])


@pytest.mark.parametrize("new", [True, False], ids=["archive", "stream"])
def test_arrays_in_torchs_files_come_through(tmp_path: Path, new: bool) -> None:
    arrays = {"exp": np.arange(4, dtype=np.float32)[None], "size": np.array([512, 512]), "tensor": torch.ones(2)}
    torch.save({"flame": arrays}, tmp_path / "0.frame", _use_new_zipfile_serialization=new)
    values = convert.read_checkpoint(tmp_path / "0.frame").values["flame"]
    for name, array in arrays.items():
        assert np.array_equal(loaded(values[name]), np.asarray(array)), name


# --- refused ---------------------------------------------------------------------------------------------------


def call(named: str, *arguments: bytes) -> bytes:
    """A pickle that calls something by name."""
    module, name = named.split(" ")
    return b"\x80\x02" + f"c{module}\n{name}\n(".encode() + b"".join(arguments) + b"tR."


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def nested(levels: int) -> bytes:
    return b"\x80\x02}" + text("x") + b"]" * levels + b"a" * (levels - 1) + b"s."


MADE = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR"


def array_state(shape: bytes, data: bytes, dtype: bytes = b"") -> bytes:
    """An array with a state of its own."""
    dtype = dtype or b"cnumpy\ndtype\n(U\x02f8K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    return MADE + b"(K\x01" + shape + dtype + b"\x89" + data + b"tb"


def within(value: bytes) -> bytes:
    return b"\x80\x02}" + text("x") + value + b"s."


def again_and_again(once: bytes, size: int, times: int) -> bytes:
    """One long text, written once, and a call on it over and over: gigabytes from kilobytes."""
    start = b"\x80\x02}" + text("x") + text("a" * size) + b"q\x000" + once + b"q\x010]("
    return start + (b"h\x01(h\x00" + text("latin1") + b"tR") * times + b"es."


EIGHT = b"U\x08" + bytes(8)
OBJECTS = b"cnumpy\ndtype\n(U\x02O8K\x00K\x01tR(K\x03U\x01|NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK?tb"
CASES: dict[str, tuple[bytes, str]] = {
    "os.system": (call("os system", text("true")), r"holds code \(os\.system\)"),
    "posix.system": (call("posix system", text("true")), r"holds code \(posix\.system\)"),
    "eval": (call("builtins eval", text("1")), r"holds code \(builtins\.eval\)"),
    "eval of Python 2": (call("__builtin__ eval", text("1")), r"holds code \(__builtin__\.eval\)"),
    "exec": (call("builtins exec", text("1")), r"holds code \(builtins\.exec\)"),
    "getattr": (call("builtins getattr", text("x"), text("y")), r"holds code \(builtins\.getattr\)"),
    "import": (call("builtins __import__", text("os")), r"holds code"),
    "attrgetter": (call("operator attrgetter", text("x")), r"holds code"),
    "getattr chain": (within(b"\x8c\x05numpy\x8c\x15ndarray.__class__.mro\x93"), r"holds code"),
    "chain through a permitted class": (within(b"\x8c\x09chumpy.ch\x94\x8c\x0bCh.__init__\x93"), r"holds code"),
    "numpy's own unpickler": (call("numpy load", text("x")), r"holds code \(numpy\.load\)"),
    "numpy's f2py": (call("numpy.testing._private.utils runstring", text("1")), r"holds code"),
    "a class of chumpy's that computes": (call("chumpy.ch depends_on", text("x")), r"holds code"),
    "persistent id": (within(b"Pstorage\n"), r"refers to|damaged"),
    "persistent id of torch": (
        within(b"(U\x07storagectorch\nFloatStorage\nU\x010U\x03cpuK\x04tQ"),
        r"refers to numbers",
    ),
    "extension": (b"\x80\x02}" + b"\x82\x01s.", r"instruction EXT1"),
    "instance": (b"(ios\nsystem\n.", r"instruction INST"),
    "deep lists": (nested(100_000), r"deeply nested"),
    "text beyond the file": (b"\x80\x04\x8d" + struct.pack("<Q", 2**40) + b"x.", r"damaged|cut short"),
    "frame beyond the file": (b"\x80\x04\x95" + struct.pack("<Q", 2**40) + b"}.", r"damaged|cut short"),
    "array of objects": (within(array_state(b"(K\x01t", b"](Ne", OBJECTS)), r"array of objects"),
    "array of text": (within(array_state(b"(K\x02t", EIGHT, OBJECTS.replace(b"O8", b"S4"))), r"type 'S4'"),
    "array larger than its bytes": (
        within(array_state(b"(J\x00\x00\x00\x40J\x00\x00\x00\x40t", EIGHT)),
        r"claims shape",
    ),
    "array of negative size": (within(array_state(b"(J\xff\xff\xff\xffJ\xff\xff\xff\xfft", EIGHT)), r"no counts"),
    "array given twice": (
        within(array_state(b"(K\x01t", EIGHT) + array_state(b"(K\x01t", EIGHT)[len(MADE) :]),
        r"array of objects, or changes one",
    ),
    "array without contents": (within(MADE), r"without contents"),
    "bytes again and again": (again_and_again(b"c_codecs\nencode\n", 10**6, 50), r"again and again"),
    "an object of another class": (
        dumps({"x": Instance("collections", "Counter", {})}, 1),
        r"holds code \(collections\.Counter\)",
    ),
    "a function made an object": (
        within(b"ccopy_reg\n_reconstructor\n(c_codecs\nencode\nc__builtin__\nobject\nNtR"),
        r"a class that no model needs",
    ),
    "attributes of a permitted class": (within(b"cchumpy.ch\nCh\n}U\x05labelU\x01ysb"), r"damaged"),
    "attributes of an array": (
        within(array_state(b"(K\x01t", EIGHT) + b"N}U\x05shapeK\x09s\x86b"),
        r"damaged|array",
    ),
    "no dict": (b"\x80\x02].", r"holds no named tensors"),
    "nothing": (b"", r"is empty"),
    "cut short": (dumps({"x": np.ones(9)})[:-40], r"damaged|cut short"),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_pickles_are_refused_in_a_sentence(name: str, tmp_path: Path) -> None:
    content, sentence = CASES[name]
    path = written(tmp_path, content)
    with pytest.raises(AssetError, match=sentence) as caught:
        for value in convert.read_pickle(path).values.values():
            loaded(value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == [path]


def test_the_copying_bomb_would_work_without_its_guard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fifty megabytes from one; the same file times a thousand would fill any machine."""
    monkeypatch.setattr(convert._Room, "take", lambda self, arguments: None)
    content, _ = CASES["bytes again and again"]
    values = convert.read_pickle(written(tmp_path, content)).values
    assert sum(len(each) for each in values["x"]) == 50 * 10**6


def test_damage_anywhere_is_a_sentence_or_harmless(tmp_path: Path) -> None:
    """Every truncation and many single changed bytes of a small model."""
    rng = np.random.default_rng(1)
    content = dumps({"a": np.ones((2, 2)), "w": ch(np.ones(3)), "J": sparse(MATRIX)})
    variants = [content[:end] for end in range(1, len(content), 5)]
    for _ in range(400):
        damaged = bytearray(content)
        damaged[rng.integers(len(content))] = rng.integers(256)
        variants.append(bytes(damaged))
    read = 0
    for damaged in variants:
        try:
            read += bool(convert.read_pickle(written(tmp_path, damaged)).values)
        except AssetError as error:
            assert "\n" not in str(error)
    assert 0 < read < len(variants) / 2
