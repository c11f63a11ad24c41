"""The networks at full width against arrays of the published program, run with weights made by formula.

Every set of arrays in the folder is used: tag, variant, sizes and options come from the ``meta`` beside the arrays.
Filling the weights takes some 15 s and 1.3 GB, so it is done once per tag, and all networks share the memory.
"""

from __future__ import annotations

import gc
import json
import runpy
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from toonifygb.stylize.styleganex import StyleGANEX, Variant, infer_variant
from toonifygb.stylize.styleganex.fast import compile_clip

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from torch import Tensor

pytestmark = pytest.mark.golden
EXACT = 1e-5
"""Largest difference in float32: the published program itself is 3.2e-6 away from float64."""
BF16_DB = 48.0


@dataclass
class Golden:
    """The folder, and networks made from it on demand."""

    folder: Path

    def __post_init__(self) -> None:
        self.formulas = runpy.run_path(str(self.folder / "fill_weights.py"))
        self.tag = ""
        self.weights: dict[tuple[str, tuple[int, ...]], np.ndarray] = {}

    @cached_property
    def shapes(self) -> dict[str, dict[str, list]]:
        """Listings of all variants by name; the first, ``""``, is the complete one."""
        base = json.loads((self.folder / "styleganex_state_dict.json").read_text())
        found = {"": base}
        variants = json.loads((self.folder / "styleganex_state_dict_variants.json").read_text())
        for name, change in variants.items():
            kept = {key: value for key, value in base.items() if key not in change["removed"]}
            found[name] = kept | change["added"] | change["changed"]
        return found

    def sets(self) -> list[tuple[str, dict[str, Any], dict[str, np.ndarray]]]:
        """Name, meta and arrays of every set that a network made."""
        found = []
        for path in sorted(self.folder.glob("*.npz")):
            arrays = dict(np.load(path))
            meta = json.loads(str(arrays.pop("meta")))
            if "config" in meta:
                found.append((path.stem, meta, arrays))
        assert found
        return found

    def network(self, meta: dict[str, Any]) -> StyleGANEX:
        """The variant of a set, with the weights of its tag."""
        if meta["tag"] != self.tag:
            self.weights.clear()
            self.tag = meta["tag"]
        with torch.device("meta"):
            network = StyleGANEX(variant_of(meta["config"]))
        shapes = {key: tuple(tensor.shape) for key, tensor in network.state_dict().items()}
        # A weight depends on tag, key and shape alone, so variants share what they have in common.
        for key, shape in shapes.items() - self.weights.keys():
            self.weights[key, shape] = self.formulas["fill_one"](key, shape, shapes, self.tag)
        weights = {key: torch.from_numpy(self.weights[key, shape]).reshape(shape) for key, shape in shapes.items()}
        network.load_state_dict(weights, assign=True)
        network.latent_avg = torch.from_numpy(self.formulas["fill_latent_avg"](self.tag))
        network.editing_w = torch.zeros(0, 18, 512)
        return network.requires_grad_(False)

    def image(self, place: list[float]) -> Tensor:
        """Input by formula."""
        height, width, phase = place
        return torch.from_numpy(
            self.formulas["to_net"](self.formulas["test_image"](int(height), int(width), phase))
        )

    def edit(self, meta: dict[str, Any]) -> Tensor | None:
        """Editing vector of a set."""
        if "editing_w" not in meta["forward"]:
            return None
        rng = self.formulas["_rng"](meta["tag"], "editing_w")
        return torch.from_numpy((0.3 * rng.standard_normal((1, 18, 512))).astype(np.float32))


def variant_of(config: dict[str, Any]) -> Variant:
    """The variant that the published program builds under these options."""
    n_fusion = config.get("skip_max_layer", 7) if config["use_skip"] else 0
    return Variant(
        input_channels=config.get("input_nc", 3),
        n_fusion=n_fusion,
        fuse_rgb=n_fusion == 0 or config.get("use_skip_torgb", True),
        attention=config.get("use_att", 0) if n_fusion else 0,
        max_pooling=config.get("max_pooling", False),
    )


@pytest.fixture(scope="module")
def golden(golden_dir: Path) -> Iterator[Golden]:
    """The folder; its weights are given back at the end."""
    folder = golden_dir / "styleganex"
    if not (folder / "styleganex_state_dict.json").is_file():
        pytest.skip(f"reference arrays not found at {folder}")
    yield Golden(folder)
    gc.collect()


def run(golden: Golden, network: StyleGANEX, meta: dict[str, Any]) -> Tensor:
    """The plain network on a set's inputs, as ``forward`` does it."""
    noise = "zero" if meta["forward"].get("zero_noise", True) else "fixed"
    x2 = None if meta["x2"] is None else golden.image(meta["x2"])
    with torch.inference_mode():
        return network(golden.image(meta["x1"]), x2, golden.edit(meta), noise=noise)


