"""Weights on disk: our safetensors files, and how the authors' checkpoints become such files.

A file holds the state dict, ``latent_avg``, for edit networks ``editing_w``, and in its metadata the format's name
and version, the variant as JSON, and the levels it was trained with where these are not all. Nothing is ever
skipped in silence: a missing or surplus key is an error.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, fields, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from toonifygb.assets import convert
from toonifygb.assets.convert import Checkpoint, StoredTensor
from toonifygb.atomic import replacing
from toonifygb.errors import AssetError
from toonifygb.progress import SILENT
from toonifygb.stylize.styleganex.generator import N_LEVELS
from toonifygb.stylize.styleganex.layers import binomial_kernel, fir_kernel
from toonifygb.stylize.styleganex.network import StyleGANEX
from toonifygb.stylize.styleganex.variants import N_CODES, STYLE_WIDTH, Variant, infer_variant

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path

    from torch import Tensor

    from toonifygb.progress import Progress

FORMAT, VERSION = "toonifygb-styleganex", "1"
OPTIONAL = (
    r".*\.blur_weight",
    r".*\.(blur|upsample)\.kernel",
    r".*\.num_batches_tracked",
    r"decoder\.noises\.noise_\d+",
    r"decoder\.style\.\d+\.(weight|bias)",
    r"decoder\.input\.input",
    r"encoder\.skiplayer\.(weight|bias)",
)
"""Keys that may be missing: constants of the definition, and parts that turn no image into another.

Filters get their defined values. Noise maps become noise from a fixed seed; mapping network, learnt constant and
skip layer become zero: without them images can be stylised but none can be drawn from random codes.
"""
_OPTIONAL = re.compile("|".join(OPTIONAL))
_NEWER = "use a file of the StyleGANEX authors (styleganex_*.pt), added with: toonifygb assets add"
_LISTED = 6
"""Keys named in a message before it says how many more there are."""


def load(path: Path) -> StyleGANEX:
    """The trained network stored at ``path``, on the CPU in float32, without gradients.

    Raises:
        AssetError: the file is absent or damaged, or its tensors are not exactly those of its variant.
    """
    if not path.is_file():
        raise AssetError(f"the StyleGANEX weights {path} do not exist", "see: toonifygb assets list")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            variant = _read_variant(metadata, path)
            tensors = {key: file.get_tensor(key) for key in file.keys()}
    except SafetensorError as error:
        raise _damaged(path, error) from error
    latent_avg, editing_w = tensors.pop("latent_avg", None), tensors.pop("editing_w", None)
    if latent_avg is None:
        raise AssetError(f"{path} lacks latent_avg", "convert it again")
    return assembled(variant, tensors, latent_avg, editing_w, path)


def trained_levels(path: Path) -> int:
    """How many levels of the generator stored at ``path`` were trained: 8, or 7 or 6 in styles of one's own.

    Raises:
        AssetError: the file is damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get("levels", str(N_LEVELS))
    except SafetensorError as error:
        raise _damaged(path, error) from error
    if text not in ("6", "7", "8"):
        raise AssetError(f"{path} says it was trained with {text!r} levels; expected 6, 7 or 8", "train it again")
    return int(text)


def save(network: StyleGANEX, path: Path, *, levels: int = N_LEVELS) -> None:
    """Writes a network so that ``load`` gives it back; the file appears when it is complete.

    Args:
        network: to store.
        path: the file.
        levels: of its generator that were trained; ``trained_levels`` gives them back.
    """
    tensors = {key: value.detach().clone().contiguous() for key, value in network.state_dict().items()}
    tensors["latent_avg"] = network.latent_avg.clone()
    if len(network.editing_w):
        tensors["editing_w"] = network.editing_w.clone()
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        save_file(tensors, temporary, _metadata(network.variant, "saved") | {"levels": str(levels)})


