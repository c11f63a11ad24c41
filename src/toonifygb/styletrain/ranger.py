"""Ranger: rectified Adam (Liu et al. 2020) with gradients of zero mean (Yong et al. 2020) and a look ahead (Zhang
et al. 2019). The optimiser StyleGANEX's encoder was trained with.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

LOOK_EVERY, LOOK_SHARE = 6, 0.5
"""Steps between two looks ahead, and how far the slow weights then move to the fast ones."""


class Ranger(torch.optim.RAdam):
    """Every 6th step the weights return half the way to where they were 6 steps ago.

    Args:
        parameters: what is trained.
        rate: learning rate.
    """

    def __init__(self, parameters: Iterable[torch.nn.Parameter], rate: float) -> None:
        super().__init__(parameters, lr=rate, betas=(0.95, 0.999), eps=1e-5)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """One step of all parameters that have a gradient."""
        moved = [p for group in self.param_groups for p in group["params"] if p.grad is not None]
        before = {p: p.clone() for p in moved if "slow" not in self.state[p]}
        for p in moved:
            if p.ndim > 1 and p.grad is not None:
                p.grad.sub_(p.grad.mean(tuple(range(1, p.ndim)), keepdim=True))
        loss = super().step(closure)
        for p in moved:
            state = self.state[p]
            slow = state.setdefault("slow", before.get(p))
            if int(state["step"]) % LOOK_EVERY == 0:
                p.copy_(slow.lerp_(p, LOOK_SHARE))
        return loss
