"""A small network with the interface of StyleGANEX: a colour map, an enlargement, codes from the face's colours."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F

COLORS = torch.tensor([[0.9, 0.3, -0.1], [-0.1, 0.8, 0.1], [0.2, -0.1, 1.1]])
SHIFT = torch.tensor([0.15, -0.05, 0.25])


class FakeNetwork(torch.nn.Module):
    """Deterministic; ``faces`` counts the aligned faces it was asked about."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("latent_avg", torch.full((18, 512), 0.25))
        self.register_buffer("editing_w", torch.zeros(0, 18, 512))
        self.faces = 0

    def codes(self, x2: torch.Tensor) -> torch.Tensor:
        assert x2.shape[1:] == (3, 256, 256), x2.shape
        assert x2.min() >= -1 and x2.max() <= 1
        self.faces += len(x2)
        spots = F.adaptive_avg_pool2d(x2, (16, 16)).flatten(1)[:, :512]
        return spots[:, None].repeat(1, 18, 1)


def compile_clip(
    network: FakeNetwork, w_plus: torch.Tensor, *, dtype: torch.dtype, levels: int = 8
) -> Callable[[torch.Tensor], torch.Tensor]:
    """A network whose last colour follows the codes."""
    assert tuple(w_plus.shape) == (1, 18, 512)
    shift = SHIFT + torch.stack([w_plus[0, 0, :64].mean(), w_plus[0, 17, :64].mean(), w_plus.new_zeros(())]) * 0.1

    def run(x1: torch.Tensor) -> torch.Tensor:
        assert x1.shape[2] % 8 == x1.shape[3] % 8 == 0
        large = F.interpolate(x1, scale_factor=2 ** (levels - 6), mode="bilinear", align_corners=False)
        return torch.einsum("ij,njhw->nihw", COLORS, large) + shift[:, None, None]

    return run
