"""A small network stored as data: weights and a list of operators, run with torch.

A graph file is a safetensors file. Its tensors are weights in torch's layouts; its metadata holds one JSON object

    {"input": name, "size": [width, height], "outputs": [names], "ops": [{"op": …, "in": […], "out": name, …}]}

Values between operators are feature maps ``(n, c, h, w)`` or lists ``(n, …)``. ``tools/build_face_weights.py``
writes these files; every function below whose name starts with ``_op_`` is one operator and its definition.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from safetensors import safe_open
from torch import nn

from toonifygb.errors import AssetError
from toonifygb.threads import one_torch_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from jaxtyping import Float
    from torch import Tensor

_ACTIVATIONS: dict[str | None, Callable[[Tensor], Tensor]] = {
    None: lambda x: x,
    "relu": F.relu_,
    "relu6": lambda x: F.hardtanh_(x, 0.0, 6.0),
}


class Graph(nn.Module):
    """A network run operator by operator.

    Args:
        description: the JSON object of the file.
        weights: tensors by name; exactly those that the operators mention.
    """

    def __init__(self, description: dict[str, Any], weights: dict[str, Tensor]) -> None:
        super().__init__()
        self.width, self.height = description["size"]
        self._input: str = description["input"]
        self._outputs: list[str] = description["outputs"]
        self.operators = [dict(op) for op in description["ops"]]
        mentioned = {op[key] for op in self.operators for key in ("weight", "bias") if key in op}
        if mentioned != set(weights):
            raise AssetError(
                f"the network's weights differ from its operators in {sorted(mentioned ^ set(weights))}"
            )
        for op in self.operators:
            if op["op"] not in OPERATORS:
                raise AssetError(f"operator '{op['op']}' of the network is not known")
        for name, tensor in weights.items():
            self.register_buffer(name, _fast_layout(tensor.float()))
        self._last_use = _last_uses(self.operators, keep=self._outputs)

    @torch.inference_mode()
    def forward(self, images: Float[Tensor, "n c h w"]) -> tuple[Tensor, ...]:
        """The outputs, in the order of the file, for a batch of inputs of the network's size."""
        with one_torch_thread():
            return self._run(images)

    def _run(self, images: Float[Tensor, "n c h w"]) -> tuple[Tensor, ...]:
        values = {self._input: images.contiguous(memory_format=torch.channels_last)}
        for op, finished in zip(self.operators, self._last_use, strict=True):
            arguments = [values[name] for name in op["in"]]
            values[op["out"]] = OPERATORS[op["op"]](self, op, *arguments)
            for name in finished:
                del values[name]
        return tuple(values[name] for name in self._outputs)

    def weight(self, op: dict[str, Any], key: str = "weight") -> Tensor:
        """Tensor that an operator names."""
        return self._buffers[op[key]]  # type: ignore[return-value]


def load_graph(path: Path) -> Graph:
    """The network stored at ``path``, computing in float32 on the CPU until it is moved.

    Raises:
        AssetError: the file is absent or not a network.
    """
    if not path.is_file():
        raise AssetError(f"the network {path.name} is not installed at {path}", "reinstall toonifygb")
    with safe_open(path, framework="pt") as file:
        description = (file.metadata() or {}).get("graph")
        if description is None:
            raise AssetError(f"{path} holds no network description", "reinstall toonifygb")
        return Graph(json.loads(description), {name: file.get_tensor(name) for name in file.keys()})


def _fast_layout(weight: Tensor) -> Tensor:
    return weight.contiguous(memory_format=torch.channels_last) if weight.ndim == 4 else weight


def _last_uses(ops: list[dict[str, Any]], keep: Iterable[str]) -> list[list[str]]:
    """For each operator, the values nobody reads after it."""
    seen = set(keep)
    result = []
    for op in reversed(ops):
        names = [name for name in dict.fromkeys(op["in"]) if name not in seen]
        seen.update(names)
        result.append(names)
    return result[::-1]


