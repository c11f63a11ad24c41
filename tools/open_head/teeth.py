"""Teeth and gums, modelled on the dental arches that MakeHuman hides in its helper geometry.

Each helper arch is a strip of four lines: gum, middle of the crown, biting edge, inner side. A tooth or gum vertex
is a fixed mix of that strip's vertices plus a fixed offset along the arch's normal, so it follows every target.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from open_head.binding import Binding, EdgeFlow, mixed
from open_head.makehuman import MakeHuman

UPPER_WIDTHS = (8.5, 6.6, 7.6, 7.0, 6.8, 10.4, 9.8)
"""Widths of one side's teeth from the midline back, mm; only their proportions count."""
LOWER_WIDTHS = (5.3, 5.8, 6.8, 7.0, 7.1, 11.0, 10.5)
ACROSS = (-1.0, -0.75, -0.3, 0.3, 0.75)
"""Where a tooth's columns stand across its width; the next tooth begins at +1."""
GUM_LINE = 0.50
"""Where gum begins, as a fraction of the strip's height from the biting edge."""
PAPILLA = 0.10
"""How much nearer to the biting edge the gum reaches between two teeth, same unit."""
GROOVE = 0.0009
"""Depth of the groove between two teeth, m."""
EDGE = 0.0014
"""Thickness of the biting edge, m."""
ROUNDING = 0.045
"""How much shorter a tooth is at its corners, fraction of the strip's height."""
GUM_SWELL = 0.0005
"""How far the gum stands out over the teeth, m."""

Weights = dict[int, float]


@dataclass(frozen=True)
class _Column:
    """One station along an arch: the four lines there, the outward normal, and where it stands on its tooth."""

    gum: Weights
    middle: Weights
    edge: Weights
    inner: Weights
    normal: np.ndarray
    across: float

    def outside(self, height: float) -> Weights:
        """Point of the front at a height from the biting edge (0) over the middle (½) to the gum line (1)."""
        if height <= 0.5:
            return mixed((1 - 2 * height, self.edge), (2 * height, self.middle))
        return mixed((2 - 2 * height, self.middle), (2 * height - 1, self.gum))

    def inside(self, height: float) -> Weights:
        """Point of the back from the biting edge (0) to the inner line (½) and on, parallel to the front."""
        if height <= 0.5:
            return mixed((1 - 2 * height, self.edge), (2 * height, self.inner))
        return mixed((1.0, self.inner), (2 * height - 1, self.gum), (1 - 2 * height, self.middle))


def add_teeth(binding: Binding, source: MakeHuman) -> None:
    """Append both rows of teeth with their gums."""
    for jaw, widths in (("upper", UPPER_WIDTHS), ("lower", LOWER_WIDTHS)):
        columns = _columns(source, f"helper-{jaw}-teeth", widths, upper=jaw == "upper")
        _add_crowns(binding, columns, f"teeth_{jaw}", flip=jaw == "upper")
        _add_gums(binding, columns, f"gums_{jaw}", flip=jaw == "lower")


def _add_crowns(binding: Binding, columns: list[_Column], part: str, *, flip: bool) -> None:
    rows: list[list[int]] = []
    # (height, side, offset outwards): up the front from below the gum to the edge, over it, down the back.
    profile = [(0.62, 1, 0.0), (0.3, 1, 0.0), (0.08, 1, 0.0), (0.0, 1, -0.3), (0.0, -1, -1.0), (0.5, -1, 0.0)]
    for height, side, inwards in profile:
        row = []
        for column in columns:
            shorter = ROUNDING * column.across**4 if height < 0.1 else 0.0
            point = column.outside(height + shorter) if side > 0 else column.inside(height + shorter)
            outwards = -side * GROOVE * column.across**4 + inwards * EDGE
            row.append(binding.add(part, point, outwards * column.normal))
        rows.append(row)
    binding.grid(np.array(rows), flip=flip)