def convert_checkpoint(source: Path, target: Path, *, progress: Progress = SILENT) -> None:
    """Turns a checkpoint of the authors (``styleganex_*.pt``) into a file that ``load`` reads.

    Raises:
        AssetError: ``source`` is damaged, holds code, or is not a StyleGANEX.
    """
    convert.convert(source, target, describe, progress=progress)


def describe(checkpoint: Checkpoint) -> tuple[dict[str, StoredTensor], dict[str, str]]:
    """Tensors and metadata of the file that ``load`` reads, from a checkpoint of the authors.

    Options stored with the weights decide what is used, as in the authors' program; a discriminator is left out.

    Raises:
        AssetError: this is not a StyleGANEX, or one trained with options that no published network has.
    """
    path, values = checkpoint.path, checkpoint.values
    state, options = values.get("state_dict"), values.get("opts") or {}
    if not isinstance(state, dict) or not isinstance(options, dict):
        found = ", ".join(sorted(str(key) for key in values)[:_LISTED])
        raise AssetError(f"{path} is no StyleGANEX checkpoint: it holds {found}; expected state_dict, opts", _NEWER)
    if not all(isinstance(key, str) and isinstance(value, StoredTensor) for key, value in state.items()):
        raise AssetError(f"{path}: state_dict holds other things than tensors", _NEWER)
    if options.get("learn_in_w"):
        raise AssetError(f"{path} was trained with learn_in_w, which no published network is", _NEWER)
    tensors = _used(state, options)
    shapes = {key: value.shape for key, value in tensors.items()}
    variant = infer_variant(shapes, max_pooling=bool(options.get("max_pooling", False)))
    check_shapes(shapes, variant, path)
    kept = dict(tensors)
    for name, required in (("latent_avg", True), ("editing_w", False)):
        value = values.get(name)
        if isinstance(value, StoredTensor):
            kept[name] = value
        elif required or value is not None:
            raise AssetError(f"{path} lacks the tensor {name}", _NEWER)
    _check_codes(kept["latent_avg"].shape, variant, path, "latent_avg")
    if "editing_w" in kept:
        _check_codes(kept["editing_w"].shape, variant, path, "editing_w")
    return kept, _metadata(variant, path.name)


def _used(state: Mapping[str, StoredTensor], options: Mapping[str, Any]) -> dict[str, StoredTensor]:
    """The tensors that the authors' program would use under these options."""
    n_fusion = options.get("skip_max_layer", 7) if options.get("use_skip", True) else 0
    if type(n_fusion) is not int:
        raise AssetError(f"the checkpoint's option skip_max_layer is {n_fusion!r}; expected a number", _NEWER)
    fuse_rgb = options.get("use_skip_torgb", True)
    used = {}
    for key, tensor in state.items():
        layer = re.match(r"encoder\.fusion\.(\d+)\.(fusion_skip\.)?", key)
        if layer and (int(layer[1]) >= n_fusion or (layer[2] and not fuse_rgb)):
            continue
        used[key] = tensor
    return used


def check_shapes(shapes: Mapping[str, tuple[int, ...]], variant: Variant, path: Path) -> None:
    """Raises AssetError, naming the keys, unless the shapes are those of the variant (``OPTIONAL`` may lack)."""
    expected = _shapes(variant)
    missing = [key for key in expected if key not in shapes and not _OPTIONAL.fullmatch(key)]
    extra = [key for key in shapes if key not in expected]
    wrong = [
        f"{key} {list(shape)} instead of {list(expected[key])}"
        for key, shape in shapes.items()
        if key in expected and tuple(shape) != expected[key]
    ]
    found = [("lacks", missing), ("has the unknown", extra), ("has of another shape", wrong)]
    faults = [f"{verb} {_listed(keys)}" for verb, keys in found if keys]
    if faults:
        raise AssetError(
            f"{path} is not the StyleGANEX network '{variant.name}': it {'; it '.join(faults)}", _NEWER
        )


