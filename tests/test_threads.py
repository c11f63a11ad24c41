"""One thread for torch, and the former number afterwards."""

from __future__ import annotations

import pytest
import torch

from toonifygb.threads import one_torch_thread


def test_the_former_number_comes_back_even_after_an_error() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(ValueError, match="inside"), one_torch_thread():
            assert torch.get_num_threads() == 1
            raise ValueError("inside")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
