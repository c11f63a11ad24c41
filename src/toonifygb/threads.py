"""How many threads torch may use."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """One thread for torch inside the block.

    Our matrices and network layers are so small that threads wait for each other longer than they work: on a busy
    machine of two cores the landmark network takes 43 ms of processor time with one thread and over 1000 ms with
    two. Beside the native engine, which has threads of its own, two pools slow each other many times. One thread
    always adds up in the same order.
    """
    import torch  # here, so that this floor can be imported without it

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
