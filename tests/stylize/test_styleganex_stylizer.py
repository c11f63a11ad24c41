"""StyleGANEX as a style, around a small stand-in network: framing, codes, paste-back, purity."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import stylize_scene as scene
import torch
from fake_network import COLORS, FakeNetwork, compile_clip
from styleganex_weights import NARROW, make_network

from toonifygb import stylize
from toonifygb.config import PUBLISHED_STYLEGANEX, StyleganexConfig
from toonifygb.errors import AssetError, FaceError, InputError
from toonifygb.stylize.filters import to_lab
from toonifygb.stylize.styleganex import PUBLISHED, fast, weights
from toonifygb.stylize.styleganex.aligned import AlignedStylizer
from toonifygb.stylize.styleganex.engine import Engine, to_bytes, to_network
from toonifygb.stylize.styleganex.frame import CropRule, crop_rule
from toonifygb.stylize.styleganex.paste import paste, seam_weight
from toonifygb.stylize.styleganex.reference import suitability
from toonifygb.stylize.styleganex.stylizer import StyleganexStylizer, keep_color

WIDTH, HEIGHT = 180, 150


def opened(network: FakeNetwork | None = None, **options):
    config = StyleganexConfig(**options)
    engine = Engine(lambda: network or FakeNetwork(), compile_clip, config)
    kind = AlignedStylizer if config.framing == "aligned" else StyleganexStylizer
    return kind("fake", "a stand-in", engine)


def clip(n_frames: int = 6, **options):
    marks = scene.landmarks(n_frames, WIDTH, HEIGHT, shift_px=1.5, **options)
    return scene.frames(n_frames, WIDTH, HEIGHT, shift_px=1.5, noise=2), marks


def styled(style, frames, marks, **options) -> list[np.ndarray]:
    state = stylize.prepare(iter(frames), marks, style)
    return list(stylize.stylize_frames(iter(frames), marks, style, state, **options))


FRAMINGS = ("full", "crop", "published", "aligned")


@pytest.mark.parametrize("framing", FRAMINGS)
def test_chunks_and_restarts_do_not_change_frames(framing: str) -> None:
    frames, marks = clip()
    style = opened(framing=framing)
    state = stylize.prepare(iter(frames), marks, style)
    whole = list(stylize.stylize_frames(iter(frames), marks, style, state, chunk=8))
    assert [frame.shape for frame in whole] == [(HEIGHT, WIDTH, 3)] * len(frames)
    fresh = opened(framing=framing)  # another worker
    late = list(stylize.stylize_frames(iter(frames), marks, fresh, state, chunk=2, start=3))
    assert len(late) == 3
    assert all(np.array_equal(a, b) for a, b in zip(whole[3:], late, strict=True))


@pytest.mark.parametrize("framing", FRAMINGS)
def test_the_state_is_plain(framing: str) -> None:
    frames, marks = clip()
    state = stylize.prepare(iter(frames), marks, opened(framing=framing))
    codes = state.pop("w_plus")
    assert codes.shape == (18, 512) and codes.dtype == np.float32
    assert json.loads(json.dumps(state)) == state


def test_codes_are_read_once_per_clip() -> None:
    network = FakeNetwork()
    frames, marks = clip()
    styled(opened(network), frames, marks)
    assert network.faces == 1


def test_each_frame_may_have_codes_of_its_own_when_aligned() -> None:
    network = FakeNetwork()
    frames, marks = clip()
    styled(opened(network, framing="aligned", codes="each"), frames, marks)
    assert network.faces == len(frames)
    with pytest.raises(InputError, match="codes is 'each'"):
        opened(codes="each")


def expected(frame: np.ndarray) -> np.ndarray:
    """The stand-in's colour map on a whole frame, but for its shift."""
    return np.einsum("ij,hwj->hwi", COLORS.numpy(), frame / 127.5 - 1.0)


