"""Checkpoints of other people: what is read, what is refused, and that nothing of them ever runs."""

from __future__ import annotations

import argparse
import io
import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from toonifygb.assets import convert
from toonifygb.errors import AssetError

TENSORS = {
    "float": torch.arange(6.0).reshape(2, 3),
    "turned": torch.arange(6.0).reshape(2, 3).t(),
    "part": torch.arange(10.0)[4:7],
    "half": torch.tensor([0.5, -2.0], dtype=torch.float16),
    "double": torch.tensor([1 / 3], dtype=torch.float64),
    "count": torch.tensor(7),
    "empty": torch.zeros(0, 4),
}


def everything(checkpoint: convert.Checkpoint) -> tuple[dict[str, convert.StoredTensor], dict[str, str]]:
    """Keeps all tensors of ``state_dict``."""
    return checkpoint.values["state_dict"], {"note": "all"}


def saved(folder: Path, value: Any, *, new: bool = True) -> Path:
    """A checkpoint as torch writes it."""
    path = folder / "model.pt"
    torch.save(value, path, _use_new_zipfile_serialization=new)
    return path


@pytest.mark.parametrize("new", [True, False], ids=["archive", "stream"])
def test_tensors_and_options_come_through(tmp_path: Path, new: bool) -> None:
    state = OrderedDict(TENSORS)
    state._metadata = {"": {"version": 1}}  # type: ignore[attr-defined]
    options = {"use_skip": True, "rate": 1e-4, "names": ("a", "b"), "best": np.float64(0.25), "none": None}
    path = saved(tmp_path, {"state_dict": state, "opts": argparse.Namespace(**options)}, new=new)

    values = convert.read_checkpoint(path).values
    assert values["opts"] == options | {"names": ["a", "b"]}

    target = tmp_path / "new" / "model.safetensors"
    convert.convert(path, target, everything)
    found = load_file(target)
    assert set(found) == set(TENSORS)
    for name, tensor in TENSORS.items():
        assert torch.equal(found[name], tensor.long() if name == "count" else tensor.float()), name


def test_only_what_is_asked_for_is_read(tmp_path: Path) -> None:
    path = saved(tmp_path, {"state_dict": {"a": torch.ones(3)}, "discriminator": {"b": torch.full((4,), np.nan)}})
    convert.convert(path, tmp_path / "a.safetensors", everything)
    assert set(load_file(tmp_path / "a.safetensors")) == {"a"}


