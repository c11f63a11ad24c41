"""Stage 1: stylised video."""

from __future__ import annotations

from functools import partial

from toonifygb.stylize.anchors import Faces, follow
from toonifygb.stylize.base import (
    Stylizer,
    WeightedStyle,
    available,
    files,
    get,
    register,
    register_kind,
    register_weighted,
)
from toonifygb.stylize.ink import Ink
from toonifygb.stylize.paint import Paint
from toonifygb.stylize.plain import Plain
from toonifygb.stylize.run import prepare, stylize_frames, warp_frames, warp_landmarks
from toonifygb.stylize.steadiness import warping_error
from toonifygb.stylize.styleganex import styles as _styleganex
from toonifygb.stylize.toon import Toon

for _style in (Toon, Paint, Ink, Plain):
    register(_style.name, _style)
for _name in _styleganex.STYLES:
    register_weighted(
        _name, WeightedStyle(partial(_styleganex.open_style, _name), partial(_styleganex.weights, _name))
    )
register_kind(".safetensors", _styleganex.open_file)

__all__ = [
    "Faces",
    "Stylizer",
    "WeightedStyle",
    "available",
    "files",
    "follow",
    "get",
    "prepare",
    "register",
    "register_kind",
    "register_weighted",
    "stylize_frames",
    "warp_frames",
    "warp_landmarks",
    "warping_error",
]
