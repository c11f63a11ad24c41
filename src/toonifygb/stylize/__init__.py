"""Stage 1: stylised video."""

from __future__ import annotations

from toonifygb.stylize.anchors import Faces, follow
from toonifygb.stylize.base import Stylizer, available, get, register
from toonifygb.stylize.ink import Ink
from toonifygb.stylize.paint import Paint
from toonifygb.stylize.plain import Plain
from toonifygb.stylize.run import prepare, stylize_frames, warp_frames, warp_landmarks
from toonifygb.stylize.toon import Toon

for _style in (Toon, Paint, Ink, Plain):
    register(_style.name, _style)

__all__ = [
    "Faces",
    "Stylizer",
    "available",
    "follow",
    "get",
    "prepare",
    "register",
    "stylize_frames",
    "warp_frames",
    "warp_landmarks",
]
