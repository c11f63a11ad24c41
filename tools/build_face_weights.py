"""Rebuilds the face networks shipped in ``toonifygb/face/data`` from the PyPI wheel of MediaPipe 0.10.21.

    python tools/build_face_weights.py                      # downloads the wheel (36 MB) with pip
    python tools/build_face_weights.py --wheel mediapipe-0.10.21-….whl

The wheel is opened as a zip archive; MediaPipe is never imported. Each ``.tflite`` file inside becomes one
``.safetensors`` file: the tensors as float16 (they are float16 in the wheel, so nothing is lost) and, in the
metadata, the operators as a JSON list that ``toonifygb.face.graph`` runs. On the way

* float16 → float32 conversions vanish and sparse weights (``DENSIFY``) become dense ones,
* weights change from TensorFlow's layouts to torch's (``out in h w``),
* ``SAME`` paddings become explicit numbers, and spatial ``PAD`` operators join the convolution behind them.

The output is deterministic; its sha256 sums are printed and must equal ``toonifygb.face.networks.SHA256``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import struct
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

PACKAGE = "mediapipe==0.10.21"
OUTPUT = Path(__file__).resolve().parent.parent / "src/toonifygb/face/data"
MODELS = {
    "detector_near": "mediapipe/modules/face_detection/face_detection_short_range.tflite",
    "detector_far": "mediapipe/modules/face_detection/face_detection_full_range_sparse.tflite",
    "landmarks": "mediapipe/modules/face_landmark/face_landmark_with_attention.tflite",
    "person": "mediapipe/modules/selfie_segmentation/selfie_segmentation.tflite",
}
DTYPES = {0: "<f4", 1: "<f2", 2: "<i4"}
BUILTIN = {
    0: "add",
    1: "mean_pool",
    2: "concat",
    3: "conv",
    4: "depthwise",
    5: "depth_to_space",
    6: "dequantize",
    14: "sigmoid",
    17: "max_pool",
    18: "mul",
    19: "relu",
    22: "reshape",
    23: "resize",
    34: "pad",
    45: "slice",
    54: "prelu",
    117: "hard_swish",
    124: "densify",
}
ACTIVATIONS = {0: None, 1: "relu", 3: "relu6"}


class Table:
    """A flatbuffer table: fields by number, as numbered in TensorFlow's ``schema.fbs``."""

    def __init__(self, data: bytes, position: int) -> None:
        self.data, self.position = data, position
        self.vtable = position - struct.unpack_from("<i", data, position)[0]
        self.n_fields = (struct.unpack_from("<H", data, self.vtable)[0] - 4) // 2

    def _field(self, number: int) -> int:
        if number >= self.n_fields:
            return 0
        offset = struct.unpack_from("<H", self.data, self.vtable + 4 + 2 * number)[0]
        return self.position + offset if offset else 0

    def _follow(self, position: int) -> int:
        return position + struct.unpack_from("<I", self.data, position)[0]

    def scalar(self, number: int, code: str, default: Any = 0) -> Any:
        """A number, read with the ``struct`` code."""
        field = self._field(number)
        return struct.unpack_from("<" + code, self.data, field)[0] if field else default

    def table(self, number: int) -> Table | None:
        """A table within this one."""
        field = self._field(number)
        return Table(self.data, self._follow(field)) if field else None

    def vector(self, number: int, dtype: str) -> np.ndarray:
        """A vector of numbers; empty where absent."""
        field = self._field(number)
        if not field:
            return np.empty(0, dtype)
        start = self._follow(field)
        return np.frombuffer(self.data, dtype, struct.unpack_from("<I", self.data, start)[0], start + 4)

    def tables(self, number: int) -> list[Table]:
        """A vector of tables; empty where absent."""
        field = self._field(number)
        if not field:
            return []
        start = self._follow(field)
        count = struct.unpack_from("<I", self.data, start)[0]
        return [Table(self.data, self._follow(start + 4 + 4 * i)) for i in range(count)]

    def text(self, number: int) -> str:
        """A string; empty where absent."""
        return self.vector(number, "u1").tobytes().decode()


