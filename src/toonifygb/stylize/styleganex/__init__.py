"""StyleGANEX: the networks, plain and fast, and their weights."""

from __future__ import annotations

from toonifygb.stylize.styleganex.fast import ClipNetwork, compile_clip
from toonifygb.stylize.styleganex.network import StyleGANEX
from toonifygb.stylize.styleganex.variants import PUBLISHED, Variant, infer_variant
from toonifygb.stylize.styleganex.weights import convert_checkpoint, load, save

__all__ = [
    "PUBLISHED",
    "ClipNetwork",
    "StyleGANEX",
    "Variant",
    "compile_clip",
    "convert_checkpoint",
    "infer_variant",
    "load",
    "save",
]