@cache
def _shapes(variant: Variant) -> dict[str, tuple[int, ...]]:
    """Shape of every tensor of a variant."""
    with torch.device("meta"):
        return {key: tuple(value.shape) for key, value in StyleGANEX(variant).state_dict().items()}


def assembled(
    variant: Variant, tensors: dict[str, Tensor], latent_avg: Tensor, editing_w: Tensor | None, path: Path
) -> StyleGANEX:
    """The network whose memory these tensors are.

    Args:
        variant: which network.
        tensors: its state dict; what is ``OPTIONAL`` may lack.
        latent_avg: average codes, ``18 512`` or one for all, ``512``.
        editing_w: editing vectors ``k 18 512``, if any.
        path: where they come from, for messages.

    Raises:
        AssetError: a tensor is missing, unknown or of the wrong shape.
    """
    check_shapes({key: tuple(value.shape) for key, value in tensors.items()}, variant, path)
    _check_codes(tuple(latent_avg.shape), variant, path, "latent_avg")
    with torch.device("meta"):
        network = StyleGANEX(variant)
    state = network.state_dict()
    absent = {key: _default(key, value) for key, value in state.items() if key not in tensors}
    network.load_state_dict(
        {key: value.to(state[key].dtype) for key, value in (tensors | absent).items()}, assign=True
    )
    code = variant.channels(STYLE_WIDTH)
    network.latent_avg = latent_avg.float().expand(N_CODES, code).clone()
    if editing_w is None:
        editing_w = torch.zeros(0, N_CODES, code)
    _check_codes(tuple(editing_w.shape), variant, path, "editing_w")
    network.editing_w = editing_w.float()
    return network.requires_grad_(False)


def _default(key: str, like: Tensor) -> Tensor:
    """Value of an ``OPTIONAL`` tensor that a file lacks."""
    if key.endswith(".kernel"):
        return fir_kernel()
    if key.endswith(".blur_weight"):
        return binomial_kernel()
    if key.startswith("decoder.noises."):
        seed = int(key.rpartition("_")[2])
        return torch.randn(like.shape, generator=torch.Generator().manual_seed(seed))
    return torch.zeros(like.shape, dtype=like.dtype)


def _check_codes(shape: Collection[int], variant: Variant, path: Path, name: str) -> None:
    code = variant.channels(STYLE_WIDTH)
    shape = tuple(shape)
    allowed = shape in ((N_CODES, code), (code,)) if name == "latent_avg" else shape[1:] == (N_CODES, code)
    if not allowed:
        expected = [N_CODES, code] if name == "latent_avg" else ["k", N_CODES, code]
        raise AssetError(f"{path}: {name} has shape {list(shape)}; expected {expected}", _NEWER)


def _metadata(variant: Variant, source: str) -> dict[str, str]:
    return {"format": FORMAT, "version": VERSION, "variant": json.dumps(asdict(variant)), "source": source}


def _read_variant(metadata: Mapping[str, str], path: Path) -> Variant:
    """The variant that the metadata name, each field of its own type."""
    if metadata.get("format") != FORMAT or metadata.get("version") != VERSION:
        raise AssetError(
            f"{path} is not of the format {FORMAT} {VERSION}",
            "convert the authors' checkpoint with: toonifygb assets add",
        )
    try:
        given = json.loads(metadata.get("variant", ""))
    except ValueError:
        given = None
    variant = Variant()
    types = {field.name: type(getattr(variant, field.name)) for field in fields(Variant)}
    if not isinstance(given, dict) or {key: type(value) for key, value in given.items()} != types:
        raise AssetError(f"{path} names no variant of StyleGANEX in its metadata", "convert it again")
    return replace(variant, **given)


def _damaged(path: Path, error: Exception) -> AssetError:
    return AssetError(f"{path} is damaged ({error})", "convert or download it again")


def _listed(keys: list[str]) -> str:
    more = f" and {len(keys) - _LISTED} more" if len(keys) > _LISTED else ""
    return ", ".join(keys[:_LISTED]) + more