def read_flexbuffer(data: bytes) -> dict[str, Any]:
    """The root map of a flexbuffer whose values are integers, floats and vectors of integers."""

    def number(position: int, width: int, kind: int) -> Any:
        codes = {1: "bhiq", 2: "BHIQ", 3: "?efd"}[kind]
        return struct.unpack_from("<" + codes[width.bit_length() - 1], data, position)[0]

    def unsigned(position: int, width: int) -> int:
        return number(position, width, 2)

    def value(position: int, parent_width: int, packed: int) -> Any:
        kind, width = packed >> 2, 1 << (packed & 3)
        if kind <= 3:  # numbers stored in place: signed, unsigned, float
            return number(position, parent_width, kind)
        start = position - unsigned(position, parent_width)
        if 6 <= kind <= 8:  # the same numbers stored elsewhere
            return number(start, width, kind - 5)
        count = unsigned(start - width, width)
        if kind in (10, 11, 12):  # untyped vector; vectors of signed and unsigned numbers
            kinds = [data[start + count * width + i] if kind == 10 else (kind - 10) << 2 for i in range(count)]
            return [value(start + i * width, width, kinds[i]) for i in range(count)]
        raise ValueError(f"flexbuffer type {kind} is not known here")

    width, packed = data[-1], data[-2]
    position = len(data) - 2 - width
    start, width = position - unsigned(position, width), 1 << (packed & 3)
    count = unsigned(start - width, width)
    keys_at = start - 3 * width
    keys, keys_width = keys_at - unsigned(keys_at, width), unsigned(start - 2 * width, width)
    result = {}
    for i in range(count):
        key = keys + i * keys_width - unsigned(keys + i * keys_width, keys_width)
        name = data[key : data.index(0, key)].decode()
        result[name] = value(start + i * width, width, data[start + count * width + i])
    return result


def densify(values: np.ndarray, shape: list[int], sparsity: Table) -> np.ndarray:
    """Dense array of a sparse one, following TensorFlow Lite's format converter.

    Dimensions are traversed in ``traversal_order``; each is dense (every index present) or compressed (CSR:
    ``segments`` delimit the present ``indices``). Blocked dimensions come last in the traversal.
    """
    order = sparsity.vector(0, "<i4").tolist()
    block_map = sparsity.vector(1, "<i4").tolist()
    levels = sparsity.tables(2)
    sizes = {1: "<i4", 2: "<u2", 3: "u1"}
    prefixes = np.zeros((1, 0), np.int64)  # index tuples of the entries present so far, in storage order
    for level in levels:
        if level.scalar(0, "b") == 0:
            size = level.scalar(1, "i")
            entries = np.tile(np.arange(size), len(prefixes))
            counts = np.full(len(prefixes), size)
        else:
            segments_table, indices_table = level.table(3), level.table(5)
            if segments_table is None or indices_table is None:
                raise ValueError("a compressed dimension lacks its segments or indices")
            segments = segments_table.vector(0, sizes[level.scalar(2, "B")]).astype(np.int64)
            entries = indices_table.vector(0, sizes[level.scalar(4, "B")]).astype(np.int64)
            counts = np.diff(segments)
        prefixes = np.concatenate([np.repeat(prefixes, counts, axis=0), entries[:, None]], axis=1)
    index = np.zeros((len(prefixes), len(shape)), np.int64)
    block_size = {dim: levels[len(shape) + i].scalar(1, "i") for i, dim in enumerate(block_map)}
    for column, dim in enumerate(order):
        if dim < len(shape):
            index[:, dim] += prefixes[:, column] * block_size.get(dim, 1)
        else:
            index[:, block_map[dim - len(shape)]] += prefixes[:, column]
    dense = np.zeros(shape, values.dtype)
    dense[tuple(index.T)] = values[: len(index)]
    return dense


