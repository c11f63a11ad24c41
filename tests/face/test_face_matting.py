"""Mattes: the guided filter against its definition, the rules of a head matte, and real silhouettes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import av
import cv2
import numpy as np
import pytest
from drawn_face import draw_face

from toonifygb.face.guided import GuidedFilter, box_mean, foreground_color
from toonifygb.face.matting import PersonSegmenter, foreground, head_matte

if TYPE_CHECKING:
    from pathlib import Path


def disc(size: int, x: float, y: float, radius: float, softness: float = 1.0) -> np.ndarray:
    """Soft disc 0..1."""
    rows, columns = np.mgrid[:size, :size]
    return np.clip((radius - np.hypot(columns - x, rows - y)) / softness + 0.5, 0, 1).astype(np.float32)


def paint(matte: np.ndarray, front: tuple[int, int, int], back: tuple[int, int, int]) -> np.ndarray:
    """The front colour over the back colour."""
    mix = matte[..., None] * np.array(front) + (1 - matte[..., None]) * np.array(back)
    return np.rint(mix).astype(np.uint8)


def guided_filter_by_definition(guide: np.ndarray, matte: np.ndarray, radius: int, epsilon: float) -> np.ndarray:
    """Least squares in every window, then the mean of all windows' predictions at each pixel."""
    pad = radius
    image = np.pad(guide.astype(np.float64), ((pad, pad), (pad, pad), (0, 0)), mode="reflect")
    target = np.pad(matte.astype(np.float64), pad, mode="reflect")
    height, width = matte.shape
    slopes, offsets = np.zeros((height, width, 3)), np.zeros((height, width))
    span = 2 * radius + 1
    for i in range(height):
        for j in range(width):
            colors = image[i : i + span, j : j + span].reshape(-1, 3)
            values = target[i : i + span, j : j + span].ravel()
            centred = colors - colors.mean(0)
            matrix = centred.T @ centred / len(values) + epsilon * np.eye(3)
            slopes[i, j] = np.linalg.solve(matrix, centred.T @ (values - values.mean()) / len(values))
            offsets[i, j] = values.mean() - slopes[i, j] @ colors.mean(0)
    slopes = np.pad(slopes, ((pad, pad), (pad, pad), (0, 0)), mode="reflect")
    offsets = np.pad(offsets, pad, mode="reflect")
    result = np.empty((height, width))
    for i in range(height):
        for j in range(width):
            window = (slice(i, i + span), slice(j, j + span))
            result[i, j] = slopes[window].mean((0, 1)) @ guide[i, j] + offsets[window].mean()
    return result


def test_the_guided_filter_is_its_definition() -> None:
    rng = np.random.default_rng(0)
    guide = cv2.GaussianBlur(rng.random((24, 20, 3)).astype(np.float32), (0, 0), 1)
    matte = cv2.GaussianBlur(rng.random((24, 20)).astype(np.float32), (0, 0), 2)
    expected = guided_filter_by_definition(guide, matte, 3, 1e-3)
    np.testing.assert_allclose(GuidedFilter(guide, 3, 1e-3)(matte), expected, atol=2e-4)  # float32 covariances


def test_one_guided_filter_refines_any_matte_as_a_fresh_one_does() -> None:
    rng = np.random.default_rng(1)
    guide = rng.random((30, 26, 3)).astype(np.float32)
    mattes = rng.random((2, 30, 26)).astype(np.float32)
    kept = GuidedFilter(guide, 4, 1e-3, step=2)
    for matte in mattes:
        np.testing.assert_array_equal(kept(matte), GuidedFilter(guide, 4, 1e-3, step=2)(matte))


def test_the_fast_guided_filter_is_close_to_the_exact_one() -> None:
    truth = disc(96, 48, 48, 30)
    guide = paint(truth, (200, 150, 120), (60, 90, 140)).astype(np.float32) / 255
    coarse = box_mean(truth, 5)
    exact, fast = (GuidedFilter(guide, 8, 2e-4, step)(coarse) for step in (1, 2))
    assert np.abs(exact - fast).mean() < 0.01


