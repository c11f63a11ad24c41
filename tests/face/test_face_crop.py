"""Squares of an image: geometry, and resampling against slicing and averaging."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from toonifygb.face.crop import Square, as_batch, cut


@pytest.fixture
def image() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 255, (90, 120, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3)


def test_an_upright_square_of_the_same_size_is_a_slice(image: np.ndarray) -> None:
    np.testing.assert_array_equal(cut(image, Square(50, 40, 32), 32), image[24:56, 34:66])


def test_outside_is_replicated_or_black(image: np.ndarray) -> None:
    corner = Square(0, 0, 32)
    np.testing.assert_array_equal(cut(image, corner, 32)[:16, :16], np.broadcast_to(image[0, 0], (16, 16, 3)))
    assert not cut(image, corner, 32, border=cv2.BORDER_CONSTANT)[:15, :15].any()


def test_a_quarter_turn_is_a_rotated_slice(image: np.ndarray) -> None:
    turned = cut(image, Square(50, 40, 32, np.pi / 2), 32).astype(int)
    expected = np.rot90(image[24:56, 35:67]).astype(int)
    assert np.abs(turned - expected)[1:-1, 1:-1].max() <= 1


def test_points_come_back_to_where_they_were_sampled() -> None:
    square = Square(50, 40, 30, 0.7)
    inside = np.random.default_rng(1).random((20, 2))
    matrix = square.matrix(192)
    np.testing.assert_allclose(square.to_image(inside), 192 * inside @ matrix[:, :2].T + matrix[:, 2])
    np.testing.assert_allclose(square.to_image(np.array([0.5, 0.5])), [50, 40])


def test_a_large_square_is_averaged_not_skipped() -> None:
    """Every pixel counts: a fine chequerboard becomes grey. The position of a ramp is kept."""
    board = (np.indices((960, 960)).sum(0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, 2)
    assert np.abs(cut(board, Square(480, 480, 960), 96).astype(int) - 128).max() <= 2
    ramp = np.broadcast_to(np.arange(960) * 255 / 960, (960, 960))[..., None].repeat(3, 2).astype(np.uint8)
    result = cut(ramp, Square(480, 480, 800), 100)[50, :, 0].astype(float)
    expected = (80 + np.arange(100) * 8) * 255 / 960  # samples at corner + index · step
    assert np.abs(result - expected)[1:-1].max() <= 1.5


def test_batches_are_planar_and_between_0_and_1(image: np.ndarray) -> None:
    batch = as_batch([image[:32, :32], image[32:64, :32]], "cpu")
    assert batch.shape == (2, 3, 32, 32)
    np.testing.assert_allclose(batch[1].permute(1, 2, 0).numpy() * 255, image[32:64, :32], atol=1e-4)