def _op_conv(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    """Convolution, then an activation. Padding is (left, right, top, bottom)."""
    left, right, top, bottom = op["padding"]
    padding = (top, left)
    if (left, top) != (right, bottom):
        x, padding = F.pad(x, op["padding"]), (0, 0)
    y = F.conv2d(x, graph.weight(op), graph.weight(op, "bias"), op["stride"], padding, groups=op["groups"])
    return _ACTIVATIONS[op["activation"]](y)


def _op_upconv(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    """Transposed convolution whose kernel is as wide as its step."""
    return F.conv_transpose2d(x, graph.weight(op), graph.weight(op, "bias"), op["stride"])


def _op_prelu(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    return F.prelu(x, graph.weight(op))


def _op_add(graph: Graph, op: dict[str, Any], x: Tensor, y: Tensor) -> Tensor:
    return _ACTIVATIONS[op["activation"]](x + y)


def _op_mul(graph: Graph, op: dict[str, Any], x: Tensor, y: Tensor) -> Tensor:
    return _ACTIVATIONS[op["activation"]](x * y)


def _op_scale(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    return x * graph.weight(op)


def _op_relu(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    return F.relu(x)


def _op_sigmoid(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    return torch.sigmoid(x)


def _op_hard_swish(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    return F.hardswish(x)


def _op_max_pool(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    return F.max_pool2d(x, 2)


def _op_mean_pool(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    return x.mean((2, 3), keepdim=True)


def _op_pad_channels(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    return F.pad(x, (0, 0, 0, 0, 0, op["count"]))


def _op_concat(graph: Graph, op: dict[str, Any], *parts: Tensor) -> Tensor:
    return torch.cat(parts, 1)


def _op_resize(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    """Bilinear resize; without half pixels, output pixel i samples input position i · input / output."""
    if op["half_pixel"]:
        return F.interpolate(x, op["size"], mode="bilinear", align_corners=False)
    height, width = op["size"]
    ys = torch.arange(height, device=x.device) * (x.shape[2] / height)
    xs = torch.arange(width, device=x.device) * (x.shape[3] / width)
    grid = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1).expand(len(x), -1, -1, -1)
    return _sample(x, grid, padding="border")


def _op_depth_to_space(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    """Channels (row, column, channel) of each pixel spread over a block of pixels."""
    n, _, h, w = x.shape
    block = op["block"]
    parts = x.reshape(n, block, block, -1, h, w)
    return parts.permute(0, 3, 4, 1, 5, 2).reshape(n, -1, h * block, w * block)


def _op_reshape(graph: Graph, op: dict[str, Any], x: Tensor) -> Tensor:
    """Row-major reshape of each item; maps are read pixel by pixel, channels last."""
    if x.ndim == 4:
        x = x.permute(0, 2, 3, 1)
    return x.reshape(len(x), *op["shape"])


def _op_box_matrix(graph: Graph, op: dict[str, Any], points: Tensor) -> Tensor:
    """Affine matrix from a square crop of ``size`` px to the turned bounding box of some landmarks.

    The box is the tightest one around the landmarks ``points`` whose x axis runs from landmark ``axis[0]`` to
    ``axis[1]``, enlarged by ``scale``. The 4 x 4 matrix acts on (x, y, 0, 1).
    """
    xy = points[..., :2]
    along = xy[:, op["axis"][1]] - xy[:, op["axis"][0]]
    x_axis = along / along.norm(dim=-1, keepdim=True)
    y_axis = torch.stack([-x_axis[:, 1], x_axis[:, 0]], -1)
    axes = torch.stack([x_axis, y_axis], -1)  # columns: the box's axes in the image
    turned = xy[:, op["points"]] @ axes
    low, high = turned.amin(1), turned.amax(1)
    extent = (high - low) * op["scale"]
    corner = (low + high - extent) / 2
    matrix = points.new_zeros(len(points), 4, 4)
    matrix[:, :2, :2] = axes * (extent / op["size"])[:, None, :]
    matrix[:, :2, 3] = (axes @ corner[..., None])[..., 0]
    matrix[:, 2, 2] = matrix[:, 3, 3] = 1.0
    return matrix


def _op_crop(graph: Graph, op: dict[str, Any], x: Tensor, matrix: Tensor) -> Tensor:
    """Bilinear crop of a map through an affine matrix between pixel *corners*; zero outside the map."""
    height, width = op["size"]
    ys = torch.arange(height, device=x.device, dtype=x.dtype) + 0.5
    xs = torch.arange(width, device=x.device, dtype=x.dtype) + 0.5
    targets = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1).reshape(-1, 2)
    sources = targets @ matrix[:, :2, :2].mT + matrix[:, None, :2, 3] - 0.5
    return _sample(x, sources.reshape(len(x), height, width, 2), padding="zeros")


def _op_transform(graph: Graph, op: dict[str, Any], points: Tensor, matrix: Tensor) -> Tensor:
    """Points of a crop in the image it was cut from."""
    return points @ matrix[:, :2, :2].mT + matrix[:, None, :2, 3]


def _sample(x: Tensor, positions: Float[Tensor, "n h w 2"], padding: str) -> Tensor:
    """Bilinear samples at (x, y) counted in pixel centres."""
    size = positions.new_tensor([x.shape[3], x.shape[2]])
    grid = (2 * positions + 1) / size - 1
    return F.grid_sample(x, grid.to(x.dtype), mode="bilinear", padding_mode=padding, align_corners=False)


OPERATORS: dict[str, Callable[..., Tensor]] = {
    name.removeprefix("_op_"): function for name, function in list(globals().items()) if name.startswith("_op_")
}
"""Operators by the name they have in graph files."""
