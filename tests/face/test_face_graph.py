"""Operators of the graph runner against plain definitions, and the shipped networks."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from toonifygb.errors import AssetError
from toonifygb.face.graph import OPERATORS, Graph, load_graph
from toonifygb.face.networks import DATA, SHA256, load_network


def run(ops: list[dict], x: torch.Tensor, weights: dict[str, torch.Tensor] | None = None) -> torch.Tensor:
    description = {"input": "in", "size": [x.shape[-1], x.shape[-2]], "outputs": [ops[-1]["out"]], "ops": ops}
    return Graph(description, weights or {})(x)[0]


def one(name: str, **attributes: object) -> dict:
    return {"op": name, "in": ["in"], "out": "out", **attributes}


def test_conv_pads_asymmetrically_and_clamps() -> None:
    x = torch.arange(16.0).reshape(1, 1, 4, 4)
    op = one("conv", weight="w", bias="b", stride=2, padding=[0, 1, 0, 1], groups=1, activation="relu6")
    result = run([op], x, {"w": torch.ones(1, 1, 3, 3), "b": torch.tensor([-44.0])})
    padded = np.pad(x[0, 0].numpy(), ((0, 1), (0, 1)))
    expected = [[padded[i : i + 3, j : j + 3].sum() - 44 for j in (0, 2)] for i in (0, 2)]
    np.testing.assert_allclose(result[0, 0].numpy(), np.clip(expected, 0, 6))
    assert 0 < result.max() == 6 > result.min()


def test_depth_to_space_follows_tensorflow() -> None:
    x = torch.rand(2, 12, 3, 5)
    result = run([one("depth_to_space", block=2)], x)
    assert result.shape == (2, 3, 6, 10)
    for row, column, channel in ((0, 0, 0), (3, 4, 1), (5, 9, 2)):
        source = ((row % 2) * 2 + column % 2) * 3 + channel
        torch.testing.assert_close(result[:, channel, row, column], x[:, source, row // 2, column // 2])


@pytest.mark.parametrize("half_pixel", [True, False])
def test_resize_samples_where_tensorflow_does(half_pixel: bool) -> None:
    ramp = torch.arange(6.0).expand(1, 1, 4, 6)
    result = run([one("resize", size=[8, 12], half_pixel=half_pixel)], ramp)
    shift = 0.5 if half_pixel else 0.0
    expected = ((torch.arange(12.0) + shift) / 2 - shift).clamp(0, 5)
    torch.testing.assert_close(result[0, 0, 3], expected)


def test_reshape_reads_maps_channels_last() -> None:
    x = torch.rand(1, 6, 2, 3)
    result = run([one("reshape", shape=[12, 3])], x)
    torch.testing.assert_close(result[0], x[0].permute(1, 2, 0).reshape(12, 3))


def box_matrix(points: torch.Tensor, subset: list[int]) -> torch.Tensor:
    op = {"points": subset, "axis": [0, 1], "scale": 1.5, "size": 16}
    return OPERATORS["box_matrix"](None, op, points)


@pytest.mark.parametrize("angle", [0.0, 0.4, -2.0])
def test_box_matrix_frames_turned_points(angle: float) -> None:
    """A 20 × 10 rectangle turned by ``angle`` becomes the inner 2/3 of the crop, upright."""
    turn = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]], dtype=torch.float32)
    rectangle = torch.tensor([[-10.0, 0], [10, 0], [-10, -5], [10, -5], [10, 5], [-10, 5]])
    points = torch.cat([rectangle @ turn.T + torch.tensor([30.0, 20.0]), torch.zeros(6, 1)], 1)[None]
    matrix = box_matrix(points, [2, 3, 4, 5])[0]
    inside = torch.linalg.inv(matrix) @ torch.cat([points[0, :, :2], torch.tensor([[0.0, 1]] * 6)], 1).T
    expected = 8 + rectangle / torch.tensor([20.0, 10.0]) * 16 / 1.5
    torch.testing.assert_close(inside[:2].T, expected, atol=1e-4, rtol=1e-5)


def test_crop_and_transform_are_inverse_views() -> None:
    """Cropping a coordinate map gives the position that ``transform`` assigns to each pixel centre."""
    y, x = torch.meshgrid(torch.arange(20.0) + 0.5, torch.arange(20.0) + 0.5, indexing="ij")
    angle = 0.3
    matrix = torch.eye(4)[None]
    matrix[0, :2, :2] = 0.7 * torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix[0, :2, 3] = torch.tensor([8.0, 5.0])
    cropped = OPERATORS["crop"](None, {"size": [6, 6]}, torch.stack([x, y])[None], matrix)
    v, u = torch.meshgrid(torch.arange(6.0) + 0.5, torch.arange(6.0) + 0.5, indexing="ij")
    positions = OPERATORS["transform"](None, {}, torch.stack([u, v], -1).reshape(1, 36, 2), matrix)
    torch.testing.assert_close(cropped[0].reshape(2, 36).T, positions[0], atol=1e-4, rtol=1e-5)


def test_a_missing_weight_and_an_unknown_operator_are_refused() -> None:
    with pytest.raises(AssetError, match=r"differ.*'w'"):
        run([one("prelu", weight="w")], torch.zeros(1, 1, 2, 2))
    with pytest.raises(AssetError, match="operator 'guess'"):
        run([one("guess")], torch.zeros(1, 1, 2, 2))


def test_absent_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="not installed"):
        load_graph(tmp_path / "none.safetensors")
    save_file({"w": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    with pytest.raises(AssetError, match="no network description"):
        load_graph(tmp_path / "foreign.safetensors")


@pytest.mark.parametrize("name", SHA256)
def test_shipped_files_are_the_recorded_ones(name: str) -> None:
    assert hashlib.sha256((DATA / f"{name}.safetensors").read_bytes()).hexdigest() == SHA256[name]


@pytest.mark.parametrize("name", SHA256)
def test_a_batch_equals_its_items_and_repeats_exactly(name: str) -> None:
    network = load_network(name)
    images = torch.rand(3, 3, network.height, network.width)
    together = network(images)
    for again, first in zip(network(images), together, strict=True):
        assert torch.equal(again, first)
    for i in range(3):
        for single, all_three in zip(network(images[i : i + 1]), together, strict=True):
            scale = max(1.0, float(all_three.abs().max()))
            torch.testing.assert_close(single[0] / scale, all_three[i] / scale, atol=1e-4, rtol=0)


@pytest.fixture(scope="module")
def builder():
    path = Path(__file__).resolve().parents[2] / "tools" / "build_face_weights.py"
    spec = importlib.util.spec_from_file_location("build_face_weights", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_same_padding_puts_the_odd_pixel_behind(builder) -> None:
    assert builder.same_padding(192, 3, 2) == (0, 1)
    assert builder.same_padding(7, 3, 2) == (1, 1)
    assert builder.same_padding(8, 5, 1) == (2, 2)
    assert builder.same_padding(8, 1, 2) == (0, 0)


def test_densify_places_compressed_rows(builder) -> None:
    """A 3 × 4 matrix in CSR: rows (0, 7, 0, 8), (), (9, 0, 0, 0)."""

    class Fields:
        def __init__(self, **values):
            self.values = values

        def vector(self, number, dtype):
            return np.array(self.values[f"f{number}"], dtype)

        def scalar(self, number, code, default=0):
            return self.values.get(f"f{number}", default)

        def table(self, number):
            return self.values[f"f{number}"]

        def tables(self, number):
            return self.values[f"f{number}"]

    rows = Fields(f0=0, f1=3)
    columns = Fields(f0=1, f2=3, f3=Fields(f0=[0, 2, 2, 3]), f4=3, f5=Fields(f0=[1, 3, 0]))
    sparsity = Fields(f0=[0, 1], f1=[], f2=[rows, columns])
    dense = builder.densify(np.array([7, 8, 9], np.float16), [3, 4], sparsity)
    np.testing.assert_array_equal(dense, [[0, 7, 0, 8], [0, 0, 0, 0], [9, 0, 0, 0]])


def test_graph_description_names_every_weight_once() -> None:
    for name in SHA256:
        with safe_open(DATA / f"{name}.safetensors", framework="np") as file:
            ops = json.loads(file.metadata()["graph"])["ops"]
            stored = set(file.keys())
        mentioned = [op[key] for op in ops for key in ("weight", "bias") if key in op]
        assert sorted(mentioned) == sorted(stored)