@pytest.mark.parametrize("framing", ["full", "crop", "published"])
def test_the_output_lies_where_the_input_was(framing: str) -> None:
    frames, marks = clip(3)
    drawn = styled(opened(framing=framing, calm=False), frames, marks)[1] / 127.5 - 1.0
    difference = (drawn - expected(frames[1]))[6:-6, 6:-6]
    plain = (np.abs(drawn) < 0.99)[6:-6, 6:-6]
    shift = np.array([np.median(difference[..., c][plain[..., c]]) for c in range(3)])
    assert np.abs(difference - shift)[plain].mean() < 0.04
    moved = np.roll(expected(frames[1]), 2, axis=1)  # the measure notices two px
    assert np.abs(drawn - moved - shift)[6:-6, 6:-6][plain].mean() > 1.4 * np.abs(difference - shift)[plain].mean()


def test_super_gives_the_networks_own_size() -> None:
    frames, marks = clip(2)
    style = opened(framing="full", size="super")
    state = stylize.prepare(iter(frames), marks, style)
    rule = CropRule.from_state(state["rule"])
    drawn = list(stylize.stylize_frames(iter(frames), marks, style, state))
    assert drawn[0].shape == (4 * rule.size[0], 4 * rule.size[1], 3)
    with pytest.raises(InputError, match=r"strength 0\.5 blends"):
        list(stylize.stylize_frames(iter(frames), marks, style, state, strength=0.5))


@pytest.mark.parametrize(("levels", "times"), [(8, 4), (7, 2), (6, 1)])
def test_published_settings_give_the_published_picture(levels: int, times: int) -> None:
    """Resize, crop at a multiple of 8, network, clamp, truncate: nothing else."""
    frames, marks = clip(2)
    config = {**PUBLISHED_STYLEGANEX.__dict__, "levels": levels}
    style = opened(**config)
    state = stylize.prepare(iter(frames), marks, style)
    rule = CropRule.from_state(state["rule"])
    assert state["reference"] == 0
    small = cv2.resize(frames[1], rule.size[::-1], interpolation=cv2.INTER_LINEAR)
    box = small[rule.top : rule.bottom, rule.left : rule.right]
    assert box.shape[0] % 8 == box.shape[1] % 8 == 0
    run = compile_clip(FakeNetwork(), torch.from_numpy(state["w_plus"])[None], dtype=torch.float32, levels=levels)
    y = run(torch.from_numpy((box.astype(np.float32) / 255 - 0.5) / 0.5).permute(2, 0, 1)[None])
    wanted = ((y.clamp(-1, 1) + 1) * 127.5).to(torch.uint8)[0].permute(1, 2, 0).numpy()
    drawn = list(stylize.stylize_frames(iter(frames), marks, style, state))[1]
    assert drawn.shape[0] == times * box.shape[0]
    assert np.array_equal(drawn, wanted)


def test_rounding_is_a_choice() -> None:
    image = torch.full((1, 3, 1, 1), 0.999)
    assert int(to_bytes(image, "truncate")[0, 0, 0, 0]) == 254
    assert int(to_bytes(image, "nearest")[0, 0, 0, 0]) == 255
    every = np.arange(256, dtype=np.uint8).reshape(1, 16, 16, 1).repeat(3, -1)
    assert np.array_equal(to_bytes(to_network(every), "nearest").numpy(), every)


def test_a_seam_is_not_visible() -> None:
    """Where the crop ends, the picture steps no more than the source does, also for a strong change of colours."""
    frame = np.roll(scene.frames(1, 400, 300)[0], -70, axis=1)  # the face in the crop, only wall at its edge
    rule = crop_rule(32.0, (130.0, 150.0), 300, 400)
    assert not rule.is_whole
    rows, columns = rule.place()
    output = np.clip(rule.cut(frame).repeat(4, 0).repeat(4, 1) * [0.6, 0.9, 0.5] + [90, 0, 40], 0, 255).astype(
        np.uint8
    )
    pasted = paste(output, frame, rule).astype(float)
    edge = columns.stop
    step = np.abs(np.diff(pasted[:, edge - 40 : edge + 40], axis=1)).max(axis=0).mean()
    bare = frame.astype(float)
    bare[rows, columns] = cv2.resize(output, (columns.stop, rows.stop - rows.start), interpolation=cv2.INTER_AREA)
    assert step < 4
    assert np.abs(np.diff(bare[:, edge - 2 : edge + 2], axis=1)).max() > 30
    # far from the crop the surroundings have followed its colours
    wanted = frame[:, -5:] * [0.6, 0.9, 0.5] + [90, 0, 40]
    assert np.abs(pasted[:, -5:] - wanted).mean() < 8


