"""Styles from a file: image-to-image networks as ONNX or TorchScript, described by a small text beside them.

``toon.onnx`` (or ``toon.ts``, ``toon.torchscript``) needs ``toon.json`` or ``toon.toml`` with what the file itself
does not say:

    {"range": "-1..1", "layout": "NCHW", "channels": "RGB", "multiple": 32, "max_side": 1024}

ONNX runs in onnxruntime, an optional extra of the package. TorchScript runs in torch; ``torch.jit.load`` restores
a graph of TorchScript operators and its weights and does not unpickle Python objects, but the graph is still a
program: like any program, take it only from people you trust.
"""

from __future__ import annotations

import dataclasses
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_type_hints

import cv2
import numpy as np
import torch

from toonifygb.errors import BackendError, InputError
from toonifygb.stylize.exaggerate import Exaggeration
from toonifygb.stylize.filters import resize

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, UInt8

    from toonifygb.stylize.anchors import Faces

    Frames = UInt8[np.ndarray, "t h w 3"]
    Frame = UInt8[np.ndarray, "h w 3"]
    Runner = Callable[[np.ndarray], np.ndarray]

ONNX, TORCHSCRIPT = (".onnx",), (".ts", ".torchscript")
OTHER_WEIGHTS = (".pt", ".pth", ".ckpt", ".safetensors", ".pkl", ".h5", ".pb", ".tflite")
"""Files people have that hold weights without the network, or a network for something else."""
RANGES = {"-1..1": (127.5, 1.0), "0..1": (255.0, 0.0), "0..255": (1.0, 0.0)}
"""Range of a network's values: bytes = (values + shift) * scale."""
_EXAMPLE = '{"range": "-1..1", "layout": "NCHW", "multiple": 32}'


@dataclass(frozen=True)
class ModelRules:
    """What a network expects and gives; the keys of the text beside it."""

    range: Literal["-1..1", "0..1", "0..255"]
    """Values of black and white, in the input and the output."""
    layout: Literal["NCHW", "NHWC"]
    """Order of the axes."""
    channels: Literal["RGB", "BGR"] = "RGB"
    size: tuple[int, int] | None = None
    """Height and width of the input, when the network takes only one size."""
    multiple: int = 1
    """What both sides of the input must be multiples of, when it takes any size."""
    max_side: int | None = None
    """Longest side of the input, px; larger frames are made smaller."""


def is_model_file(name: str) -> bool:
    """Whether a style's name is that of a file with weights, usable or not."""
    return Path(name).suffix.lower() in (*ONNX, *TORCHSCRIPT, *OTHER_WEIGHTS)


def model_files(path: Path) -> tuple[Path, ...]:
    """The model and the text that describes it."""
    return path, _sidecar(path)


def open_model(path: Path) -> ModelStylizer:
    """The style of a model file; the network is read at its first use.

    Raises:
        InputError: no such file, of another kind, or not described.
    """
    if path.suffix.lower() not in (*ONNX, *TORCHSCRIPT):
        raise InputError(
            f"style file {path} is of a kind that does not hold a runnable network; "
            "expected .onnx, .ts or .torchscript",
            "export the network with torch.onnx.export or torch.jit.trace",
        )
    if not path.is_file():
        raise InputError(f"style file {path} does not exist", "check the path")
    return ModelStylizer(path, read_rules(_sidecar(path)))