def _add_gums(binding: Binding, columns: list[_Column], part: str, *, flip: bool) -> None:
    for side in (1, -1):
        rows: list[list[int]] = []
        for step, swell in ((0.0, 0.1), (0.35, 1.0), (1.0, 0.6)):
            row = []
            for column in columns:
                margin = GUM_LINE - PAPILLA * column.across**2
                height = margin + step * (1.0 - margin)
                point = column.outside(height) if side > 0 else column.inside(min(height, 0.9))
                row.append(binding.add(part, point, side * swell * GUM_SWELL * column.normal))
            rows.append(row)
        binding.grid(np.array(rows), flip=flip == (side > 0))


def _columns(source: MakeHuman, group: str, widths: tuple[float, ...], *, upper: bool) -> list[_Column]:
    """Stations along a helper arch from the subject's right to the left, five per tooth."""
    flow = EdgeFlow(source.quads.of(group))
    x = source.neutral[:, 0]
    middle_ids = [int(i) for i in source.group(group) if abs(x[i]) < 1e-6]
    # Along the strip's section the biting edge is the extreme one; the others follow by distance in front.
    lines = {name: flow.across(i, x) for name, i in _section(source, middle_ids, upper=upper).items()}
    arch = source.neutral[lines["edge"]]
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(arch, axis=0), axis=1))]
    teeth = np.r_[widths[::-1], widths]
    starts = length[-1] * np.r_[0, np.cumsum(teeth)] / teeth.sum()
    columns = []
    for tooth in range(len(teeth)):
        for across in ACROSS:
            at = starts[tooth] + (across + 1) / 2 * (starts[tooth + 1] - starts[tooth])
            columns.append(_column(source, lines, length, at, across))
    columns.append(_column(source, lines, length, starts[-1], 1.0))
    return columns


def _section(source: MakeHuman, middle_ids: list[int], *, upper: bool) -> dict[str, int]:
    """The four midline vertices of an arch by name."""
    up = 1.0 if upper else -1.0
    gum, edge, middle, inner = (-1,) * 4
    by_height = sorted(middle_ids, key=lambda i: up * source.neutral[i, 1])
    edge, gum = by_height[0], by_height[-1]
    rest = sorted(by_height[1:-1], key=lambda i: source.neutral[i, 2])
    inner, middle = rest
    return {"gum": gum, "middle": middle, "edge": edge, "inner": inner}


def _column(
    source: MakeHuman, lines: dict[str, list[int]], length: np.ndarray, at: float, across: float
) -> _Column:
    """Station at arc length ``at``: Catmull-Rom mix of the strip's columns."""
    index = int(np.clip(np.searchsorted(length, at, side="right") - 1, 0, len(length) - 2))
    fraction = (at - length[index]) / (length[index + 1] - length[index])
    shares = _catmull_rom(fraction)
    near = [int(np.clip(index + step, 0, len(length) - 1)) for step in (-1, 0, 1, 2)]

    def on(line: list[int]) -> Weights:
        return mixed(*((share, {line[i]: 1.0}) for share, i in zip(shares, near, strict=True)))

    ahead = source.neutral[lines["edge"][index + 1]] - source.neutral[lines["edge"][index]]
    around = source.neutral[lines["edge"][near[3]]] - source.neutral[lines["edge"][near[0]]]
    tangent = ahead / np.linalg.norm(ahead) + around / np.linalg.norm(around)
    normal = np.array([-tangent[2], 0.0, tangent[0]])
    return _Column(
        on(lines["gum"]),
        on(lines["middle"]),
        on(lines["edge"]),
        on(lines["inner"]),
        normal / np.linalg.norm(normal),
        across,
    )


def _catmull_rom(t: float) -> tuple[float, float, float, float]:
    """Shares of the four control points around a parameter 0..1; they sum to 1."""
    return (
        0.5 * (-t + 2 * t**2 - t**3),
        0.5 * (2 - 5 * t**2 + 3 * t**3),
        0.5 * (t + 4 * t**2 - 3 * t**3),
        0.5 * (-(t**2) + t**3),
    )