def test_the_seam_fades_inside_the_crop_only() -> None:
    weight = seam_weight((60, 80), slice(0, 60), slice(20, 80), 10.0)
    assert weight[:, :20].max() == 0
    assert (weight[:, 31:] == 1).all()
    assert (np.diff(weight[0, 20:31]) > 0).all()


def test_faces_lost_on_the_way_change_nothing_in_full_framing() -> None:
    frames, marks = clip(6, lost=[3])
    _, whole = clip(6)
    style = opened(framing="full", codes="first", calm=False)
    state = stylize.prepare(iter(frames), whole, style)
    seen = list(stylize.stylize_frames(iter(frames), whole, style, state))
    lost = list(stylize.stylize_frames(iter(frames), marks, style, state))
    assert np.array_equal(seen[3], lost[3])
    aligned = opened(framing="aligned", calm=False)
    state = stylize.prepare(iter(frames), marks, aligned)
    assert np.array_equal(list(stylize.stylize_frames(iter(frames), marks, aligned, state))[3], frames[3])


def test_a_clip_without_a_face_is_refused() -> None:
    frames, marks = clip(3, lost=(0, 1, 2))
    with pytest.raises(FaceError, match="no face was found"):
        stylize.prepare(iter(frames), marks, opened())


def test_the_reference_is_frontal_sharp_and_open_eyed() -> None:
    good = scene.face_at(WIDTH, HEIGHT)
    turned, shut = good.copy(), good.copy()
    turned[1] = 0.6 * good[1] + 0.4 * good[454]
    for eye in stylize.anchors.EYES:
        shut[list(eye.upper)] = shut[list(eye.lower)]
    frame = scene.frames(1, WIDTH, HEIGHT)[0]
    frame[:] = np.random.default_rng(0).integers(0, 255, frame.shape)
    pictures = np.stack([frame, frame, cv2.GaussianBlur(frame, (0, 0), 3), frame, frame])
    faces = stylize.Faces(np.stack([turned, shut, good, good, good]), np.float32([1, 1, 1, 1, 0]))
    good[1] = 0.5 * (good[234] + good[454])
    faces.points[2:, 1] = good[1]
    faces.points[1, 1] = good[1]
    score = suitability(pictures, faces)
    assert int(score.argmax()) == 3
    assert score[4] == 0
    assert score[:3].max() < 0.9 * score[3]


def test_own_colors_lead_to_the_average_codes() -> None:
    frames, marks = clip(2)
    own, average = (
        stylize.prepare(iter(frames), marks, opened(own_colors=share))["w_plus"] for share in (1.0, 0.0)
    )
    assert np.array_equal(own[:7], average[:7])
    assert (average[7:] == 0.25).all()
    assert not np.allclose(own[7:], 0.25)


def test_source_color_returns() -> None:
    frame = scene.frames(1, WIDTH, HEIGHT)[0]
    drawn = np.clip(frame * [0.7, 0.7, 1.0] + [0, 0, 40], 0, 255).astype(np.uint8)
    theirs = to_lab(frame)[..., 1:].mean((0, 1))
    distance = [
        np.linalg.norm(to_lab(keep_color(drawn, frame, amount, 10.0))[..., 1:].mean((0, 1)) - theirs)
        for amount in (0.0, 0.5, 1.0)
    ]
    assert distance[0] > 1.8 * distance[1] > 3.0 * distance[2]
    assert np.array_equal(keep_color(drawn, frame, 0.0, 10.0), drawn)


