"""Weights on disk: exact round trips, and every misfit named."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
from typing import TYPE_CHECKING, Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from styleganex_weights import NARROW, make_network

from toonifygb.assets import convert
from toonifygb.errors import AssetError
from toonifygb.stylize.styleganex import PUBLISHED, Variant, weights

if TYPE_CHECKING:
    from pathlib import Path

    from toonifygb.stylize.styleganex import StyleGANEX

OPTIONS = {"use_skip": True, "use_skip_torgb": True, "skip_max_layer": 7, "use_att": 0, "input_nc": 3}


@pytest.fixture(scope="module")
def network() -> StyleGANEX:
    """A narrow toonify network."""
    return make_network(dataclasses.replace(PUBLISHED["toonify"], width=NARROW))


def checkpoint(network: StyleGANEX, path: Path, **changes: Any) -> Path:
    """A file as the authors write it, with top-level entries changed, or left out where None."""
    entries = {
        "state_dict": network.state_dict(),
        "opts": dict(OPTIONS),
        "latent_avg": network.latent_avg,
        "discriminator": {"convs.0.weight": torch.ones(3)},
    }
    torch.save({key: value for key, value in (entries | changes).items() if value is not None}, path)
    return path


def converted(network: StyleGANEX, folder: Path, **changes: Any) -> StyleGANEX:
    """The network after the way through a checkpoint and our file."""
    target = folder / "ours.safetensors"
    weights.convert_checkpoint(checkpoint(network, folder / "theirs.pt", **changes), target)
    return weights.load(target)


def assert_same(one: StyleGANEX, two: StyleGANEX) -> None:
    assert one.variant == two.variant
    ours, theirs = one.state_dict(), two.state_dict()
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(tensor, theirs[key]) for key, tensor in ours.items())
    assert torch.equal(one.latent_avg, two.latent_avg) and torch.equal(one.editing_w, two.editing_w)


@pytest.mark.parametrize("name", ["toonify_notorgb", "edit", "sketch2face"])
def test_round_trips_are_exact(name: str, tmp_path: Path) -> None:
    network = make_network(dataclasses.replace(PUBLISHED[name], width=NARROW))
    options = argparse.Namespace(**OPTIONS)
    assert_same(converted(network, tmp_path, editing_w=network.editing_w, opts=options), network)
    weights.save(network, tmp_path / "saved.safetensors")
    assert_same(weights.load(tmp_path / "saved.safetensors"), network)


def test_a_file_says_with_how_many_levels_it_was_trained(network: StyleGANEX, tmp_path: Path) -> None:
    path = tmp_path / "ours.safetensors"
    for options, levels in (({}, 8), ({"levels": 6}, 6)):
        weights.save(network, path, **options)
        assert weights.trained_levels(path) == levels
    weights.save(network, path, levels=5)
    with pytest.raises(AssetError, match="trained with '5' levels"):
        weights.trained_levels(path)
    converted(network, tmp_path)
    assert weights.trained_levels(path) == 8, "published networks"


def test_a_loaded_network_computes_the_same(network: StyleGANEX, tmp_path: Path) -> None:
    loaded = converted(network, tmp_path)
    frame = torch.rand(1, 3, 32, 32) * 2 - 1
    with torch.no_grad():
        assert torch.equal(loaded(frame), network(frame))
    assert not any(parameter.requires_grad for parameter in loaded.parameters()) and not loaded.training


def test_one_average_code_serves_all_layers(network: StyleGANEX, tmp_path: Path) -> None:
    loaded = converted(network, tmp_path, latent_avg=network.latent_avg[3])
    assert torch.equal(loaded.latent_avg, network.latent_avg[3].expand(18, -1))


def test_options_decide_what_is_used(network: StyleGANEX, tmp_path: Path) -> None:
    """As in the authors' program, which ignores other tensors; without options, the tensors do."""
    for change, expected in (
        ({"use_skip_torgb": False}, {"fuse_rgb": False}),
        ({"skip_max_layer": 4}, {"n_fusion": 4}),
        ({"use_skip": False}, {"n_fusion": 0}),
        ({"max_pooling": True}, {"max_pooling": True}),
        (None, {}),
    ):
        path = checkpoint(network, tmp_path / "theirs.pt", opts=change if change is None else OPTIONS | change)
        tensors, metadata = weights.describe(convert.read_checkpoint(path))
        variant = Variant(**json.loads(metadata["variant"]))
        assert variant == dataclasses.replace(network.variant, **expected)
        weights.check_shapes({key: tensors[key].shape for key in tensors if key != "latent_avg"}, variant, path)


