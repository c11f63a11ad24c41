"""The fingerprint by which a stage recognises its source."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from toonifygb.errors import InputError
from toonifygb.video.folder import image_files


def source_sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a clip's content as hex: of the file, or of a folder's images in their order.

    Names, dates and other files of a folder do not count.

    Raises:
        InputError: nothing readable is there.
    """
    path = Path(path)
    try:
        if not path.is_dir():
            return _of_file(path)
        whole = hashlib.sha256()
        for file in image_files(path):
            whole.update(bytes.fromhex(_of_file(file)))
        return whole.hexdigest()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}", "check the path") from error


def _of_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