@dataclass
class Operator:
    """One operator of the file: its name, input and output tensor numbers, and options."""

    name: str
    inputs: list[int]
    outputs: list[int]
    options: Table | None
    custom: bytes


class Model:
    """The first subgraph of a ``.tflite`` file."""

    def __init__(self, data: bytes) -> None:
        root = Table(data, struct.unpack_from("<I", data, 0)[0])
        graph = root.tables(2)[0]
        self._tensors, self._buffers = graph.tables(0), root.tables(4)
        self.inputs: list[int] = graph.vector(1, "<i4").tolist()
        self.outputs: list[int] = graph.vector(2, "<i4").tolist()
        codes = root.tables(1)
        self.operators = []
        for op in graph.tables(3):
            code = codes[op.scalar(0, "I")]
            name = code.text(1) or BUILTIN[max(code.scalar(0, "b"), code.scalar(3, "i"))]
            inputs, outputs = (op.vector(field, "<i4").tolist() for field in (1, 2))
            self.operators.append(Operator(name, inputs, outputs, op.table(4), op.vector(5, "u1").tobytes()))

    def shape(self, tensor: int) -> list[int]:
        """Static shape of a tensor, in TensorFlow's order."""
        return self._tensors[tensor].vector(0, "<i4").tolist()

    def constant(self, tensor: int) -> np.ndarray | None:
        """Array stored in the file; ``None`` for tensors computed at run time."""
        entry = self._tensors[tensor]
        raw = self._buffers[entry.scalar(2, "I")].vector(0, "u1").tobytes()
        if not raw:
            return None
        values = np.frombuffer(raw, DTYPES[entry.scalar(1, "b")])
        sparsity = entry.table(6)
        return (
            values.reshape(self.shape(tensor))
            if sparsity is None
            else densify(values, self.shape(tensor), sparsity)
        )


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """TensorFlow's SAME padding before and after an axis."""
    total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
    return total // 2, total - total // 2


