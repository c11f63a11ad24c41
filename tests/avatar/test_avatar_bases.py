"""Reduced blendshapes: what few bases hold of many, where they move the surface, and their way to disk."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import pytest
import torch
from make import TINY, tiny_head, tiny_motion
from safetensors.torch import load_file, save_file

from toonifygb.avatar import Avatar, Poser, init_avatar, load, save
from toonifygb.avatar.bases import Mixer, check_bases, varimax
from toonifygb.avatar.save import _digest
from toonifygb.avatar.transfer import NO_DISPLACEMENT, consistency
from toonifygb.errors import InputError
from toonifygb.structures import HeadMotion

if TYPE_CHECKING:
    from pathlib import Path

SHAPE = torch.tensor([0.4, -0.3, 0.2])
MOTION = tiny_motion()


def avatar_of(n_bases: int | None = None) -> Avatar:
    """Untrained; with all blendshapes where no number of bases is given."""
    config = TINY if n_bases is None else replace(TINY, blendshapes="reduced", n_bases=n_bases)
    return init_avatar(tiny_head(), SHAPE, config, motion=MOTION)


def trained(avatar: Avatar) -> Avatar:
    """Every number of network and deltas changed at random."""
    generator = torch.Generator().manual_seed(1)

    def shaken(value: torch.Tensor) -> torch.Tensor:
        return value + 0.01 * torch.randn(value.shape, generator=generator)

    assert avatar.mixer is not None
    mixer = replace(avatar.mixer.map(shaken), scale=avatar.mixer.scale)
    return replace(avatar, mixer=mixer, deltas=avatar.deltas.map(shaken))


def movement(avatar: Avatar, motion: HeadMotion) -> torch.Tensor:
    """Displacement of the face Gaussians by the deltas in every frame, m."""
    return torch.einsum("tk,knc->tnc", avatar.coefficients(motion), avatar.deltas.means)


def test_as_many_bases_as_blendshapes_lose_nothing() -> None:
    full, few = avatar_of(), avatar_of(6)
    assert few.blendshape_names == full.blendshape_names
    assert few.n_bases == full.n_bases == 6
    assert torch.equal(few.signals(MOTION), full.signals(MOTION))
    apart = (movement(full, MOTION) - movement(few, MOTION)).abs().max()
    # Only what a basis moves by less than training would leave alone is left out.
    assert apart < 6 * NO_DISPLACEMENT * few.coefficients(MOTION).abs().max()


def test_few_bases_hold_as_much_as_any_could() -> None:
    full, few = avatar_of(), avatar_of(3)
    assert few.mixer is not None and few.deltas.means.shape[0] == 3 + 7
    n = full.n_bases
    usual = few.mixer.scale[:n, None] * full.deltas.means[:n].flatten(1)
    energies = torch.linalg.svdvals(usual.double()).square()
    held = few.deltas.means[:3].square().sum()
    assert abs(held / energies[:3].sum() - 1) < 1e-3
    assert energies[3:].sum() < 0.5 * energies.sum()


def test_network_starts_as_the_projection_and_never_sees_where_the_head_is() -> None:
    mixer = avatar_of(4).mixer
    assert mixer is not None
    assert torch.allclose(mixer.linear @ mixer.linear.T, torch.eye(4), atol=1e-5)
    psi = torch.randn(5, 13, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(mixer(psi), (psi[:, :6] / mixer.scale[:6]) @ mixer.linear.T)
    learned = trained(avatar_of(4)).mixer
    assert learned is not None
    moved = psi + torch.tensor([0.0] * 7 + [1.0] * 6)
    assert torch.equal(learned(psi), learned(moved))
    assert not torch.equal(learned(psi), learned(psi + torch.tensor([0.0] * 6 + [1.0] + [0.0] * 6)))


def test_neutral_stays_neutral_whatever_is_learned() -> None:
    mixer = trained(avatar_of(3)).mixer
    assert mixer is not None
    assert torch.equal(mixer(torch.zeros(13)), torch.zeros(3))
    far = 1e4 * torch.eye(13)
    bent = mixer(far) - (far[:, :6] / mixer.scale[:6]) @ mixer.linear.T
    assert bent.abs().max() <= 2 * mixer.out.abs().sum(1).max()


def test_bases_are_local() -> None:
    """Each is zero where it moves less than training would touch; turning makes these places more."""
    few = avatar_of(4)
    bases = few.deltas.map(lambda delta: delta[:4])
    still = consistency(bases.means) == 0
    assert still.float().mean() > 0.5
    assert all((getattr(bases, field.name)[still] == 0).all() for field in fields(bases))


def test_varimax_finds_the_parts_that_were_mixed() -> None:
    generator = torch.Generator().manual_seed(4)
    apart = torch.zeros(3, 60, 3)
    for index in range(3):
        apart[index, 20 * index : 20 * (index + 1)] = torch.randn(20, 3, generator=generator)
    mix = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
    turn = varimax(torch.einsum("ab,bnc->anc", mix, apart))
    assert torch.allclose(turn @ turn.T, torch.eye(3), atol=1e-5)
    found = (turn @ mix).abs()
    assert torch.allclose(found.sort().values, torch.tensor([0.0, 0.0, 1.0]).expand(3, 3), atol=1e-3)
    assert torch.allclose(found.sum(0), torch.ones(3), atol=3e-3)


def test_unused_blendshapes_can_still_be_driven() -> None:
    still = replace(MOTION, expression=torch.zeros_like(MOTION.expression))
    few = init_avatar(tiny_head(), SHAPE, replace(TINY, blendshapes="reduced", n_bases=6), motion=still)
    smile = replace(MOTION[0], expression=torch.tensor([1.0, 0.0, 0.0, 0.0]))
    assert movement(few, smile.map(lambda value: value[None])).norm(dim=-1).max() > 0.004


def test_the_same_bases_every_time() -> None:
    a, b = avatar_of(4), avatar_of(4)
    assert a.mixer is not None and b.mixer is not None
    assert torch.equal(a.deltas.means, b.deltas.means)
    assert all(torch.equal(getattr(a.mixer, f.name), getattr(b.mixer, f.name)) for f in fields(Mixer))


@pytest.mark.parametrize("half", [False, True])
def test_playback_equals_the_definition(half: bool) -> None:
    avatar = trained(avatar_of(4))
    exact, fast = avatar.pose(MOTION[5]), Poser(avatar, threads=1, half=half)(MOTION[5])
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.allclose(getattr(exact, name), getattr(fast, name), atol=1e-3 if half else 1e-5), name


def test_round_trip_is_exact_and_compact_is_close(tmp_path: Path) -> None:
    avatar = trained(avatar_of(4))
    save(avatar, tmp_path / "full")
    save(avatar, tmp_path / "compact", storage="compact")
    exact, near = load(tmp_path / "full"), load(tmp_path / "compact")
    for loaded in (exact, near):
        assert loaded.mixer is not None and avatar.mixer is not None
        for field in fields(Mixer):
            assert torch.equal(getattr(loaded.mixer, field.name), getattr(avatar.mixer, field.name))
    assert torch.equal(exact.pose(MOTION[3]).means, avatar.pose(MOTION[3]).means)
    assert (near.pose(MOTION[3]).means - avatar.pose(MOTION[3]).means).abs().max() < 1e-4


def test_avatars_from_before_there_were_bases_load(tmp_path: Path) -> None:
    save(avatar_of(), tmp_path)
    facts = json.loads((tmp_path / "avatar.json").read_text())
    del facts["has_mixer"]
    (tmp_path / "avatar.json").write_text(json.dumps(facts))
    assert load(tmp_path).mixer is None


@pytest.mark.parametrize("name", ["mixer.scale", "mixer.linear", "mixer.hidden", "mixer.out"])
def test_network_of_another_size_is_refused(tmp_path: Path, name: str) -> None:
    save(avatar_of(4), tmp_path)
    path = tmp_path / "avatar.safetensors"
    tensors = load_file(path)
    tensors[name] = tensors[name][..., :-1].contiguous()
    save_file(tensors, path)
    facts = json.loads((tmp_path / "avatar.json").read_text())
    (tmp_path / "avatar.json").write_text(json.dumps(facts | {"tensors_sha256": _digest(path)}))
    with pytest.raises(InputError, match=name):
        load(tmp_path)


@pytest.mark.parametrize(("kind", "number", "most"), [("reduced", 0, 6), ("reduced", 7, 6), ("full", 5, 4)])
def test_a_number_of_bases_that_cannot_be_is_refused(kind: str, number: int, most: int) -> None:
    config = replace(TINY, blendshapes=kind, n_bases=number)
    with pytest.raises(InputError, match=f"train.n_bases is {number}; the head model 'tiny' has {most}"):
        check_bases(config, tiny_head())
    with pytest.raises(InputError):
        init_avatar(tiny_head(), SHAPE, config)


def test_heads_without_lids_have_bases_too() -> None:
    head = replace(tiny_head(), eyelid_basis=None, n_blendshapes=3)
    config = replace(TINY, blendshapes="reduced")
    avatar = init_avatar(head, SHAPE, config, motion=MOTION)
    assert avatar.n_bases == 3 and avatar.deltas.means.shape[0] == 3 + 7
    assert avatar.coefficients(MOTION).shape == (20, 10)
    with pytest.raises(InputError, match="has 3 blendshapes"):
        check_bases(replace(config, n_bases=4), head)