def pieces(image: Tensor, arrays: dict[str, np.ndarray]) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Stored parts of an image and ours: the whole, or centre, corners and block means."""
    height, width = image.shape[2:]
    rows, columns = slice((height - 256) // 2, (height + 256) // 2), slice((width - 256) // 2, (width + 256) // 2)
    cuts = {
        "image": image,
        "center": image[:, :, rows, columns],
        "tl": image[:, :, :64, :64],
        "tr": image[:, :, :64, -64:],
        "bl": image[:, :, -64:, :64],
        "br": image[:, :, -64:, -64:],
        "mean8": torch.nn.functional.avg_pool2d(image, 8),
    }
    assert set(arrays) <= set(cuts)
    for name, expected in arrays.items():
        yield name, cuts[name], torch.from_numpy(expected)


def decibels(found: Tensor, expected: Tensor) -> float:
    """Peak signal-to-noise ratio of images in -1..1."""
    error = (found.clamp(-1, 1) - expected.clamp(-1, 1)).square().mean().item()
    return 10 * float(np.log10(4 / error))


def test_every_listing_is_a_variant_with_the_same_keys_and_shapes(golden: Golden) -> None:
    for name, listing in golden.shapes.items():
        shapes = {key: tuple(value[0]) for key, value in listing.items()}
        with torch.device("meta"):
            network = StyleGANEX(infer_variant(shapes))
        state = network.state_dict()
        assert {key: tuple(tensor.shape) for key, tensor in state.items()} == shapes, name
        assert {key: str(tensor.dtype).removeprefix("torch.") for key, tensor in state.items()} == {
            key: value[1] for key, value in listing.items()
        }
        assert network.variant.name != "custom"


def test_images(golden: Golden, record_property: pytest.RecordProperty) -> None:
    """The plain network, then the clip network in both precisions, on every set that holds an image."""
    for stem, meta, arrays in golden.sets():
        if not stem.endswith("_image"):
            continue
        network = golden.network(meta)
        image = run(golden, network, meta)
        for name, found, expected in pieces(image, arrays):
            error = (found - expected).abs().max().item()
            record_property(f"{stem}.{name}", error)
            assert error <= EXACT, (stem, name)
        if meta["forward"].get("zero_noise", True):
            check_fast(golden, network, meta, image, stem, record_property)


def check_fast(golden: Golden, network: StyleGANEX, meta, image: Tensor, stem: str, record) -> None:
    """The clip network against the plain image."""
    x1, edit = golden.image(meta["x1"]), golden.edit(meta)
    with torch.inference_mode():
        w_plus = network.codes(x1 if meta["x2"] is None else golden.image(meta["x2"]))
    for dtype in (torch.float32, torch.bfloat16):
        found = compile_clip(network, w_plus, dtype=dtype, edit=edit)(x1)
        worst, level = (found - image).abs().max().item(), decibels(found, image)
        record(f"{stem}.fast.{dtype}", (worst, level))
        if dtype == torch.float32:
            assert worst <= 2 * EXACT, stem
        else:
            assert level >= BF16_DB, stem


def test_codes_and_features(golden: Golden, record_property: pytest.RecordProperty) -> None:
    checked = 0
    for stem, meta, arrays in golden.sets():
        if "wplus" not in arrays:
            continue
        network = golden.network(meta)
        with torch.inference_mode():
            w_plus = network.codes(golden.image(meta["x2"]))
            feature, skips = network.features(golden.image(meta["x1"]))
            found = {
                "wplus": w_plus,
                "codes_x2": w_plus - network.latent_avg,
                "codes_x1": network.encoder.codes(golden.image(meta["x1"])),
                "latent_avg": network.latent_avg,
                "feat_f": feature,
            }
        for index, skip in enumerate(skips):
            found[f"skip{index}_head"] = skip[0, :8, :8, :8]
            found[f"skip{index}_tail"] = skip[0, -8:, -8:, -8:]
        for name, value in found.items():
            error = (value - torch.from_numpy(arrays[name])).abs().max().item()
            record_property(f"{stem}.{name}", error)
            assert error <= EXACT, (stem, name)
            checked += 1
    assert checked


def test_layers(golden: Golden, record_property: pytest.RecordProperty) -> None:
    """Corners of what each layer gives, and mean, deviation and maximum of the whole."""
    for stem, meta, arrays in golden.sets():
        if not stem.endswith("_layers"):
            continue
        network = golden.network(meta)
        seen: dict[str, Tensor] = {}

        def keep(name: str, seen: dict[str, Tensor] = seen):
            def hook(module: torch.nn.Module, inputs: Any, output: Any) -> None:
                seen[name] = output[0] if isinstance(output, tuple) else output

            return hook

        for name in meta["layers"]:
            network.get_submodule(name).register_forward_hook(keep(name))
        run(golden, network, meta)
        for name, stored in arrays.items():
            layer, _, end = name.rpartition(".")
            found = seen[layer][0, :4, :4, :4] if end == "head" else seen[layer][0, -4:, -4:, -4:]
            error = (found - torch.from_numpy(stored)).abs().max().item()
            record_property(f"{stem}.{name}", error)
            assert error <= EXACT, (stem, name)
        for name, (mean, deviation, peak) in meta["layers"].items():
            value = seen[name].double()
            statistics = [value.mean().item(), value.std().item(), value.abs().max().item()]
            assert statistics == pytest.approx([mean, deviation, peak], abs=2 * EXACT), name
