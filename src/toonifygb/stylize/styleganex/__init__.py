"""StyleGANEX: the networks, plain and fast, and their weights."""

from __future__ import annotations

from toonifygb.stylize.styleganex.network import StyleGANEX
from toonifygb.stylize.styleganex.variants import PUBLISHED, Variant, infer_variant

__all__ = ["PUBLISHED", "StyleGANEX", "Variant", "infer_variant"]
