"""Track files: exact round trips, whole or not at all, clear refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from make import tiny_sequence
from safetensors.torch import load_file, save_file

from toonifygb import track
from toonifygb.errors import InputError
from toonifygb.structures import TrackedSequence
from toonifygb.track import files


@pytest.fixture
def sequence() -> TrackedSequence:
    return tiny_sequence(7)


@pytest.fixture
def path(sequence: TrackedSequence, tmp_path: Path) -> Path:
    path = tmp_path / "run" / "track.safetensors"
    track.save(sequence, path)
    return path


def rewritten(path: Path, facts: object = None, **tensors: torch.Tensor | None) -> Path:
    """The file with other facts, or with tensors replaced or (None) removed."""
    stored = load_file(path)
    for name, value in tensors.items():
        key = name.replace("__", ".")
        stored.pop(key, None)
        if value is not None:
            stored[key] = value
    if facts is None:
        from safetensors import safe_open

        with safe_open(path, framework="pt") as file:
            facts = json.loads(file.metadata()["track"])
    save_file(stored, path, metadata={"track": json.dumps(facts)})
    return path


def test_every_bit_comes_back(sequence: TrackedSequence, path: Path) -> None:
    sequence.error_px[2], sequence.landmarks.points[2] = torch.nan, torch.nan
    sequence.tracked[2] = False
    track.save(sequence, path)
    loaded = track.load(path)
    for name in files._AXES:
        ours, theirs = files._member(sequence, name), files._member(loaded, name)
        assert ours.dtype == theirs.dtype
        torch.testing.assert_close(theirs, ours, rtol=0, atol=0, equal_nan=True)
    assert (loaded.head_model, loaded.fps, loaded.source_sha256) == ("tiny", 25.0, "0" * 64)
    assert (loaded.camera.width, loaded.landmarks.height) == (64, 64)


def test_a_failed_write_leaves_the_old_file_and_no_litter(
    sequence: TrackedSequence, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = path.read_bytes()

    def full(tensors: object, name: str, metadata: object) -> None:
        Path(name).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(files, "save_file", full)
    with pytest.raises(OSError, match="disk full"):
        track.save(sequence, path)
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\.safetensors does not exist"):
        track.load(tmp_path / "nothing.safetensors")


@pytest.mark.parametrize("content", [b"", b"not a track", b"\x00" * 4096])
def test_something_else_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged or no track file"):
        track.load(path)


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.99])
def test_a_cut_off_file_is_refused(path: Path, kept: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match="damaged or no track file"):
        track.load(path)


@pytest.mark.parametrize("facts", [[], 3, {}, {"format": "other"}])
def test_a_foreign_header_is_refused(path: Path, facts: object) -> None:
    with pytest.raises(InputError, match="damaged or no track file"):
        track.load(rewritten(path, facts if facts else {"format": None}))


def test_another_format_number_is_named(path: Path) -> None:
    with pytest.raises(InputError, match="has format 99"):
        track.load(rewritten(path, {"format": files.FORMAT, "version": 99}))


def test_missing_or_surplus_tensors_are_named(path: Path) -> None:
    with pytest.raises(InputError, match=r"motion\.eyelids"):
        track.load(rewritten(path, motion__eyelids=None))


def test_tensors_of_another_length_are_named(path: Path) -> None:
    with pytest.raises(InputError, match=r"holds error_px of shape \(3,\)"):
        track.load(rewritten(path, error_px=torch.zeros(3)))


def test_marks_must_be_true_or_false(path: Path) -> None:
    with pytest.raises(InputError, match="true and false"):
        track.load(rewritten(path, tracked=torch.ones(7)))