class Malice:
    """Leaves a trace when unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        return (Path.touch, (self.trace,))


def rewrite(
    path: Path, change: Callable[[str, bytes], bytes | None], compression: int = zipfile.ZIP_STORED
) -> Path:
    """The archive with entries changed, or left out where ``change`` gives None."""
    target = path.with_name("changed.pt")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w", compression) as new:
        for name in old.namelist():
            content = change(name, old.read(name))
            if content is not None:
                new.writestr(name, content)
    path.unlink()
    return target


def program(*instructions: bytes) -> bytes:
    """A pickle of protocol 2."""
    return b"\x80\x02" + b"".join(instructions) + b"."


def with_program(folder: Path, content: bytes) -> Path:
    """A checkpoint whose pickle is ``content``."""
    path = saved(folder, {"state_dict": {"a": torch.ones(4)}})
    return rewrite(path, lambda name, old: content if name.endswith("data.pkl") else old)


def malicious_object(folder: Path) -> Path:
    return saved(folder, {"state_dict": {"a": torch.ones(2)}, "opts": Malice(folder / "trace")})


def malicious_stream(folder: Path) -> Path:
    return saved(folder, {"state_dict": {"a": torch.ones(2)}, "opts": Malice(folder / "trace")}, new=False)


def malicious_protocol_4(folder: Path) -> Path:
    path = folder / "model.pt"
    torch.save({"state_dict": {}, "opts": Malice(folder / "trace")}, path, pickle_protocol=4)
    return path


def plain_pickle_with_code(folder: Path) -> Path:
    path = folder / "model.pkl"
    path.write_bytes(pickle.dumps({"state_dict": {}, "opts": Malice(folder / "trace")}))
    return path


def code_by_old_instruction(folder: Path) -> Path:
    return with_program(folder, program(b"(ios\nsystem\n"))


def code_through_a_permitted_module(folder: Path) -> Path:
    return with_program(folder, program(b"ctorch\nload\n", b"X\x01\x00\x00\x00x", b"\x85R"))


def code_by_dotted_name(folder: Path) -> Path:
    return with_program(folder, program(b"ctorch._utils\n_rebuild_tensor_v2.__globals__\n"))


def changed_function(folder: Path) -> Path:
    """Tries to change what a permitted name stands for: BUILD with a slot state sets attributes."""
    return with_program(
        folder, program(b"ctorch\nSize\n", b"N}X\x09\x00\x00\x00_functionccollections\nOrderedDict\ns\x86b")
    )


def changed_tensor(folder: Path) -> Path:
    """A tensor that grows after it was checked, to read beyond its storage."""
    storage = b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x04tQ"
    tensor = b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\x00K\x04\x85K\x01\x85\x89}tR"
    change = b"}X\x05\x00\x00\x00shapeJ\x00\x00\x00\x10\x85sb"
    return with_program(folder, program(b"}X\x0a\x00\x00\x00state_dict}X\x01\x00\x00\x00a", tensor, change, b"ss"))


def memo_bomb(folder: Path) -> Path:
    """Numbers an object 4 billion, for which unpicklers make room."""
    return with_program(folder, program(b"}r\xff\xff\xff\xff"))


def doubling_lists(folder: Path) -> Path:
    value: list = []
    for _ in range(25):
        value = [value, value]
    return saved(folder, {"state_dict": {}, "opts": {"x": value}})


NESTED = b"N\x85" + b"2\x86" * 60
"""A tuple of the same tuple twice, 60 times: 124 bytes that take 2^60 steps to hash."""


def nested_key(folder: Path) -> Path:
    return with_program(folder, program(b"}", NESTED, b"Ns"))


def nested_keys(folder: Path) -> Path:
    """The key lies in the memo when the dict is filled."""
    return with_program(folder, program(NESTED, b"q\x010}(h\x01Nu"))


def nested_key_of_an_ordered_dict(folder: Path) -> Path:
    return with_program(folder, program(b"ccollections\nOrderedDict\n]", NESTED, b"N\x86a\x85R"))


def nested_member(folder: Path) -> Path:
    return with_program(folder, b"\x80\x04\x8f(" + NESTED + b"\x90.")


def nested_kind_of_storage(folder: Path) -> Path:
    return with_program(folder, program(b"(X\x07\x00\x00\x00storage", NESTED, b"X\x01\x00\x00\x000NK\x04tQ"))


def nested_kind_of_number(folder: Path) -> Path:
    kind = b"cnumpy\ndtype\n" + NESTED + b"\x85R"
    return with_program(folder, program(b"cnumpy._core.multiarray\nscalar\n", kind, b"C\x00\x86R"))


def called_key(folder: Path) -> Path:
    """The answer of a permitted function, which is not known before it is called."""
    return with_program(folder, program(b"}ctorch\nSize\n", NESTED, b"\x85RNs"))


def numbers_beyond_counting(folder: Path) -> Path:
    """A size of a million bytes."""
    path = saved(folder, {"state_dict": {"a": torch.ones(4)}})
    large = b"\x8b" + struct.pack("<i", 2**20) + b"\x7f" * 2**20

    def grow(name: str, content: bytes) -> bytes:
        return content.replace(b"K\x04\x85", large + b"\x85") if name.endswith("data.pkl") else content

    return rewrite(path, grow)


def huge_tensor(folder: Path) -> Path:
    """A gigabyte claimed for a storage of 16 bytes."""
    path = saved(folder, {"state_dict": {"a": torch.ones(4)}})

    def grow(name: str, content: bytes) -> bytes:
        if not name.endswith("data.pkl"):
            return content
        return content.replace(b"K\x04\x85", b"J" + struct.pack("<i", 2**28) + b"\x85")

    return rewrite(path, grow)


def huge_storage(folder: Path) -> Path:
    path = saved(folder, {"state_dict": {"a": torch.ones(4)}})

    def grow(name: str, content: bytes) -> bytes:
        return content.replace(b"K\x04", b"J" + struct.pack("<i", 2**28)) if name.endswith("data.pkl") else content

    return rewrite(path, grow)


def expanded_tensor(folder: Path) -> Path:
    """One number seen 2^40 times."""
    return saved(folder, {"state_dict": {"a": torch.ones(1).expand(2**20, 2**20)}})


def zip_bomb(folder: Path) -> Path:
    path = saved(folder, {"state_dict": {"a": torch.zeros(2**20)}})
    return rewrite(path, lambda _, content: content, zipfile.ZIP_DEFLATED)


def missing_storage(folder: Path) -> Path:
    path = saved(folder, {"state_dict": {"a": torch.ones(4)}})
    return rewrite(path, lambda name, content: None if name.endswith("data/0") else content)


def short_storage(folder: Path) -> Path:
    path = saved(folder, {"state_dict": {"a": torch.ones(4)}})
    return rewrite(path, lambda name, content: content[:-1] if name.endswith("data/0") else content)


def flipped_bit(folder: Path) -> Path:
    path = saved(folder, {"state_dict": {"a": torch.full((64,), 0.123)}})
    content = bytearray(path.read_bytes())
    content[content.index(np.full(4, 0.123, "<f4").tobytes())] ^= 1
    path.write_bytes(content)
    return path


def cut_short(folder: Path) -> Path:
    path = saved(folder, {"state_dict": {"a": torch.ones(1000)}})
    path.write_bytes(path.read_bytes()[:-200])
    return path


def cut_stream(folder: Path) -> Path:
    path = saved(folder, {"state_dict": {"a": torch.ones(1000)}}, new=False)
    path.write_bytes(path.read_bytes()[:-200])
    return path


def not_finite(folder: Path) -> Path:
    return saved(folder, {"state_dict": {"a": torch.tensor([1.0, torch.nan])}})


def other_class(folder: Path) -> Path:
    return saved(folder, {"state_dict": {"a": torch.ones(2)}, "opts": Path("x")})


def big_endian(folder: Path) -> Path:
    path = saved(folder, {"state_dict": {"a": torch.ones(2)}})
    return rewrite(path, lambda name, content: b"big" if name.endswith("byteorder") else content)


def a_tensor_alone(folder: Path) -> Path:
    return saved(folder, torch.ones(3))


def a_picture(folder: Path) -> Path:
    path = folder / "face.pt"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(500))
    return path


def another_archive(folder: Path) -> Path:
    path = folder / "slides.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("slides.xml", "<xml/>")
    return path


def nothing(folder: Path) -> Path:
    path = folder / "model.pt"
    path.touch()
    return path


def absent(folder: Path) -> Path:
    return folder / "model.pt"


CASES: dict[Callable[[Path], Path], str] = {
    malicious_object: r"holds code \(.*\) beside its tensors; nothing of it was run",
    malicious_stream: r"holds code",
    malicious_protocol_4: r"holds code",
    plain_pickle_with_code: r"holds code|cut short",
    code_by_old_instruction: r"instruction INST, which can run code",
    code_through_a_permitted_module: r"holds code \(torch\.load\)",
    code_by_dotted_name: r"holds code",
    changed_function: r"tries to change an object",
    changed_tensor: r"tries to change an object",
    memo_bomb: r"numbers its objects",
    doubling_lists: r"more values",
    nested_key: r"keys that are neither text nor whole numbers",
    nested_keys: r"keys that are neither text nor whole numbers",
    nested_key_of_an_ordered_dict: r"keys that are neither text nor whole numbers",
    nested_member: r"keys that are neither text nor whole numbers",
    nested_kind_of_storage: r"refers to something other than numbers",
    nested_kind_of_number: r"has no kind",
    called_key: r"keys that are neither text nor whole numbers",
    numbers_beyond_counting: "sizes that are no counts",
    huge_tensor: r"claims shape \[268435456\] but its storage has 4 numbers",
    huge_storage: r"16 bytes for 268435456 numbers",
    expanded_tensor: r"claims shape \[1048576, 1048576\]",
    zip_bomb: r"compressed entry",
    missing_storage: r"lacks the entry .*data/0",
    short_storage: r"15 bytes for 4 numbers",
    flipped_bit: r"another checksum",
    cut_short: r"damaged or cut short",
    cut_stream: r"cut short at storage",
    not_finite: r"not finite",
    other_class: r"holds code \(pathlib",
    big_endian: r"byte order",
    a_tensor_alone: r"no named tensors",
    a_picture: r"damaged or no checkpoint",
    another_archive: r"without a checkpoint",
    nothing: r"is empty",
    absent: r"does not exist",
}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_bad_checkpoints_are_refused_in_a_sentence(case: Callable[[Path], Path], tmp_path: Path) -> None:
    path = case(tmp_path)
    before = set(tmp_path.iterdir())
    with pytest.raises(AssetError, match=CASES[case]) as caught:
        convert.convert(path, tmp_path / "out.safetensors", everything)
    assert "\n" not in str(caught.value)
    assert set(tmp_path.iterdir()) == before, "something was run or left behind"


def test_the_malice_would_work_on_an_ordinary_unpickler(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Malice(tmp_path / "trace")))
    assert (tmp_path / "trace").exists()


def test_an_existing_file_survives_a_failure(tmp_path: Path) -> None:
    target = tmp_path / "out.safetensors"
    target.write_bytes(b"older")
    with pytest.raises(AssetError):
        convert.convert(not_finite(tmp_path), target, everything)
    assert target.read_bytes() == b"older"


def test_damage_anywhere_is_a_sentence_or_harmless(tmp_path: Path) -> None:
    """Every truncation and many single changed bytes of a small checkpoint, in both layouts."""
    rng = np.random.default_rng(0)
    for new in (True, False):
        content = saved(tmp_path, {"state_dict": {"a": torch.ones(4)}, "opts": {"x": 1}}, new=new).read_bytes()
        variants = [content[:end] for end in range(1, len(content), 7)]
        for _ in range(300):
            damaged = bytearray(content)
            damaged[rng.integers(len(content))] = rng.integers(256)
            variants.append(bytes(damaged))
        for damaged in variants:
            (tmp_path / "model.pt").write_bytes(damaged)
            try:
                convert.convert(tmp_path / "model.pt", tmp_path / "out.safetensors", everything)
            except AssetError:
                continue
            except KeyError as error:  # the name "state_dict" itself was hit; ``everything`` does not check
                assert error.args == ("state_dict",)


def test_pickles_of_protocol_4_are_read(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    torch.save({"state_dict": TENSORS, "opts": {"x": 1}}, buffer, pickle_protocol=4)
    (tmp_path / "model.pt").write_bytes(buffer.getvalue())
    assert convert.read_checkpoint(tmp_path / "model.pt").values["opts"] == {"x": 1}
