"""The avatar's folder: exact round trips, and one clear sentence for every kind of damage."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import pytest
import torch
from make import tiny_avatar, tiny_motion
from safetensors.torch import load_file, save_file

from toonifygb.avatar import load, packing, save
from toonifygb.avatar.save import _digest
from toonifygb.errors import InputError
from toonifygb.structures import TensorRecord

if TYPE_CHECKING:
    from pathlib import Path


def assert_same(a: object, b: object) -> None:
    for part in fields(a):  # type: ignore[arg-type]
        left, right = getattr(a, part.name), getattr(b, part.name)
        if isinstance(left, TensorRecord):
            assert_same(left, right)
        elif isinstance(left, torch.Tensor):
            assert torch.equal(left, right), part.name
        else:
            assert left == right, part.name


def test_round_trip_is_exact(tmp_path: Path) -> None:
    avatar = replace(tiny_avatar(), meta={"psnr": 30.5, "nested": {"a": [1, 2]}})
    save(avatar, tmp_path / "avatar")
    assert_same(avatar, load(tmp_path / "avatar"))
    assert sorted(p.name for p in (tmp_path / "avatar").iterdir()) == ["avatar.json", "avatar.safetensors"]


def test_avatar_without_drivers_or_deltas(tmp_path: Path) -> None:
    avatar = tiny_avatar()
    still = replace(
        avatar,
        drivers=None,
        blendshape_names=avatar.blendshape_names[:6],
        deltas=avatar.deltas.map(lambda delta: torch.zeros_like(delta[:6])),
    )
    save(still, tmp_path)
    assert_same(still, load(tmp_path))


def test_unmoved_gaussians_take_no_room(tmp_path: Path) -> None:
    avatar = tiny_avatar()
    n = 50

    def cut(delta: torch.Tensor) -> torch.Tensor:
        delta = delta.clone()
        delta[:, n:] = 0
        return delta

    avatar = replace(avatar, deltas=avatar.deltas.map(cut))
    save(avatar, tmp_path)
    assert load_file(tmp_path / "avatar.safetensors")["deltas.means"].shape[1] == n
    assert_same(avatar, load(tmp_path))


def test_compact_storage_is_small_and_hardly_differs(tmp_path: Path) -> None:
    avatar = tiny_avatar()
    save(avatar, tmp_path / "full")
    save(avatar, tmp_path / "compact", storage="compact")
    sizes = [(tmp_path / kind / "avatar.safetensors").stat().st_size for kind in ("full", "compact")]
    assert sizes[1] < 0.45 * sizes[0]
    motion = tiny_motion()[4]
    exact, near = avatar.pose(motion), load(tmp_path / "compact").pose(motion)
    # Half precision keeps 11 bits: a 10 mm displacement is right to 5 µm. Bytes keep 7 of the largest value.
    assert (exact.means - near.means).abs().max() < 2e-5
    largest = len(avatar.blendshape_names) * avatar.deltas.sh.abs().max()
    assert (exact.sh - near.sh)[:, 0].abs().max() < largest / packing.LEVELS
    assert (exact.sh - near.sh)[:, 1:].abs().max() < largest / packing.REST_LEVELS


def test_packed_deltas_are_right_to_half_a_step_and_zeros_stay_zero() -> None:
    deltas = tiny_avatar().deltas
    generator = torch.Generator().manual_seed(0)
    live = torch.rand(deltas.opacity_logits.shape, generator=generator) < 0.3
    sparse = deltas.map(lambda delta: delta * live.view(*live.shape, *[1] * (delta.ndim - 2)))
    found = packing.unpack(packing.pack(sparse), live.shape[1])
    for name in ("quats", "log_scales", "opacity_logits", "sh"):
        exact, near = getattr(sparse, name), getattr(found, name)
        step = exact.abs().amax(1, keepdim=True) / packing.LEVELS
        if name == "sh":
            step[..., 1:, :] *= packing.LEVELS / packing.REST_LEVELS
        assert ((exact - near).abs() <= 0.501 * step).all(), name
        assert torch.equal(near[~live], exact[~live]), name
    assert torch.equal(found.means, sparse.means.half().float())


def test_compact_avatars_from_before_view_dependent_colour_was_apart_are_read(tmp_path: Path) -> None:
    avatar = tiny_avatar()
    save(avatar, tmp_path, storage="compact")
    tensors = load_file(tmp_path / "avatar.safetensors")
    rest = {name for name in tensors if name.startswith(f"packed.{packing.REST}.")}
    assert len(rest) == 3
    sh = avatar.deltas.sh.flatten(2)
    old = packing._stepped("sh", sh, packing.LEVELS)
    kept = {name: tensor for name, tensor in tensors.items() if name not in rest}
    _replace_tensors(tmp_path, kept | {f"packed.{name}": tensor for name, tensor in old.items()})
    step = sh.abs().amax(1, keepdim=True) / packing.LEVELS
    assert ((load(tmp_path).deltas.sh.flatten(2) - sh).abs() <= 0.501 * step).all()


def test_colour_that_is_the_same_from_everywhere_has_nothing_apart() -> None:
    deltas = tiny_avatar().deltas
    plain = replace(deltas, sh=deltas.sh[..., :1, :])
    packed = packing.pack(plain)
    assert packed[f"{packing.REST}.values"].numel() == 0
    assert packing.unpack(packed, plain.means.shape[1]).sh.shape == plain.sh.shape


def test_a_new_avatar_replaces_the_old(tmp_path: Path) -> None:
    save(tiny_avatar(seed=1), tmp_path)
    save(tiny_avatar(seed=2), tmp_path)
    assert_same(tiny_avatar(seed=2), load(tmp_path))


def test_damage_is_told_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"avatar\.json is missing"):
        load(tmp_path)
    save(tiny_avatar(), tmp_path)
    facts_path, tensors_path = tmp_path / "avatar.json", tmp_path / "avatar.safetensors"
    facts, tensors = facts_path.read_text(), tensors_path.read_bytes()

    tensors_path.write_bytes(tensors[:-100])
    with pytest.raises(InputError, match="does not match"):
        load(tmp_path)
    tensors_path.unlink()
    with pytest.raises(InputError, match=r"avatar\.safetensors is missing"):
        load(tmp_path)
    tensors_path.write_bytes(tensors)

    facts_path.write_text(facts[: len(facts) // 2])
    with pytest.raises(InputError, match="not valid JSON"):
        load(tmp_path)
    facts_path.write_text(json.dumps(json.loads(facts) | {"version": 99}))
    with pytest.raises(InputError, match="format version 99"):
        load(tmp_path)
    facts_path.write_text("{}")
    with pytest.raises(InputError, match="does not describe an avatar"):
        load(tmp_path)


@pytest.mark.parametrize("damage", ["fewer values", "another number of blendshapes", "other channels"])
def test_packed_deltas_must_fit_together(tmp_path: Path, damage: str) -> None:
    save(tiny_avatar(), tmp_path, storage="compact")
    tensors = load_file(tmp_path / "avatar.safetensors")
    if damage == "fewer values":
        tensors["packed.sh.values"] = tensors["packed.sh.values"][:-1]
    elif damage == "another number of blendshapes":
        tensors["packed.sh.steps"] = tensors["packed.sh.steps"][:-1]
    else:
        tensors["packed.quats.values"] = tensors["packed.quats.values"][:, :3].contiguous()
    _replace_tensors(tmp_path, tensors)
    with pytest.raises(InputError, match="do not fit together"):
        load(tmp_path)


@pytest.mark.parametrize("change", ["missing", "unknown", "misfit"])
def test_tensors_must_be_exactly_the_expected_ones(tmp_path: Path, change: str) -> None:
    save(tiny_avatar(), tmp_path)
    tensors = load_file(tmp_path / "avatar.safetensors")
    if change == "missing":
        del tensors["neutral.quats"]
    elif change == "unknown":
        tensors["neutral.secret"] = torch.zeros(1)
    else:
        tensors["skin_weights"] = torch.zeros(3, 5)
    _replace_tensors(tmp_path, tensors)
    with pytest.raises(InputError, match="skin_weights has shape" if change == "misfit" else "missing or unknown"):
        load(tmp_path)


def _replace_tensors(folder: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Other tensors under a digest that fits them."""
    save_file(tensors, folder / "avatar.safetensors")
    facts = json.loads((folder / "avatar.json").read_text())
    facts["tensors_sha256"] = _digest(folder / "avatar.safetensors")
    (folder / "avatar.json").write_text(json.dumps(facts))