def test_a_blurred_edge_is_drawn_to_the_image() -> None:
    truth = disc(128, 64, 64, 40)
    image = paint(truth, (200, 150, 120), (60, 90, 140))
    wrong = box_mean(disc(128, 66, 64, 39), 2)  # up to 3 px off and 5 px soft
    refined = head_matte(image, wrong, np.ones_like(truth), head_width_px=300)
    assert np.abs(refined - truth).mean() < 0.15 * np.abs(wrong - truth).mean()
    edge = (refined > 0.05) & (refined < 0.95)
    assert edge.any() and edge.sum() < 2.5 * 2 * np.pi * 40  # soft, but not a band


def test_islands_go_and_the_keep_mask_cuts() -> None:
    head, island = disc(160, 60, 70, 40), disc(160, 140, 20, 12)
    image = paint(np.maximum(head, island), (210, 160, 130), (40, 60, 90))
    keep = np.clip((110 - np.mgrid[:160, :160][0]) / 20, 0, 1).astype(np.float32)
    matte = head_matte(image, np.maximum(head, island), keep, head_width_px=160)
    assert matte[20, 140] == 0 and matte[70, 60] == 1
    assert (matte <= keep + 1e-6).all()
    np.testing.assert_allclose(matte[100, 55:65], 0.5, atol=0.02)


def test_nothing_to_keep_gives_an_empty_matte() -> None:
    image = np.zeros((20, 30, 3), np.uint8)
    assert not head_matte(image, np.ones((20, 30), np.float32), np.zeros((20, 30), np.float32)).any()
    np.testing.assert_array_equal(foreground(image, np.zeros((20, 30), np.float32)), image)


def test_the_solid_mask_fills_holes() -> None:
    head = disc(128, 64, 64, 40)
    holed = head * (1 - disc(128, 64, 60, 14))
    image = paint(head, (210, 160, 130), (40, 60, 90))
    keep = np.ones_like(head)
    assert head_matte(image, holed, keep, head_width_px=128)[60, 64] < 0.5
    assert head_matte(image, holed, keep, disc(128, 64, 64, 30), head_width_px=128)[60, 64] == 1


def test_the_matte_moves_no_more_than_its_inputs() -> None:
    """Camera noise of 2 grey levels and 2 % uncertainty of the network change the matte by little."""
    rng = np.random.default_rng(0)
    truth = disc(128, 64, 64, 40, softness=3)
    image, coarse = paint(truth, (200, 150, 120), (60, 90, 140)), box_mean(truth, 4)
    mattes = []
    for _ in range(4):
        noisy = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        person = np.clip(coarse + rng.normal(0, 0.02, coarse.shape), 0, 1).astype(np.float32)
        mattes.append(head_matte(noisy, person, np.ones_like(truth), head_width_px=160))
    change = np.abs(np.diff(mattes, axis=0))
    assert change.mean() < 0.004 and change.max() < 0.25


def test_the_halo_is_gone() -> None:
    """A dark head before a bright wall, on black: the rim must be dark instead of grey."""
    matte = disc(160, 80, 80, 50, softness=6)
    image = paint(matte, (60, 45, 40), (230, 235, 240))
    clean = foreground(image, matte).astype(float) * matte[..., None]
    ideal = np.array([60, 45, 40]) * matte[..., None]
    halo = image * matte[..., None]
    rim = (matte > 0.02) & (matte < 0.98)
    assert np.abs(halo - ideal)[rim].mean() > 20
    assert np.abs(clean - ideal)[rim].mean() < 4
    np.testing.assert_array_equal(foreground(image, matte)[matte == 1], image[matte == 1])


def test_foreground_color_solves_the_mixing_equation_inside() -> None:
    matte = disc(96, 48, 48, 30, softness=8)
    image = paint(matte, (180, 120, 90), (20, 60, 200)).astype(np.float32) / 255
    color = foreground_color(image, matte, 16)
    assert np.abs(color - np.array([180, 120, 90]) / 255)[matte > 0.1].max() < 0.06


