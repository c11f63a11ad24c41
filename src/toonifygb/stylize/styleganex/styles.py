"""The styles that StyleGANEX's published weights make, by name."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from toonifygb.assets import manifest, store
from toonifygb.errors import AssetError, InputError
from toonifygb.stylize.styleganex.aligned import AlignedStylizer
from toonifygb.stylize.styleganex.engine import Engine
from toonifygb.stylize.styleganex.fast import compile_clip
from toonifygb.stylize.styleganex.stylizer import StyleganexStylizer
from toonifygb.stylize.styleganex.weights import load

if TYPE_CHECKING:
    from pathlib import Path

    from toonifygb.config import StyleganexConfig
    from toonifygb.stylize.base import Stylizer

STYLES = {
    "arcane": "faces in the painted manner of the series Arcane",
    "cartoon": "faces as in a drawn comic",
    "pixar": "faces as in an animated film of Pixar",
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
    engine = Engine(partial(load, path), compile_clip, config)
    kind = AlignedStylizer if config.framing == "aligned" else StyleganexStylizer
    return kind(name, STYLES[name], engine)


def _asset(name: str) -> str:
    return f"styleganex-{name}"
