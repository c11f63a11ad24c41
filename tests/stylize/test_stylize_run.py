"""A style over a clip: the same frames for any chunk or thread count, for any size, with and without a face."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import stylize_scene as scene

from toonifygb import stylize
from toonifygb.errors import InputError

STYLES = stylize.available()
SIZES = [(53, 37), (16, 16), (96, 80)]


def styled(name: str, clip: list[np.ndarray], marks, **options) -> list[np.ndarray]:
    style = stylize.get(name)
    state = stylize.prepare(iter(clip), marks, style, strength=options.get("strength", 1.0))
    return list(stylize.stylize_frames(iter(clip), marks, style, state, **options))


def same(first: list[np.ndarray], second: list[np.ndarray]) -> bool:
    return len(first) == len(second) and all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("name", STYLES)
def test_chunks_do_not_change_frames(name: str) -> None:
    clip = scene.frames(9, 96, 80, shift_px=1.3, noise=3)
    marks = scene.landmarks(9, 96, 80, shift_px=1.3, lost=[4])
    whole = styled(name, clip, marks, chunk=8)
    assert len(whole) == 9
    assert same(whole, styled(name, clip, marks, chunk=1))
    assert same(whole, styled(name, clip, marks, chunk=3))


@pytest.mark.parametrize("name", STYLES)
def test_apply_has_no_memory(name: str) -> None:
    clip = np.stack(scene.frames(3, 96, 80, shift_px=2))
    marks = scene.landmarks(3, 96, 80, shift_px=2)
    style = stylize.get(name)
    state = stylize.prepare(iter(clip), marks, style)
    faces = stylize.follow(marks)
    together = style.apply(clip, faces, None, state)
    for index in (2, 0, 1):
        alone = style.apply(clip[[index]], faces[[index]], None, state)
        assert np.array_equal(alone[0], together[index])


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", STYLES)
@pytest.mark.parametrize("found", [True, False])
def test_shape_and_type_survive(name: str, size: tuple[int, int], found: bool) -> None:
    width, height = size
    clip = scene.frames(2, width, height)
    out = styled(name, clip, scene.landmarks(2, width, height, lost=() if found else (0, 1)))
    assert [frame.shape for frame in out] == [(height, width, 3)] * 2
    assert all(frame.dtype == np.uint8 for frame in out)


@pytest.mark.parametrize("name", STYLES)
@pytest.mark.parametrize("value", [0, 128, 255])
def test_flat_grey_frames_stay_free_of_artefacts(name: str, value: int) -> None:
    clip = [np.full((48, 64, 3), value, np.uint8)] * 2
    out = styled(name, clip, scene.landmarks(2, 64, 48, lost=(0, 1)))
    assert np.array_equal(out[0], out[1])
    # paper grain, canvas and hatching may vary the tone, but nothing may tear a flat field into black and white
    assert out[0].astype(int).std() < 40


@pytest.mark.parametrize("name", STYLES)
def test_strength_zero_is_the_input(name: str) -> None:
    clip = scene.frames(3, 64, 48, noise=4)
    assert same(styled(name, clip, scene.landmarks(3, 64, 48), strength=0.0), clip)


@pytest.mark.parametrize("name", [name for name in STYLES if name != "none"])
def test_strength_leads_from_original_to_style(name: str) -> None:
    clip, marks = scene.frames(1, 96, 80), scene.landmarks(1, 96, 80)
    full = styled(name, clip, marks)[0].astype(float)
    distance = [
        np.abs(styled(name, clip, marks, strength=strength)[0] - full).mean() for strength in (0.0, 0.4, 0.8)
    ]
    assert distance[0] > distance[1] > distance[2] > 0


@pytest.mark.parametrize("name", STYLES)
def test_threads_do_not_change_frames(name: str) -> None:
    clip, marks = scene.frames(4, 160, 144, shift_px=1.5, noise=3), scene.landmarks(4, 160, 144, shift_px=1.5)
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        one = styled(name, clip, marks)
        cv2.setNumThreads(2)
        two = styled(name, clip, marks)
    finally:
        cv2.setNumThreads(before)
    assert same(one, two)


def test_mattes_thin_out_the_background_of_ink() -> None:
    clip, marks = scene.frames(5, 96, 80), scene.landmarks(5, 96, 80)
    style = stylize.get("ink")
    state = stylize.prepare(iter(clip), marks, style)
    inside = np.zeros((80, 96), np.float32)
    inside[20:, 30:66] = 1.0
    mattes = (inside for _ in clip)
    with_mattes = list(stylize.stylize_frames(iter(clip), marks, style, state, mattes=mattes, chunk=2))
    without = list(stylize.stylize_frames(iter(clip), marks, style, state, chunk=2))
    assert len(with_mattes) == 5
    assert with_mattes[0][:, :20].mean() > without[0][:, :20].mean() + 1.0
    assert np.array_equal(with_mattes[0][40:60, 40:55], without[0][40:60, 40:55])


def test_frames_are_read_as_they_are_needed() -> None:
    clip, marks = scene.frames(40, 48, 40), scene.landmarks(40, 48, 40)
    style = stylize.get("toon")
    state = stylize.prepare(iter(clip), marks, style)
    read = []
    source = (read.append(index) or frame for index, frame in enumerate(clip))
    stream = stylize.stylize_frames(source, marks, style, state, chunk=4)
    next(stream)
    assert len(read) <= 4 + 2


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"strength": 1.5}, "strength 1.5 is outside 0..1"),
        ({"mattes": []}, "frame 0 has no matte"),
    ],
)
def test_unusable_options_are_named(options: dict, text: str) -> None:
    clip, marks = scene.frames(2, 32, 32), scene.landmarks(2, 32, 32)
    style = stylize.get("none")
    with pytest.raises(InputError, match=text):
        list(stylize.stylize_frames(iter(clip), marks, style, {}, **options))


def test_more_frames_than_landmarks() -> None:
    clip, marks = scene.frames(3, 32, 32), scene.landmarks(2, 32, 32)
    with pytest.raises(InputError, match="goes on after frame 1"):
        list(stylize.stylize_frames(iter(clip), marks, stylize.get("none"), {}))


def test_empty_clip() -> None:
    with pytest.raises(InputError, match="no frames"):
        stylize.prepare(iter([]), scene.landmarks(2, 32, 32), stylize.get("toon"))


def test_unknown_style_offers_the_nearest() -> None:
    with pytest.raises(InputError) as raised:
        stylize.get("tooon")
    assert str(raised.value) == (
        f"style 'tooon' does not exist; available: {', '.join(STYLES)} — hint: did you mean 'toon'?"
    )