class Converter:
    """Walks a model's operators once and collects torch-ready operators and weights."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.constants: dict[int, np.ndarray] = {}
        self.alias: dict[int, int] = {}
        self.pending_pads: dict[int, tuple[int, list[int]]] = {}
        self.ops: list[dict[str, Any]] = []
        self.weights: dict[str, np.ndarray] = {}

    def convert(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """The graph as plain data, and its weights by name."""
        for op in self.model.operators:
            getattr(self, f"_{op.name}".lower())(op)
        (source,) = self.model.inputs
        outputs = [self._name(tensor) for tensor in self.model.outputs]
        height, width = self.model.shape(source)[1:3]
        graph = {"input": self._name(source), "size": [width, height], "outputs": outputs, "ops": self.ops}
        return graph, self.weights

    def _name(self, tensor: int) -> str:
        return str(self.alias.get(tensor, tensor))

    def _constant(self, tensor: int) -> np.ndarray | None:
        return self.constants[tensor] if tensor in self.constants else self.model.constant(tensor)

    def _number(self, tensor: int) -> np.ndarray:
        value = self._constant(tensor)
        if value is None:
            raise ValueError(f"tensor {tensor} was expected to be a constant")
        return value

    def _store(self, array: np.ndarray) -> str:
        half = np.ascontiguousarray(array, np.float16)
        if not np.array_equal(half.astype(np.float32), array.astype(np.float32)):
            raise ValueError("a weight does not fit float16 exactly")
        name = f"w{len(self.weights):03d}"
        self.weights[name] = half
        return name

    def _emit(self, op: Operator, name: str, inputs: list[int], **attributes: Any) -> None:
        ends = {"in": [self._name(i) for i in inputs], "out": self._name(op.outputs[0])}
        self.ops.append({"op": name, **ends, **attributes})

    def _dequantize(self, op: Operator) -> None:
        self.constants[op.outputs[0]] = self._number(op.inputs[0])

    _densify = _dequantize  # the reader has resolved the sparsity already

    def _pad(self, op: Operator) -> None:
        pads = self._number(op.inputs[1]).astype(int)
        if pads[[0, 3]].any():  # channels: the residual of a block that grows
            if pads[:3].any() or pads[3, 0]:
                raise ValueError(f"padding {pads.tolist()} is not known here")
            self._emit(op, "pad_channels", op.inputs[:1], count=int(pads[3, 1]))
        else:
            (top, bottom), (left, right) = pads[1:3].tolist()
            self.pending_pads[op.outputs[0]] = (op.inputs[0], [left, right, top, bottom])

    def _convolve(self, op: Operator, weight: np.ndarray, groups: int) -> None:
        if op.options is None:
            raise ValueError("a convolution lacks its options")
        stride, source = op.options.scalar(1, "i"), op.inputs[0]
        activation = ACTIVATIONS[op.options.scalar(4 if groups > 1 else 3, "b")]
        source, padding = self.pending_pads.get(source, (source, [0, 0, 0, 0]))
        if op.options.scalar(0, "b") == 0:  # SAME
            if any(padding):
                raise ValueError("explicit and SAME padding meet")
            height, width = self.model.shape(source)[1:3]
            padding = [
                *same_padding(width, weight.shape[3], stride),
                *same_padding(height, weight.shape[2], stride),
            ]
        names = {"weight": self._store(weight), "bias": self._store(self._number(op.inputs[2]))}
        self._emit(
            op, "conv", [source], **names, stride=stride, padding=padding, groups=groups, activation=activation
        )

    def _conv(self, op: Operator) -> None:
        self._convolve(op, self._number(op.inputs[1]).transpose(0, 3, 1, 2), 1)

    def _depthwise(self, op: Operator) -> None:
        weight = self._number(op.inputs[1]).transpose(3, 0, 1, 2)
        self._convolve(op, weight, len(weight))

    def _convolution2dtransposebias(self, op: Operator) -> None:
        if struct.unpack("<3i", op.custom)[1:] != (2, 2):
            raise ValueError("only 2 x 2 steps of the transposed convolution are known here")
        weight = self._number(op.inputs[1]).transpose(3, 0, 1, 2)  # out h w in → in out h w
        names = {"weight": self._store(weight), "bias": self._store(self._number(op.inputs[2]))}
        self._emit(op, "upconv", op.inputs[:1], **names, stride=2)

    def _prelu(self, op: Operator) -> None:
        self._emit(op, "prelu", op.inputs[:1], weight=self._store(self._number(op.inputs[1]).reshape(-1)))

    def _binary(self, op: Operator) -> None:
        activation = ACTIVATIONS[op.options.scalar(0, "b")] if op.options else None
        second = self._constant(op.inputs[1])
        if second is None:
            self._emit(op, op.name, op.inputs, activation=activation)
        elif op.name == "mul" and activation is None:
            self._emit(op, "scale", op.inputs[:1], weight=self._store(second))
        else:
            raise ValueError(f"{op.name} with a constant is not known here")

    _add = _mul = _binary

    def _pool(self, op: Operator) -> None:
        if op.options is None:
            raise ValueError("a pooling lacks its options")
        width, height = op.options.scalar(3, "i"), op.options.scalar(4, "i")
        stride = op.options.scalar(1, "i")
        if op.name == "mean_pool" and self.model.shape(op.inputs[0])[1:3] != [height, width]:
            raise ValueError("only a mean over the whole map is known here")
        if op.name == "max_pool" and not width == height == stride == 2:
            raise ValueError("only 2 x 2 maxima are known here")
        self._emit(op, op.name, op.inputs)

    _mean_pool = _max_pool = _pool

    def _pointwise(self, op: Operator) -> None:
        self._emit(op, op.name, op.inputs)

    _relu = _sigmoid = _hard_swish = _pointwise

    def _concat(self, op: Operator) -> None:
        if op.options is None or op.options.scalar(0, "i") != 1 or len(self.model.shape(op.inputs[0])) != 3:
            raise ValueError("only lists of anchors are joined here")
        self._emit(op, "concat", op.inputs)

    def _resize(self, op: Operator) -> None:
        options = op.options
        if options is not None and options.scalar(2, "?"):
            raise ValueError("align_corners is not known here")
        half_pixel = bool(options.scalar(3, "?")) if options is not None else False
        height, width = self._number(op.inputs[1]).tolist()
        self._emit(op, "resize", op.inputs[:1], size=[int(height), int(width)], half_pixel=half_pixel)

    def _depth_to_space(self, op: Operator) -> None:
        if op.options is None:
            raise ValueError("depth_to_space lacks its block size")
        self._emit(op, "depth_to_space", op.inputs, block=op.options.scalar(0, "i"))

    def _reshape(self, op: Operator) -> None:
        shape = self.model.shape(op.outputs[0])
        if len(shape) == 4 and shape[1:3] != [1, 1]:
            raise ValueError("a reshape to a map is not known here")
        self._emit(op, "reshape", op.inputs[:1], shape=shape[-1:] if len(shape) == 4 else shape[1:])

    def _slice(self, op: Operator) -> None:
        if self.model.shape(op.inputs[0]) != self.model.shape(op.outputs[0]):
            raise ValueError("a slice that leaves something out is not known here")
        self.alias[op.outputs[0]] = self.alias.get(op.inputs[0], op.inputs[0])

    def _landmarks2transformmatrix(self, op: Operator) -> None:
        options = read_flexbuffer(op.custom)
        if options["output_width"] != options["output_height"] or options["scale_x"] != options["scale_y"]:
            raise ValueError("only square crops are known here")
        if options["target_rotation_radians"]:
            raise ValueError("only upright crops are known here")
        self._emit(
            op,
            "box_matrix",
            op.inputs,
            points=options["subset_idxs"],
            axis=[options["left_rotation_idx"], options["right_rotation_idx"]],
            scale=options["scale_x"],
            size=options["output_width"],
        )

    def _transformtensorbilinear(self, op: Operator) -> None:
        options = read_flexbuffer(op.custom)
        self._emit(op, "crop", op.inputs, size=[options["output_height"], options["output_width"]])

    def _transformlandmarks(self, op: Operator) -> None:
        self._emit(op, "transform", op.inputs)


def convert_file(data: bytes) -> bytes:
    """The safetensors file of one ``.tflite`` file."""
    graph, weights = Converter(Model(data)).convert()
    return save(weights, metadata={"graph": json.dumps(graph, separators=(",", ":"))})


def find_wheel(wheel: Path | None, scratch: Path) -> Path:
    """The given wheel, or a freshly downloaded one."""
    if wheel is not None:
        return wheel
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--dest", str(scratch), PACKAGE]
    platform = ["--only-binary=:all:", "--python-version=3.11", "--platform=manylinux_2_28_x86_64"]
    subprocess.run(command + platform, check=True)
    return next(scratch.glob("*.whl"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wheel", type=Path, help="wheel of MediaPipe 0.10.21; downloaded when not given")
    parser.add_argument("--out", type=Path, default=OUTPUT, help="folder of the converted files")
    args = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as scratch,
        zipfile.ZipFile(find_wheel(args.wheel, Path(scratch))) as archive,
    ):
        for name, member in MODELS.items():
            converted = convert_file(archive.read(member))
            (args.out / f"{name}.safetensors").write_bytes(converted)
            print(f'    "{name}": "{hashlib.sha256(converted).hexdigest()}",  # {len(converted):,} bytes')


if __name__ == "__main__":
    main()