@pytest.mark.parametrize("name", ["arcane", "cartoon", "pixar", "age", "hair"])
def test_without_weights_it_is_said_how_to_get_them(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TOONIFYGB_CACHE", str(tmp_path))
    with pytest.raises(InputError) as raised:
        stylize.get(name)
    assert f"toonifygb assets get styleganex-{name}" in str(raised.value)
    assert any(f"'{drawn}' comes nearest" in str(raised.value) for drawn in stylize.available())
    assert name not in stylize.available()
    assert stylize.files(name) == ()


def test_a_misspelt_style_with_weights_is_offered() -> None:
    with pytest.raises(InputError, match="did you mean 'arcane'"):
        stylize.get("arcana")


@pytest.mark.parametrize(
    ("options", "text"),
    [({"levels": 5}, "levels is 5"), ({"framing": "aligned", "size": "super"}, "aligned framing cannot give")],
)
def test_settings_that_cannot_be_are_named(options: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        opened(**options)


@pytest.mark.parametrize(("asked", "runs"), [(None, 6), (7, 7), (8, 8)])
def test_levels_are_those_of_the_training_unless_asked_for(asked: int | None, runs: int) -> None:
    config = StyleganexConfig(framing="full", size="super", levels=asked)
    style = StyleganexStylizer("fake", "a stand-in", Engine(FakeNetwork, compile_clip, config, trained_levels=6))
    frames, marks = clip(2)
    height, width = stylize.prepare(iter(frames), marks, style)["rule"]["size"]
    assert styled(style, frames, marks)[0].shape == (height << (runs - 6), width << (runs - 6), 3)


@pytest.mark.parametrize("framing", ["full", "aligned"])
def test_the_real_network_runs_by_name(framing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a file where assets lie to frames, with StyleGANEX at a fraction of its width."""
    monkeypatch.setenv("TOONIFYGB_CACHE", str(tmp_path))
    models = tmp_path / "models"
    models.mkdir()
    network = make_network(dataclasses.replace(PUBLISHED["toonify"], width=NARROW))
    weights.save(network, models / "styleganex-arcane.safetensors")
    (models / "styleganex-arcane.json").write_text("{}")
    frames, marks = scene.frames(3, 96, 80, shift_px=1), scene.landmarks(3, 96, 80, shift_px=1)
    options = StyleganexConfig(framing=framing, levels=6)
    style = stylize.get("arcane", options)
    state = stylize.prepare(iter(frames), marks, style)
    whole = list(stylize.stylize_frames(iter(frames), marks, style, state))
    assert [frame.shape for frame in whole] == [frame.shape for frame in frames]
    assert np.abs(whole[0].astype(float) - frames[0]).max() > 20
    again = stylize.stylize_frames(iter(frames), marks, stylize.get("arcane", options), state, chunk=1, start=2)
    assert np.array_equal(next(again), whole[2])
    assert stylize.files("arcane") == (models / "styleganex-arcane.safetensors",)


@pytest.mark.parametrize("amount", [1.0, -0.5])
def test_editing_styles_go_as_far_as_asked(amount: float) -> None:
    """Codes and attention follow the first editing vector, as in the definition."""
    network = make_network(dataclasses.replace(PUBLISHED["edit"], width=NARROW))
    network.editing_w = torch.cat((network.editing_w, 9 * network.editing_w))
    frame = scene.frames(1, 64, 48)[0][None]
    codes = network.latent_avg + 0.3 * torch.randn(network.latent_avg.shape)
    with torch.no_grad():
        expected = network(to_network(frame), codes[None], amount * network.editing_w[:1], levels=6)
        unedited = network(to_network(frame), codes[None], levels=6)
    engine = Engine(lambda: network, fast.compile_clip, StyleganexConfig(levels=6, edit=amount))
    drawn = engine.run(frame, codes.numpy())
    assert np.abs(drawn.astype(int) - to_bytes(expected, "nearest").numpy()).max() <= 1
    assert np.abs(drawn.astype(int) - to_bytes(unedited, "nearest").numpy()).max() > 5


def test_a_style_file_is_opened_by_its_path(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"style file .*mine\.safetensors does not exist"):
        stylize.get(str(tmp_path / "mine.safetensors"))
    path = tmp_path / "mine.safetensors"
    weights.save(make_network(dataclasses.replace(PUBLISHED["toonify"], width=NARROW)), path)
    assert stylize.get(str(path)).name == "mine" and stylize.files(str(path)) == (path,)
    path.write_bytes(b"not weights")
    with pytest.raises(AssetError, match=r"mine\.safetensors is damaged"):
        stylize.get(str(path))
