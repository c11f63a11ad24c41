"""Files that appear whole or not at all."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from toonifygb.atomic import replacing

if TYPE_CHECKING:
    from pathlib import Path


def test_the_file_changes_when_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "note.json"
    path.write_text("old")
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
        assert temporary.suffix == ".json"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "note.json"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), replacing(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_of_two_files_the_one_named_last_comes_first(tmp_path: Path) -> None:
    """A note written beside its data must not be there before them."""
    note, data = tmp_path / "note.json", tmp_path / "data.bin"
    data_is_a_folder = data / "in the way"
    data_is_a_folder.mkdir(parents=True)
    with pytest.raises(OSError, match="data"), replacing(note) as first, replacing(data) as second:
        first.write_text("{}")
        second.write_bytes(b"1")
    assert not note.exists()
    assert list(tmp_path.iterdir()) == [data]
