"""Where data lie in a zip archive whose entries are not compressed, as torch writes them.

Nothing is unpacked: an entry is a range of bytes of the file, so no archive can grow when it is read.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from typing import TYPE_CHECKING

from toonifygb.errors import AssetError

if TYPE_CHECKING:
    from pathlib import Path

_LOCAL_HEADER = struct.Struct("<4s22sHH")
"""Signature, fields that the directory repeats, lengths of name and extra field."""
_SIGNATURE = b"PK\x03\x04"
_MOST_ENTRIES = 100_000


class StoredArchive:
    """Entries of an uncompressed zip archive as views of its bytes.

    Args:
        data: the whole file, usually a memory map.
        path: its name, for messages.

    Raises:
        AssetError: the archive is damaged.
    """

    def __init__(self, data: memoryview, path: Path) -> None:
        self._data, self._path = data, path
        try:
            with zipfile.ZipFile(path) as archive:
                entries = archive.infolist()
        except (zipfile.BadZipFile, NotImplementedError, ValueError, struct.error) as error:
            raise AssetError(f"{path} is damaged or cut short ({error})", "download it again") from error
        if len(entries) > _MOST_ENTRIES:
            raise AssetError(f"{path} has {len(entries)} entries; a checkpoint has at most {_MOST_ENTRIES}")
        self._entries = {entry.filename: entry for entry in entries}

    def names(self) -> list[str]:
        """Names of all entries."""
        return list(self._entries)

    def view(self, name: str) -> memoryview:
        """Bytes of an entry, not yet checked against its checksum.

        Raises:
            AssetError: there is no such entry, it is compressed, or it reaches beyond the file.
        """
        entry = self._entries.get(name)
        if entry is None:
            raise AssetError(f"{self._path} lacks the entry {name}", "download it again")
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size:
            raise AssetError(f"{self._path} holds the compressed entry {name}; torch never compresses")
        start, end = entry.header_offset, entry.header_offset + _LOCAL_HEADER.size
        if end <= len(self._data):
            signature, _, n_name, n_extra = _LOCAL_HEADER.unpack(self._data[start:end])
            start = end + n_name + n_extra
            end = start + entry.file_size
        else:
            signature = b""
        if signature != _SIGNATURE or end > len(self._data):
            raise AssetError(f"{self._path} is damaged or cut short at the entry {name}", "download it again")
        return self._data[start:end]

    def check(self, name: str) -> None:
        """Raises AssetError where an entry does not have the checksum that the archive gives for it."""
        if zlib.crc32(self.view(name)) != self._entries[name].CRC:
            raise AssetError(f"{self._path} is damaged: entry {name} has another checksum", "download it again")
