"""Which projected Gaussians each tile of an image meets, in depth order: plain torch, on any device.

What ``reference.py`` finds by asking every Gaussian at every tile comes out of one stable sort here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from jaxtyping import Int32
    from torch import Tensor

    from toonifygb.render.reference import Projected
    from toonifygb.structures import Camera


@dataclass(frozen=True)
class TileLists:
    """The lists of all tiles behind one another, row by row."""

    gaussians: Int32[Tensor, " e"]
    """Entries: places in ``Projected``, front to back within a tile."""
    starts: Int32[Tensor, " t+1"]
    """First entry of each tile, and behind them the number of entries."""
    slots: Int32[Tensor, " e"]
    """Number of each entry when all are ordered by Gaussian: the entries of one Gaussian are consecutive there."""
    slot_starts: Int32[Tensor, " m+1"]
    """First such number of each Gaussian, and behind them the number of entries."""
    columns: int
    """Tiles in a row."""
    rows: int

    @property
    def n_tiles(self) -> int:
        """Number of tiles."""
        return self.columns * self.rows


def tile_lists(projected: Projected, camera: Camera, tile: int) -> TileLists:
    """Lists of all tiles of ``tile`` px."""
    columns, rows = -(-camera.width // tile), -(-camera.height // tile)
    rectangles = projected.rectangles
    left, top, right, bottom = rectangles.unbind(-1)
    counts = (right - left) * (bottom - top)
    slot_starts = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    n_entries = int(slot_starts[-1])
    device = rectangles.device
    gaussians = torch.repeat_interleave(torch.arange(len(counts), device=device), counts, output_size=n_entries)
    within = torch.arange(n_entries, device=device) - slot_starts[gaussians]
    wide = (right - left)[gaussians]
    tiles = (top[gaussians] + within // wide) * columns + left[gaussians] + within % wide
    # Gaussians come in depth order, and the sort is stable: each tile's list is in depth order too.
    ordered, slots = torch.sort(tiles.int(), stable=True)
    starts = torch.searchsorted(ordered, torch.arange(columns * rows + 1, device=device, dtype=torch.int32))
    return TileLists(gaussians[slots].int(), starts.int(), slots.int(), slot_starts.int(), columns, rows)