def test_constants_and_unused_parts_may_lack(network: StyleGANEX, tmp_path: Path) -> None:
    state = network.state_dict()
    kept = {key: value for key, value in state.items() if not re.fullmatch("|".join(weights.OPTIONAL), key)}
    assert len(kept) < len(state)
    loaded = converted(network, tmp_path, state_dict=kept)
    assert loaded.state_dict().keys() == state.keys()
    assert all(torch.equal(loaded.state_dict()[key], value) for key, value in kept.items())
    frame = torch.rand(1, 3, 32, 32) * 2 - 1
    with torch.no_grad():
        assert torch.equal(loaded(frame), network(frame))


def without(network: StyleGANEX, *keys: str) -> dict[str, torch.Tensor]:
    return {key: value for key, value in network.state_dict().items() if key not in keys}


def test_misfits_are_named(network: StyleGANEX, tmp_path: Path) -> None:
    state = network.state_dict()
    bias = "encoder.fusion.3.transform.0.bias"
    renamed = without(network, bias) | {"encoder.fusion.3.convert.0.bias": state[bias]}
    cases: list[tuple[dict[str, Any], str]] = [
        ({"state_dict": without(network, bias, "encoder.featlayer.bias")}, rf"lacks .*featlayer.*, {bias}|{bias}"),
        ({"state_dict": state | {"encoder.extra": torch.ones(1)}}, "has the unknown encoder.extra"),
        ({"state_dict": renamed}, rf"lacks {bias}; it has the unknown encoder.fusion.3.convert"),
        ({"state_dict": state | {bias: torch.ones(7)}}, rf"of another shape {bias} \[7\] instead of \[32\]"),
        ({"state_dict": {"a": torch.ones(1)}}, "no StyleGANEX network"),
        ({"state_dict": state | {"note": "hello"}}, "other things than tensors"),
        ({"state_dict": None}, "expected state_dict"),
        ({"latent_avg": None}, "lacks the tensor latent_avg"),
        ({"latent_avg": torch.ones(16, 32)}, r"latent_avg has shape \[16, 32\]"),
        ({"editing_w": torch.ones(18, 32)}, "editing_w has shape"),
        ({"opts": {"learn_in_w": True}}, "learn_in_w"),
        ({"opts": {"skip_max_layer": "7"}}, "skip_max_layer"),
    ]
    for changes, sentence in cases:
        path = checkpoint(network, tmp_path / "theirs.pt", **changes)
        with pytest.raises(AssetError, match=sentence):
            weights.convert_checkpoint(path, tmp_path / "ours.safetensors")
        assert [entry.name for entry in tmp_path.iterdir()] == ["theirs.pt"]


def test_files_of_ours_are_strict_too(network: StyleGANEX, tmp_path: Path) -> None:
    path = tmp_path / "ours.safetensors"
    weights.save(network, path)
    tensors = load_file(path)
    variant = json.dumps(dataclasses.asdict(network.variant))
    good = {"format": weights.FORMAT, "version": weights.VERSION, "variant": variant}
    less = {key: value for key, value in tensors.items() if key != "encoder.featlayer.bias"}
    cases = [
        (tensors, {}, "not of the format"),
        (tensors, good | {"version": "9"}, "not of the format"),
        (tensors, good | {"variant": "{}"}, "names no variant"),
        (tensors, good | {"variant": variant.replace("true", "1")}, "names no variant"),
        (tensors, good | {"variant": "{"}, "names no variant"),
        (less, good, "lacks encoder.featlayer.bias"),
        (tensors | {"more": torch.ones(1)}, good, "has the unknown more"),
        ({key: value for key, value in tensors.items() if key != "latent_avg"}, good, "lacks latent_avg"),
    ]
    for content, metadata, sentence in cases:
        save_file(content, path, metadata)
        with pytest.raises(AssetError, match=sentence):
            weights.load(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(AssetError, match="damaged"):
        weights.load(path)
    with pytest.raises(AssetError, match="do not exist"):
        weights.load(tmp_path / "absent.safetensors")
