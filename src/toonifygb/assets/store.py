"""The cache of model files: what is there, what can be had, and how it gets there.

    <cache>/licenses.json              licences that were accepted, and when
    <cache>/downloads/FILE             the authors' file while it is fetched and converted
    <cache>/models/NAME.safetensors    the converted file
    <cache>/models/NAME.json           its checksum, and that of the file it was made from

``<cache>`` is ``~/.cache/toonifygb`` unless ``TOONIFYGB_CACHE`` names another folder. The JSON is written last: a
model without it is not there.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from toonifygb.assets.download import RESUMABLE, download
from toonifygb.assets.manifest import Asset, find, manifest
from toonifygb.atomic import replacing
from toonifygb.errors import AssetError
from toonifygb.progress import SILENT

if TYPE_CHECKING:
    from collections.abc import Callable

    from toonifygb.progress import Progress

    Importer = Callable[[Path, Path], None]
    """Turns the authors' file (first) into ours (second), which it writes atomically."""
    Consent = Callable[[Asset], bool]
    """Shows a licence and says whether the user agrees to it."""

CACHE_VARIABLE = "TOONIFYGB_CACHE"


@dataclass(frozen=True)
class Entry:
    """An asset and whether it is there."""

    asset: Asset
    path: Path | None
    """The converted file; None when it is not there."""
    size_bytes: int | None


def cache_folder() -> Path:
    """Where model files are kept."""
    chosen = os.environ.get(CACHE_VARIABLE)
    return Path(chosen).expanduser() if chosen else Path.home() / ".cache" / "toonifygb"


def entries() -> list[Entry]:
    """Every asset of the manifest."""
    found = []
    for asset in manifest().values():
        path = _model(asset)
        there = path.is_file() and _note(asset).is_file()
        found.append(Entry(asset, path if there else None, path.stat().st_size if there else None))
    return found


def model_path(name: str) -> Path:
    """The converted file of an asset.

    Raises:
        InputError: no such asset.
        AssetError: it has not been added.
    """
    asset = find(name)
    path = _model(asset)
    if not (path.is_file() and _note(asset).is_file()):
        way = asset.by_hand if asset.sign_up else f"toonifygb assets get {name}"
        raise AssetError(
            f"the model '{name}' is not in {path.parent}",
            f"{way}, or use {asset.instead}, which needs none",
        )
    return path


def get(name: str, importer: Importer, consent: Consent, *, progress: Progress = SILENT) -> Path:
    """Downloads and converts an asset, unless it is there.

    Raises:
        InputError: no such asset.
        AssetError: the licence was declined, the file cannot be had (some authors want to know their users), or it
            is not what it should be.
        Stopped: the user asked to stop; the next call goes on.
    """
    asset = find(name)
    if _model(asset).is_file() and _note(asset).is_file():
        return _model(asset)
    if asset.sign_up:
        raise AssetError(f"{name} is given by its authors to registered users only", asset.by_hand)
    _agree(asset, consent)
    source = cache_folder() / "downloads" / asset.file
    # A complete file is left here when the user stopped its conversion.
    digest = _digest(source) if source.is_file() else _fetch(asset, source, progress)
    try:
        _import(asset, source, importer, digest)
    except AssetError:
        source.unlink()  # it is whole, so it would not convert at the next try either
        raise
    source.unlink()
    return _model(asset)


def add(name: str, source: Path, importer: Importer, consent: Consent) -> Path:
    """Converts a file of the authors that the user has; the file itself stays as it is.

    Raises:
        InputError: no such asset.
        AssetError: the licence was declined, or this is not the asset's file.
    """
    asset = find(name)
    if not source.is_file():
        raise AssetError(f"{source} does not exist; expected the file {asset.file}", "check the path")
    digest = _digest(source)
    if asset.sha256 is not None and digest != asset.sha256:
        raise AssetError(
            f"{source} is not the published {asset.file}: checksum {digest[:12]}… instead of {asset.sha256[:12]}…",
            f"download it again from {asset.pages[0]}",
        )
    _agree(asset, consent)
    _import(asset, source, importer, digest)
    return _model(asset)


def verify(name: str) -> str:
    """Reads the converted file of an asset again and compares it with what was written.

    Returns:
        Its SHA-256.

    Raises:
        InputError: no such asset.
        AssetError: it is not there, or it has changed.
    """
    path, asset = model_path(name), find(name)
    try:
        expected = json.loads(_note(asset).read_text(encoding="utf-8"))["sha256"]
    except (ValueError, KeyError, TypeError) as error:
        raise AssetError(f"{_note(asset)} is damaged", f"remove it and run: toonifygb assets get {name}") from error
    found = _digest(path)
    if found != expected:
        raise AssetError(
            f"{path} has changed since it was written: checksum {found[:12]}… instead of {expected[:12]}…",
            f"remove it and run: toonifygb assets get {name}",
        )
    return found


def is_accepted(asset: Asset) -> bool:
    """Whether the user has agreed to the asset's licence before."""
    return asset.license.key in _accepted()


def _agree(asset: Asset, consent: Consent) -> None:
    """Asks for consent once per licence, and remembers it."""
    accepted = _accepted()
    if asset.license.key in accepted:
        return
    if not consent(asset):
        raise AssetError(
            f"{asset.name} may only be used under the {asset.license.name}, which was not accepted",
            f"read {asset.license.url}, then pass --accept-license",
        )
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    accepted[asset.license.key] = {"name": asset.license.name, "url": asset.license.url, "accepted": now}
    _write_json(cache_folder() / "licenses.json", accepted)


def _accepted() -> dict[str, Any]:
    try:
        accepted = json.loads((cache_folder() / "licenses.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return accepted if isinstance(accepted, dict) else {}


def _fetch(asset: Asset, source: Path, progress: Progress) -> str:
    """The authors' file from the first address that has it."""
    problems = []
    for url in asset.urls:
        try:
            return download(url, source, size_bytes=asset.size_bytes, sha256=asset.sha256, progress=progress)
        except AssetError as error:
            problems.append(error)
    said = "; ".join(problem.message for problem in problems)
    again = f"{RESUMABLE}, or " if any(problem.hint == RESUMABLE for problem in problems) else ""
    raise AssetError(
        f"{asset.name} could not be downloaded: {said}",
        f"{again}download {asset.file} yourself from {asset.pages[0]} and run: "
        f"toonifygb assets add {asset.name} {asset.file}; {asset.instead} needs no model",
    )


def _import(asset: Asset, source: Path, importer: Importer, digest: str) -> None:
    path = _model(asset)
    path.parent.mkdir(parents=True, exist_ok=True)
    _note(asset).unlink(missing_ok=True)
    importer(source, path)
    facts = {
        "asset": asset.name,
        "file": asset.file,
        "file_sha256": digest,
        "file_checksum_was_published": asset.sha256 is not None,
        "sha256": _digest(path),
        "bytes": path.stat().st_size,
    }
    _write_json(_note(asset), facts)


def _model(asset: Asset) -> Path:
    return cache_folder() / "models" / f"{asset.name}.safetensors"


def _note(asset: Asset) -> Path:
    return cache_folder() / "models" / f"{asset.name}.json"


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write_json(path: Path, value: object) -> None:
    """Writes JSON so that the file is at no moment half there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, sort_keys=True) + "\n", encoding="utf-8")
