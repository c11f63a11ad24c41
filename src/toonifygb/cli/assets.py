"""``toonifygb assets``: model files of other people, fetched from where they publish them."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from toonifygb.cli.progress import Terminal
from toonifygb.errors import InputError

if TYPE_CHECKING:
    from toonifygb.assets.manifest import Asset
    from toonifygb.assets.store import Importer
    from toonifygb.progress import Progress

_WIDTH = 88


def assets(
    action: Literal["list", "get", "add", "verify"],
    name: str | None = None,
    file: Path | None = None,
    /,
    accept_license: bool = False,
    quiet: bool = False,
) -> None:
    """Model files of other people: list, get (download), add (a file you have), verify.

    toonifygb ships none of them. Each comes from its authors, under their licence, and is converted once without
    running any of the code such files can hold.

    Args:
        action: list shows what there is; get NAME downloads; add NAME FILE converts a file you downloaded; verify
            reads the converted files again, or that of NAME alone.
        name: Which model, as list shows it.
        file: The authors' file, for add.
        accept_license: Agree to the licence that is shown; without it you are asked.
        quiet: Say nothing but errors.
    """
    from toonifygb.assets import store

    if action == "list":
        _print_list()
        return
    if action == "verify":
        names = [name] if name else [entry.asset.name for entry in store.entries() if entry.path]
        for each in names:
            digest = store.verify(each)
            _say(f"{each}: unchanged, sha256 {digest}", quiet)
        if not names:
            _say("no model has been added", quiet)
        return
    if name is None or (action == "add") != (file is not None):
        wanted = "NAME" if action == "get" else "NAME FILE"
        raise InputError(f"'assets {action}' takes {wanted}", "toonifygb assets list shows the names")

    def consent(asset: Asset) -> bool:
        return _consents(asset, accept_license)

    terminal = Terminal(quiet)
    importer = _importer(name, terminal)
    if file is None:
        path = store.get(name, importer, consent, progress=_Late(terminal, f"getting {name}"))
    else:
        path = store.add(name, file, importer, consent)
    _say(f"{name} is ready: {path}", quiet)


def _print_list() -> None:
    from toonifygb.assets import store

    found = store.entries()
    width = max(len(entry.asset.name) for entry in found)
    for entry in found:
        asset = entry.asset
        state = f"{entry.size_bytes / 1e9:.2f} GB here" if entry.size_bytes is not None else "not added"
        checked = "" if asset.sha256 else "; no published checksum"
        print(f"  {asset.name:{width}}  {state:<12} {asset.title} ({asset.license.name}{checked})")
    print(f"\nmodels are kept in {store.cache_folder()}")


class _Late:
    """A stage whose line appears with its first news, and which from then on listens for Ctrl-C."""

    def __init__(self, terminal: Terminal, title: str) -> None:
        self._terminal, self._title = terminal, title
        self._line: Progress | None = None

    def update(self, done: int, total: int | None, **figures: float) -> None:
        """Passes the news on."""
        if self._line is None:
            self._terminal.listen()
            self._line = self._terminal.stage("assets", self._title)
        self._line.update(done, total, **figures)


def _importer(name: str, terminal: Terminal) -> Importer:
    """How an asset's file is converted."""
    from toonifygb.assets.manifest import find

    kind = find(name).kind
    if kind == "flame":
        return _flame_importer(name, terminal)
    if kind != "styleganex":
        raise InputError(f"files of the kind '{kind}' cannot be converted by this version", "update toonifygb")

    def convert(source: Path, target: Path) -> None:
        from toonifygb.stylize.styleganex.weights import convert_checkpoint

        convert_checkpoint(source, target, progress=_Late(terminal, f"converting {name}"))

    return convert


def _flame_importer(name: str, terminal: Terminal) -> Importer:
    def convert(source: Path, target: Path) -> None:
        from toonifygb.head.flame_file import convert_flame

        convert_flame(source, target, name, progress=_Late(terminal, "fitting landmarks to it"))

    return convert


def _consents(asset: Asset, accepted: bool) -> bool:
    """Shows the licence; asks where nobody has agreed on the command line and somebody can be asked."""
    lines = [f"{asset.title} is used under the {asset.license.name} ({asset.license.url}):", ""]
    lines += textwrap.wrap(asset.license.summary, _WIDTH)
    lines += ["", *textwrap.wrap(f"Please cite: {asset.citation}", _WIDTH)]
    if not asset.sha256:
        lines += ["", "Nobody has published a checksum of this file, so the download cannot be compared with one."]
    print("\n".join(lines), file=sys.stderr)
    if accepted:
        return True
    if not sys.stdin.isatty():
        return False
    print("\nDo you agree? Type yes: ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _say(text: str, quiet: bool) -> None:
    if not quiet:
        print(text)
