"""A device that is not there: tensors that compute on the processor, but refuse to meet others that are not on it.

The type ``meta`` stands for the GPU. What a real one would refuse is refused: operations on tensors of two devices
(but for single numbers and indices, which may stay on the processor), and looking at its memory with numpy.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("meta")
INDEXING = ("aten.index.Tensor", "aten.index_put", "aten._index_put_impl")


class OnDevice(torch.Tensor):
    """A tensor of the pretended device; ``inner`` holds its numbers."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> OnDevice:
        made = torch.Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=DEVICE, requires_grad=False,
        )  # fmt: skip
        made.inner = inner
        return made

    def new_tensor(self, data: Any, **options: Any) -> torch.Tensor:  # type: ignore[override]
        """Numbers from Python, which torch would copy to the device without asking anybody."""
        return _tensor(data, dtype=options.get("dtype", self.dtype)).to(DEVICE)

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(function, args, kwargs or {})


def run(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """One operation, on the numbers inside."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    ours = [tensor for tensor in tensors if isinstance(tensor, OnDevice)]
    name, wanted = str(function), kwargs.get("device")
    assert not any(t.device == DEVICE for t in tensors if not isinstance(t, OnDevice)), f"{name}: numbers got lost"
    copies = name.startswith(("aten._to_copy", "aten.copy_"))
    if ours and not copies and not name.startswith(INDEXING):
        strangers = [t for t in tensors if not isinstance(t, OnDevice) and t.ndim > 0]
        assert not strangers, f"{name} of tensors on {DEVICE} and of {[tuple(t.shape) for t in strangers]} on cpu"
    if wanted is not None:
        kwargs = kwargs | {"device": torch.device("cpu")}
    plain = tree_map(lambda leaf: leaf.inner if isinstance(leaf, OnDevice) else leaf, (args, kwargs))
    result = function(*plain[0], **plain[1])
    stays = torch.device(wanted) == DEVICE if wanted is not None else bool(ours)
    if name.startswith("aten.copy_"):
        stays = isinstance(args[0], OnDevice)
    if not stays:
        return result.clone() if copies and wanted is not None else result
    # What is changed in place comes back as the tensor it was.
    known = {id(tensor.inner): tensor for tensor in ours}

    def wrapped(leaf: Any) -> Any:
        if not isinstance(leaf, torch.Tensor):
            return leaf
        return known[id(leaf)] if id(leaf) in known else OnDevice(leaf)

    return tree_map(wrapped, result)


_tensor = torch.tensor


def tensor(data: Any, *, device: Any = None, **options: Any) -> torch.Tensor:
    """``torch.tensor``, for the same reason as ``OnDevice.new_tensor``; to be put in its place."""
    made = _tensor(data, **options)
    return made if device is None else made.to(device)


class PretendGpu(TorchDispatchMode):
    """While this is active, ``torch.device("meta")`` computes."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        leaves = tree_leaves((args, kwargs))
        if kwargs.get("device") is not None or any(isinstance(leaf, OnDevice) for leaf in leaves):
            return run(function, args, kwargs)
        return function(*args, **kwargs)