def read_rules(path: Path) -> ModelRules:
    """The description of a model.

    Raises:
        InputError: a missing file, an unknown key, or a value of the wrong kind.
    """
    try:
        text = path.read_text(encoding="utf-8")
        values = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except OSError as error:
        raise InputError(
            f"{path} is missing; a model needs it to say what images it takes", f"write it, for instance {_EXAMPLE}"
        ) from error
    except ValueError as error:
        raise InputError(f"{path} cannot be read ({error})", f"write it like {_EXAMPLE}") from error
    if not isinstance(values, dict):
        raise InputError(f"{path} holds no names with values", f"write it like {_EXAMPLE}")
    hints = get_type_hints(ModelRules)
    required = {field.name for field in dataclasses.fields(ModelRules) if field.default is dataclasses.MISSING}
    unknown, missing = sorted(set(values) - set(hints)), sorted(required - set(values))
    if unknown or missing:
        wrong = f"has unknown keys {', '.join(unknown)}" if unknown else f"does not say {' and '.join(missing)}"
        raise InputError(f"{path} {wrong}; keys are {', '.join(hints)}", f"write it like {_EXAMPLE}")
    return ModelRules(**{key: _checked(path, key, value, hints[key]) for key, value in values.items()})


class ModelStylizer:
    """Whole frames through somebody's network.

    Args:
        path: the model file.
        rules: what it expects and gives.
    """

    exaggeration = Exaggeration()
    denoise = True

    def __init__(self, path: Path, rules: ModelRules) -> None:
        self.name = path.stem
        self.description = f"the network in {path.name}"
        self._path, self._rules = path, rules
        self._runner: Runner | None = None

    def prepare(self, samples: Frames, faces: Faces) -> dict[str, Any]:
        """Nothing is shared."""
        return {}

    def apply(self, frames: Frames, faces: Faces, mattes: Any, state: dict[str, Any]) -> Frames:
        """The frames through the network, one by one, brought back to their size.

        Raises:
            InputError: the file is damaged, or the network does not take or give what its description says.
            BackendError: onnxruntime is not installed.
        """
        if self._runner is None:
            self._runner = _open_runner(self._path)
        return np.stack([self._draw(frame, self._runner) for frame in frames])

    def _draw(self, frame: Frame, runner: Runner) -> Frame:
        image, shown = fitted(frame, self._rules)
        output = runner(to_model(image, self._rules))
        drawn = from_model(output, self._rules, self._path.name)
        rows, columns = (
            side * out / given for side, out, given in zip(shown, drawn.shape, image.shape, strict=False)
        )
        covered = drawn[: max(1, round(rows)), : max(1, round(columns))]
        return resize(np.ascontiguousarray(covered), frame.shape[1], frame.shape[0])