def foreground_color_by_definition(image: np.ndarray, matte: np.ndarray, radius: int) -> np.ndarray:
    """Blur-fusion in double precision, all channels at once."""
    alpha = matte[..., None].astype(np.float64)
    front = back = image.astype(np.float64)
    for r in (radius, max(1, radius // 2), max(1, radius // 8)):
        mean_f, mean_b = (
            box_mean(color * weight, r) / (box_mean(weight, r) + 1e-5)[..., None]
            for color, weight in ((front, alpha**3), (back, (1 - alpha) ** 3))
        )
        front = np.clip(mean_f + alpha * (image - alpha * mean_f - (1 - alpha) * mean_b), 0, 1)
        back = mean_b
    return front


def test_foreground_color_is_its_definition() -> None:
    rng = np.random.default_rng(2)
    image = cv2.GaussianBlur(rng.random((60, 50, 3)).astype(np.float32), (0, 0), 1)
    matte = disc(60, 25, 30, 18, softness=9)[:, :50]
    expected = foreground_color_by_definition(image, matte, 12)
    np.testing.assert_allclose(foreground_color(image, matte, 12), expected, atol=2e-4)


def scene(side: int, left: int, top: int) -> np.ndarray:
    image = np.full((300, 420, 3), (150, 160, 165), np.uint8)
    image[top : top + side, left : left + side] = draw_face(side)
    return image


def test_mattes_of_a_batch_are_those_of_single_frames() -> None:
    segmenter = PersonSegmenter()
    frames = np.stack([scene(200, 60 + 30 * i, 60) for i in range(3)])
    boxes = np.array([[60 + 30 * i + 48.0, 80, 60 + 30 * i + 152, 230] for i in range(3)])
    boxes[2] = np.nan
    together = segmenter.segment(frames, boxes)
    assert together.shape == (3, 300, 420) and together.dtype == np.float32
    assert 0 <= together.min() and together.max() <= 1
    for i in range(3):
        alone = segmenter.segment(frames[i : i + 1], boxes[i : i + 1])[0]
        np.testing.assert_allclose(alone, together[i], atol=1e-3)
    np.testing.assert_allclose(segmenter.segment(frames[2:])[0], together[2], atol=1e-3)


def test_a_face_box_at_the_border_and_outside_is_harmless() -> None:
    segmenter, frame = PersonSegmenter(), scene(200, 0, 0)[None]
    whole = segmenter.segment(frame)
    corner = segmenter.segment(frame, np.array([[-20.0, -20, 60, 60]]))
    assert np.isfinite(corner).all()
    np.testing.assert_array_equal(corner[0, 200:, 250:], whole[0, 200:, 250:])
    np.testing.assert_array_equal(segmenter.segment(frame, np.array([[-900.0, -900, -800, -800]])), whole)


@pytest.mark.golden
def test_a_green_screen_silhouette_is_found(videos_dir: Path, golden_dir: Path) -> None:
    """d0 has a green wall: chroma gives the true silhouette; refined mattes differ on less than 1 % of pixels."""
    points = np.load(golden_dir / "landmarks" / "d0.npz")["tracking"][:5, :, :2]
    with av.open(str(videos_dir / "d0.mp4")) as container:
        decoded = [f.to_ndarray(format="rgb24") for f, _ in zip(container.decode(video=0), range(5), strict=False)]
    frames = np.stack(decoded)
    mattes = PersonSegmenter().segment(frames, np.concatenate([points.min(1), points.max(1)], 1))
    for frame, matte in zip(frames[::2], mattes[::2], strict=True):
        red, green, blue = np.moveaxis(frame.astype(int), -1, 0)
        truth = green - np.maximum(red, blue) < 30  # half the wall's excess of green
        above = np.zeros_like(truth)
        above[:380] = True  # above the jacket, whose lapel the network mistakes
        refined = head_matte(frame, matte, np.ones_like(matte), head_width_px=300)
        assert ((refined > 0.5) != truth)[above].mean() < 0.01
        assert ((refined > 0.5) != truth)[above].mean() < ((matte > 0.5) != truth)[above].mean()
