"""Styles from model files: tiny networks made here, their descriptions, and every way they can be wrong."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import stylize_scene as scene
import torch

from toonifygb import stylize
from toonifygb.errors import BackendError, InputError
from toonifygb.stylize.plugin import ModelRules, fitted, from_model, read_rules, to_model

WIDTH, HEIGHT = 70, 52


class Negative(torch.nn.Module):
    """Black to white in -1..1."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return -x


class Larger(torch.nn.Module):
    """Twice the size; refuses sides that are no multiples of 16."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = torch.nn.functional.avg_pool2d(x, 16).repeat_interleave(16, 2).repeat_interleave(16, 3)
        return torch.nn.functional.interpolate(x + 0.0 * y, scale_factor=2.0)


def described(path: Path, **rules) -> Path:
    path.with_suffix(".json").write_text(json.dumps({"range": "-1..1", "layout": "NCHW", **rules}))
    return path


def torchscript(folder: Path, module: torch.nn.Module, **rules) -> Path:
    path = folder / "style.ts"
    torch.jit.script(module.eval()).save(str(path))
    return described(path, **rules)


def onnx_negative(folder: Path, shape: list, *, bias: float = 0.0, **rules) -> Path:
    """y = bias - x, with the given input shape (None for any)."""
    onnx = pytest.importorskip("onnx", reason="onnx is not installed; it builds the model")
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed; it runs the model")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    constant = helper.make_tensor("bias", kind, [1], [bias])
    graph = helper.make_graph(
        [helper.make_node("Sub", ["bias", "x"], ["y"])],
        "negative",
        [helper.make_tensor_value_info("x", kind, shape)],
        [helper.make_tensor_value_info("y", kind, shape)],
        [constant],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path = folder / "style.onnx"
    onnx.save(model, str(path))
    return described(path, **rules)


def drawn(path: Path, frames: list[np.ndarray]) -> np.ndarray:
    style = stylize.get(str(path))
    return style.apply(np.stack(frames), stylize.anchors.no_faces(len(frames)), None, {})


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    return scene.frames(2, WIDTH, HEIGHT, noise=3)


def test_torchscript(tmp_path: Path, frames: list[np.ndarray]) -> None:
    assert np.array_equal(drawn(torchscript(tmp_path, Negative()), frames), 255 - np.stack(frames))


@pytest.mark.parametrize(
    ("shape", "bias", "rules"),
    [
        (["n", 3, "h", "w"], 0.0, {}),
        (["n", "h", "w", 3], 255.0, {"range": "0..255", "layout": "NHWC", "channels": "BGR"}),
        (["n", 3, "h", "w"], 1.0, {"range": "0..1", "multiple": 32}),
    ],
)
def test_onnx(shape: list, bias: float, rules: dict, tmp_path: Path, frames: list[np.ndarray]) -> None:
    path = onnx_negative(tmp_path, shape, bias=bias, **rules)
    assert np.abs(drawn(path, frames).astype(int) - (255 - np.stack(frames))).max() <= 1


def test_a_fixed_size_keeps_proportions(tmp_path: Path, frames: list[np.ndarray]) -> None:
    path = onnx_negative(tmp_path, [1, 3, 104, 160], size=[104, 160])
    out = drawn(path, frames)
    assert out.shape == (2, HEIGHT, WIDTH, 3)
    assert np.abs(out.astype(float) - (255.0 - np.stack(frames))).mean() < 2  # enlarged twice and back


def test_larger_outputs_come_back_to_size(tmp_path: Path, frames: list[np.ndarray]) -> None:
    path = torchscript(tmp_path, Larger(), multiple=16)
    assert np.abs(drawn(path, frames).astype(float) - np.stack(frames)).max() <= 1
    wrong = described(path, multiple=8)
    wrong.with_suffix(".json").unlink()
    wrong.with_suffix(".toml").write_text('range = "-1..1"\nlayout = "NHWC"\n')
    with pytest.raises(InputError, match="does not take an image of shape"):
        drawn(wrong, frames)


def test_a_style_from_a_file_runs_over_a_clip(tmp_path: Path) -> None:
    marks = scene.landmarks(5, WIDTH, HEIGHT)
    clip = scene.frames(5, WIDTH, HEIGHT, noise=3)
    name = str(torchscript(tmp_path, Negative()))
    style = stylize.get(name)
    state = stylize.prepare(iter(clip), marks, style)
    whole = list(stylize.stylize_frames(iter(clip), marks, style, state))
    late = list(stylize.stylize_frames(iter(clip), marks, stylize.get(name), state, chunk=1, start=2))
    assert all(np.array_equal(a, b) for a, b in zip(whole[2:], late, strict=True))
    assert stylize.files(name) == (tmp_path / "style.ts", tmp_path / "style.json")


@pytest.mark.parametrize("rules", [{"layout": "NHWC", "channels": "BGR", "range": "0..1"}, {"range": "0..255"}, {}])
def test_bytes_survive_the_way_there_and_back(rules: dict, frames: list[np.ndarray]) -> None:
    described_rules = ModelRules(**{"range": "-1..1", "layout": "NCHW", **rules})
    given = to_model(frames[0], described_rules)
    assert given.shape[1 if described_rules.layout == "NCHW" else 3] == 3
    assert np.array_equal(from_model(given, described_rules, "x"), frames[0])


def test_sizes_follow_the_rules() -> None:
    frame = np.zeros((100, 300, 3), np.uint8)
    image, shown = fitted(frame, ModelRules("0..1", "NCHW", multiple=32, max_side=150))
    assert (image.shape[:2], shown) == ((64, 160), (50, 150))
    image, shown = fitted(frame, ModelRules("0..1", "NCHW", size=(256, 256)))
    assert (image.shape[:2], shown) == ((256, 256), (85, 256))


def test_a_toml_description_goes_first(tmp_path: Path) -> None:
    text = 'range = "0..1"\nlayout = "NHWC"\nsize = [64, 96]\n'
    (tmp_path / "a.toml").write_text(text)
    assert read_rules(tmp_path / "a.toml") == ModelRules("0..1", "NHWC", size=(64, 96))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "cannot be read"),
        ("[]", "holds no names"),
        ('{"range": "0..1"}', "does not say layout"),
        ('{"range": "0..2", "layout": "NCHW"}', r"says range = \"0\.\.2\"; expected -1\.\.1 or 0\.\.1"),
        ('{"range": "0..1", "layout": "NCHW", "sise": 3}', "unknown keys sise"),
        ('{"range": "0..1", "layout": "NCHW", "size": 3}', "size = 3; expected \\[height, width\\]"),
        ('{"range": "0..1", "layout": "NCHW", "multiple": 0}', "multiple = 0; expected a whole number above 0"),
        ('{"range": "0..1", "layout": "NCHW", "max_side": true}', "max_side = true; expected a whole number"),
    ],
)
def test_wrong_descriptions_are_explained(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=expected):
        read_rules(tmp_path / "a.json")


def test_files_that_are_no_style_are_explained(tmp_path: Path, frames: list[np.ndarray]) -> None:
    with pytest.raises(InputError, match="does not exist"):
        stylize.get(str(tmp_path / "none.onnx"))
    with pytest.raises(InputError, match=r"expected \.onnx, \.ts or \.torchscript"):
        stylize.get("weights.pth")
    (tmp_path / "bare.ts").write_bytes(b"noise")
    with pytest.raises(InputError, match=r"bare\.json is missing"):
        stylize.get(str(tmp_path / "bare.ts"))
    with pytest.raises(InputError, match="is no TorchScript file"):
        drawn(described(tmp_path / "bare.ts"), frames)
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    (tmp_path / "bare.onnx").write_bytes(b"noise")
    with pytest.raises(InputError, match="is no ONNX model"):
        drawn(described(tmp_path / "bare.onnx"), frames)


def test_outputs_that_are_no_picture_are_explained() -> None:
    rules = ModelRules("0..1", "NCHW")
    with pytest.raises(InputError, match=r"shape \[1, 4, 8, 8\]"):
        from_model(np.zeros((1, 4, 8, 8)), rules, "x")
    with pytest.raises(InputError, match="not numbers"):
        from_model(np.full((1, 3, 8, 8), np.nan), rules, "x")


def test_without_onnxruntime_it_is_said(
    tmp_path: Path, frames: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (tmp_path / "a.onnx").write_bytes(b"")
    with pytest.raises(BackendError, match="onnxruntime is not installed"):
        drawn(described(tmp_path / "a.onnx"), frames)