def fitted(frame: Frame, rules: ModelRules) -> tuple[Frame, tuple[int, int]]:
    """The frame at a size the network takes, and how much of that is frame.

    The frame keeps its proportions; what is missing to the right and below is its mirror image.

    Returns:
        the image, and the height and width in it that show the frame.
    """
    height, width = frame.shape[:2]
    if rules.size is not None:
        scale = min(rules.size[0] / height, rules.size[1] / width)
    else:
        scale = min(1.0, (rules.max_side or max(height, width)) / max(height, width))
    shown = max(1, round(height * scale)), max(1, round(width * scale))
    small = resize(frame, shown[1], shown[0])
    wanted = rules.size or tuple(-(-side // rules.multiple) * rules.multiple for side in shown)
    below, beside = wanted[0] - shown[0], wanted[1] - shown[1]
    return cv2.copyMakeBorder(small, 0, below, 0, beside, cv2.BORDER_REFLECT), shown


def to_model(image: Frame, rules: ModelRules) -> Float[np.ndarray, "1 a b c"]:
    """Bytes as the network wants them, with a batch axis."""
    scale, shift = RANGES[rules.range]
    values = image[..., ::-1] if rules.channels == "BGR" else image
    values = values.astype(np.float32) / np.float32(scale) - np.float32(shift)
    return np.ascontiguousarray((values.transpose(2, 0, 1) if rules.layout == "NCHW" else values)[None])


def from_model(output: np.ndarray, rules: ModelRules, name: str) -> Frame:
    """The network's output as bytes, rounded to nearest.

    Raises:
        InputError: it is not one picture of three channels in the described layout, or not a number.
    """
    channel_axis = 1 if rules.layout == "NCHW" else 3
    if output.ndim != 4 or output.shape[0] != 1 or output.shape[channel_axis] != 3:
        raise InputError(
            f"{name} gave an output of shape {list(output.shape)}; expected one {rules.layout} image of 3 channels",
            "correct 'layout' in its description, or use an image-to-image network",
        )
    values = output[0].astype(np.float32)
    if not np.isfinite(values).all():
        raise InputError(f"{name} gave values that are not numbers", "check 'range' in its description")
    scale, shift = RANGES[rules.range]
    picture = values.transpose(1, 2, 0) if rules.layout == "NCHW" else values
    picture = picture[..., ::-1] if rules.channels == "BGR" else picture
    return np.clip(np.rint((picture + shift) * scale), 0, 255).astype(np.uint8)


def _sidecar(path: Path) -> Path:
    """The text beside a model: TOML where there is one, else JSON."""
    toml = path.with_suffix(".toml")
    return toml if toml.exists() else path.with_suffix(".json")


def _checked(path: Path, key: str, value: Any, kind: Any) -> Any:
    """A described value, converted to its kind."""
    choices = get_args(kind)
    if isinstance(choices[0] if choices else None, str):
        if value in choices:
            return value
        expected = " or ".join(choices)
    elif key == "size":
        if isinstance(value, list) and len(value) == 2 and all(_is_length(side) for side in value):
            return tuple(value)
        expected = "[height, width] in px"
    else:
        if _is_length(value):
            return value
        expected = "a whole number above 0"
    raise InputError(f"{path} says {key} = {json.dumps(value)}; expected {expected}", f"write it like {_EXAMPLE}")


def _is_length(value: Any) -> bool:
    return type(value) is int and value > 0


def _open_runner(path: Path) -> Runner:
    return _open_onnx(path) if path.suffix.lower() in ONNX else _open_torchscript(path)


def _open_onnx(path: Path) -> Runner:
    """The network in onnxruntime, on the CPU, with as many threads as torch."""
    try:
        import onnxruntime
    except ImportError as error:
        raise BackendError(
            f"{path.name} is an ONNX model and onnxruntime is not installed",
            "install it with: pip install 'toonifygb[onnx]'",
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors share no base class but this
        raise InputError(f"{path} is no ONNX model that onnxruntime can run ({_first_line(error)})") from error
    given = session.get_inputs()
    if len(given) != 1:
        raise InputError(f"{path} takes {len(given)} inputs; expected one image", "use an image-to-image network")
    kinds = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
    if given[0].type not in kinds:
        raise InputError(f"{path} takes {given[0].type}; expected tensor(float) or tensor(float16)")

    def run(image: np.ndarray) -> np.ndarray:
        try:
            return np.asarray(session.run(None, {given[0].name: image.astype(kinds[given[0].type])})[0])
        except Exception as error:
            raise _refused(path, image, error) from error

    return run


def _open_torchscript(path: Path) -> Runner:
    """The network in torch, on the CPU."""
    try:
        module = torch.jit.load(str(path), map_location="cpu").eval()
    except RuntimeError as error:
        raise InputError(
            f"{path} is no TorchScript file ({_first_line(error)})", "save it with torch.jit.trace(...).save"
        ) from error

    def run(image: np.ndarray) -> np.ndarray:
        try:
            with torch.inference_mode():
                output = module(torch.from_numpy(image))
        except RuntimeError as error:
            raise _refused(path, image, error) from error
        if not isinstance(output, torch.Tensor):
            raise InputError(f"{path} gave a {type(output).__name__}; expected one tensor")
        return output.float().numpy()

    return run


def _refused(path: Path, image: np.ndarray, error: Exception) -> InputError:
    return InputError(
        f"{path.name} does not take an image of shape {list(image.shape)} ({_first_line(error)})",
        "correct 'size', 'multiple' or 'layout' in its description",
    )


def _first_line(error: Exception) -> str:
    """The part of a library's message that says what happened."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:160] if lines else type(error).__name__
