"""Pictures of what has been learnt so far: the same few faces, before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F

from toonifygb.styletrain.foundation import codes_of, draw, swapped

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8
    from torch import Tensor

    from toonifygb.styletrain.encode import Encode
    from toonifygb.styletrain.transfer import Transfer

N_FACES = 6
SIDE = 256
"""Side of a face in the picture, px."""
TRUNCATION = 0.7
"""Faces are drawn near the average, where they are at their best."""
_GAP, _GROUND = 4, 16
_SEED = 7


@torch.no_grad()
def of_transfer(stage: Transfer) -> UInt8[Tensor, "h w 3"]:
    """Two rows: faces of the base, the same codes in the style (layers swapped as in the result)."""
    config, base = stage.config, stage.base
    average = base.latent_avg
    z = torch.randn(N_FACES, average.shape[1], generator=torch.Generator().manual_seed(_SEED)).to(average)
    codes = codes_of(base.decoder, z, average, TRUNCATION)
    style = swapped(base.decoder, stage.average, config.swap, config.swap_size)
    rows = [
        torch.cat([draw(decoder, code[None], levels=stage.levels, noise="fixed") for code in codes])
        for decoder in (base.decoder, style)
    ]
    return grid(rows)


@torch.no_grad()
def of_encode(stage: Encode) -> UInt8[Tensor, "h w 3"]:
    """Three rows: photographs, their targets, what the network makes of the photographs."""
    # One face at a time, as memory is what a training is short of.
    generator = torch.Generator().manual_seed(_SEED)
    pairs = [stage.pair(1, TRUNCATION, generator) for _ in range(N_FACES)]
    outputs = [stage.network(pair.x, levels=stage.levels) for pair in pairs]
    return grid([torch.cat([pair.x for pair in pairs]), torch.cat([pair.y for pair in pairs]), torch.cat(outputs)])


def grid(rows: list[Float[Tensor, "n 3 s s"]]) -> UInt8[Tensor, "h w 3"]:
    """Rows of pictures in -1..1, each brought to ``SIDE``, as one picture with gaps."""
    n = max(len(row) for row in rows)
    sheet = torch.full((len(rows) * (SIDE + _GAP) + _GAP, n * (SIDE + _GAP) + _GAP, 3), _GROUND, dtype=torch.uint8)
    for r, row in enumerate(rows):
        sized = F.interpolate(row.float().cpu(), (SIDE, SIDE), mode="bilinear", antialias=True)
        cells = ((sized.clamp(-1, 1) + 1) * 127.5).round().byte().permute(0, 2, 3, 1)
        for c, cell in enumerate(cells):
            top, left = _GAP + r * (SIDE + _GAP), _GAP + c * (SIDE + _GAP)
            sheet[top : top + SIDE, left : left + SIDE] = cell
    return sheet
