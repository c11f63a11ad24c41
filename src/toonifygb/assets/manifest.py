"""The list of model files that can be added: ``manifest.toml`` as frozen records."""

from __future__ import annotations

import difflib
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from toonifygb.errors import InputError

MANIFEST = Path(__file__).with_name("manifest.toml")


@dataclass(frozen=True)
class License:
    """Terms under which a file may be used."""

    key: str
    name: str
    url: str
    summary: str


@dataclass(frozen=True)
class Asset:
    """One file of other people that can be added."""

    name: str
    title: str
    kind: str
    """What it is converted by."""
    file: str
    """Name under which the authors publish it."""
    license: License
    citation: str
    urls: tuple[str, ...]
    """Direct downloads, tried in this order."""
    pages: tuple[str, ...]
    """Where a person finds it."""
    nearest_style: str
    """Built-in style that needs no file and comes closest; empty for other things than styles."""
    nearest_head: str
    """The same for a head model."""
    sign_up: str
    """Where a person registers to be given the file; empty where it can be downloaded."""
    size_bytes: int | None
    """None where nobody has published it."""
    sha256: str | None
    """None where nobody has published it."""

    @property
    def instead(self) -> str:
        """What needs no file, for messages."""
        return (
            f"the style '{self.nearest_style}'" if self.nearest_style else f"the head model '{self.nearest_head}'"
        )

    @property
    def by_hand(self) -> str:
        """How a person who registered adds it, for messages."""
        add = f"toonifygb assets add {self.name} {self.file}"
        return f"register at {self.sign_up}, download {self.file} and run: {add}"


@cache
def manifest() -> dict[str, Asset]:
    """All assets by name."""
    return read_manifest(MANIFEST)


def read_manifest(path: Path) -> dict[str, Asset]:
    """The assets that a manifest lists."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    licenses = {key: License(key=key, **entry) for key, entry in table["licenses"].items()}
    assets = {}
    for name, entry in table["assets"].items():
        work = table["works"][entry["work"]]
        assets[name] = Asset(
            name=name,
            title=entry["title"],
            kind=entry["kind"],
            file=entry["file"],
            license=licenses[entry["license"]],
            citation=work["citation"],
            urls=tuple(entry["urls"]),
            pages=(*entry["pages"], *work["pages"]),
            nearest_style=entry.get("nearest_style", ""),
            nearest_head=entry.get("nearest_head", ""),
            sign_up=entry.get("sign_up", ""),
            size_bytes=entry.get("bytes"),
            sha256=entry.get("sha256"),
        )
    return assets


def find(name: str) -> Asset:
    """The asset of that name.

    Raises:
        InputError: there is none; the nearest name is offered.
    """
    known = manifest()
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
    raise InputError(f"model '{name}' does not exist; available: {', '.join(known)}", f"did you mean '{near}'?")
