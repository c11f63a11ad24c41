"""Colours of Gaussians that no training view shows."""

from __future__ import annotations

import torch

from toonifygb.train.views import _nearest_colors


def test_unseen_points_take_the_nearest_colour_of_either_side() -> None:
    known = torch.tensor([[0.08, 0.0, 0.0], [0.0, 0.1, 0.05]])
    colors = torch.tensor([[0.9, 0.1, 0.1], [0.2, 0.2, 0.7]])
    points = torch.tensor([[0.079, 0.0, 0.01], [-0.081, 0.0, 0.0], [0.0, 0.12, -0.05]])
    expected = colors[[0, 0, 1]]
    torch.testing.assert_close(_nearest_colors(points, known, colors), expected)


def test_many_points_agree_with_one_by_one() -> None:
    known, colors, points = torch.randn(40, 3), torch.rand(40, 3), torch.randn(700, 3)
    together = _nearest_colors(points, known, colors)
    alone = torch.cat([_nearest_colors(point[None], known, colors) for point in points])
    assert torch.equal(together, alone)
