"""The styles that StyleGANEX's weights make: the published ones by name, others by their file."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from toonifygb.assets import manifest, store
from toonifygb.errors import AssetError, InputError
from toonifygb.stylize.styleganex.aligned import AlignedStylizer
from toonifygb.stylize.styleganex.engine import Engine
from toonifygb.stylize.styleganex.fast import compile_clip
from toonifygb.stylize.styleganex.stylizer import StyleganexStylizer
from toonifygb.stylize.styleganex.weights import load, trained_levels

if TYPE_CHECKING:
    from pathlib import Path

    from toonifygb.config import StyleganexConfig
    from toonifygb.stylize.base import Stylizer

STYLES = {
    "arcane": "faces in the painted manner of the series Arcane",
    "cartoon": "faces as in a drawn comic",
    "pixar": "faces as in an animated film of Pixar",
    "age": "the same faces, older or younger: see styleganex.edit",
    "hair": "the same faces with hair of another colour: see styleganex.edit",
}
"""What each looks like, in one line; its weights are the asset ``styleganex-<name>``."""


def weights(name: str) -> Path | None:
    """File of a style's weights, if it is there."""
    try:
        return store.model_path(_asset(name))
    except AssetError:
        return None


def open_style(name: str, config: StyleganexConfig) -> Stylizer:
    """The style of that name; its network is read at its first use.

    Raises:
        InputError: its weights are not there, or settings contradict each other.
    """
    asset = _asset(name)
    path = weights(name)
    if path is None:
        nearest = manifest.find(asset).nearest_style
        raise InputError(
            f"style '{name}' needs the model {asset}, which is not here",
            f"get it with: toonifygb assets get {asset}; without one, {nearest!r} comes nearest",
        )
    return _stylizer(name, STYLES[name], path, config)


def open_file(path: Path, config: StyleganexConfig) -> Stylizer:
    """The style in a file of ours, as ``toonifygb style train`` and ``assets get`` write them.

    Raises:
        InputError: no such file, or settings contradict each other.
    """
    if not path.is_file():
        raise InputError(f"style file {path} does not exist", "check the path")
    return _stylizer(path.stem, f"faces in the style of {path.name}", path, config)


def _stylizer(name: str, description: str, path: Path, config: StyleganexConfig) -> Stylizer:
    engine = Engine(partial(load, path), compile_clip, config, trained_levels(path))
    kind = AlignedStylizer if config.framing == "aligned" else StyleganexStylizer
    return kind(name, description, engine)


def _asset(name: str) -> str:
    return f"styleganex-{name}"
