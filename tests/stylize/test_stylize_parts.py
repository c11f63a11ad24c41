"""The parts of the styles: warp, anchors, filters, noise, calming."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import stylize_scene as scene
import torch

from toonifygb import stylize
from toonifygb.structures import Landmarks
from toonifygb.stylize import anchors, exaggerate, filters, steady, textures
from toonifygb.stylize.exaggerate import Exaggeration

CARICATURE = Exaggeration(eye_gain=1.3, chin=0.03)


def random_lab(height: int, width: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.uniform(0, 100, (height, width, 3)).astype(np.float32), (0, 0), 1.5)


# --- warp ---------------------------------------------------------------------------------------------------------


def test_moved_points_are_where_the_picture_moved_to() -> None:
    points = scene.face_at(300, 300)
    moved = exaggerate.move_points(points, CARICATURE)
    back = moved + exaggerate.offsets(moved, points, CARICATURE)
    assert np.abs(moved - points).max() > 2.0
    assert np.abs(back - points).max() < 0.02  # twelve halvings of a few px


def test_eyes_grow_by_the_gain_and_blinks_do_not_move_the_region() -> None:
    points = scene.face_at(300, 300)
    eye = anchors.EYES[0]
    moved = exaggerate.move_points(points, Exaggeration(eye_gain=1.3))
    rim = list(eye.rim)
    grown = np.linalg.norm(moved[rim[0]] - moved[rim[2]]) / np.linalg.norm(points[rim[0]] - points[rim[2]])
    assert grown == pytest.approx(1.3, abs=0.01)
    closed = points.copy()
    closed[list(eye.upper[1:-1])] = closed[list(eye.lower[1:-1])]
    grid = scene.face_at(300, 300)
    assert np.array_equal(
        exaggerate.offsets(grid, points, CARICATURE), exaggerate.offsets(grid, closed, CARICATURE)
    )


def test_warp_is_one_to_one() -> None:
    points = scene.face_at(200, 200)
    grid = filters.pixel_grid(200, 200) + 0.5
    where = grid + exaggerate.offsets(grid, points, Exaggeration(eye_gain=1.35, chin=0.04))
    along_x, along_y = np.gradient(where, axis=1), np.gradient(where, axis=0)
    area = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
    assert area.min() > 0.3


def test_warp_leaves_the_rest_alone() -> None:
    frame = scene.frames(1, 200, 160, noise=20)[0]
    out = exaggerate.warp(frame, scene.face_at(200, 160), CARICATURE)
    assert not np.array_equal(out, frame)
    assert np.array_equal(out[:20], frame[:20])
    assert exaggerate.warp(frame, scene.face_at(200, 160), Exaggeration()) is frame


def test_warp_in_boxes_is_the_warp_of_the_whole_picture() -> None:
    frame = scene.frames(1, 200, 160, noise=20)[0]
    grid = filters.pixel_grid(*frame.shape[:2])
    for points in (
        scene.face_at(200, 160),
        scene.face_at(200, 160) + np.float32([70, -60]),
    ):  # the second is cut off
        where = grid + exaggerate.offsets(grid + np.float32(0.5), points, CARICATURE)
        expected = filters.sample(frame, where, cv2.INTER_CUBIC)
        assert np.array_equal(exaggerate.warp(frame, points, CARICATURE), expected)


def test_picture_follows_the_warp() -> None:
    """A dot drawn at an iris is found where ``move_points`` says."""
    points = scene.face_at(300, 300)
    target = points[anchors.EYES[0].iris] + np.float32([9, 4])
    y, x = np.mgrid[:300, :300].astype(np.float32) + 0.5
    dot = np.exp(-0.5 * ((x - target[0]) ** 2 + (y - target[1]) ** 2) / 1.5**2)
    out = exaggerate.warp(dot, points, CARICATURE)
    out = np.maximum(out - 0.3, 0)
    centre = np.array([(out * x).sum(), (out * y).sum()]) / out.sum()
    expected = exaggerate.move_points(target[None], CARICATURE, points)[0]
    # the dot is stretched unevenly, so its centre is not quite the image of its centre
    assert np.abs(centre - expected).max() < 0.25
    assert np.abs(expected - target).max() > 1.0


def test_warped_landmarks_keep_gaps() -> None:
    marks = scene.landmarks(5, 200, 200, lost=[2])
    moved = stylize.warp_landmarks(marks, stylize.get("toon"))
    assert torch.equal(moved.valid, marks.valid)
    assert torch.equal(stylize.warp_landmarks(marks, stylize.get("none")).points[0], marks.points[0])
    half = stylize.warp_landmarks(marks, stylize.get("toon"), strength=0.5)
    shift = (moved.points[0] - marks.points[0]).norm(dim=-1).max()
    assert 0.3 * shift < (half.points[0] - marks.points[0]).norm(dim=-1).max() < 0.8 * shift


def test_warped_frames_have_the_outlines_of_the_style() -> None:
    pictures = scene.frames(2, 200, 200, noise=20)
    marks = scene.landmarks(2, 200, 200)
    plain = list(stylize.warp_frames(pictures, marks, stylize.get("none")))
    assert all(np.array_equal(ours, theirs) for ours, theirs in zip(plain, pictures, strict=True))
    warped = list(stylize.warp_frames(pictures, marks, stylize.get("toon")))
    assert len(warped) == 2
    amount = stylize.get("toon").exaggeration
    expected = exaggerate.warp(pictures[0], stylize.follow(marks).points[0], amount)
    assert np.array_equal(warped[0], expected)
    assert not np.array_equal(warped[0], pictures[0])


# --- anchors ------------------------------------------------------------------------------------------------------


def test_presence_fades_beside_lost_spans() -> None:
    faces = stylize.follow(scene.landmarks(40, 100, 100, lost=range(15, 20)))
    assert (faces.presence[15:20] == 0).all()
    assert (faces.presence[:9] == 1).all() and (faces.presence[26:] == 1).all()
    assert (np.diff(faces.presence[9:16]) < 0).all()
    assert np.isfinite(faces.points).all()


def test_lost_frames_are_bridged_in_a_straight_line() -> None:
    faces = stylize.follow(scene.landmarks(9, 400, 400, shift_px=0.5, lost=[4]))
    assert faces.points[4, 1, 0] == pytest.approx(200 + 0.5 * 4, abs=0.05)


def test_no_face_at_all() -> None:
    faces = stylize.follow(scene.landmarks(3, 100, 100, lost=[0, 1, 2]))
    assert (faces.presence == 0).all() and np.isfinite(faces.points).all()


def test_jitter_is_calmed_and_motion_kept() -> None:
    rng = np.random.default_rng(1)
    marks = scene.landmarks(60, 500, 500)
    still = marks.points.numpy()
    noisy = still + rng.normal(0, 0.5, still.shape).astype(np.float32)
    noisy[30:] += 25.0  # a jump of a tenth of the face
    faces = stylize.follow(Landmarks(torch.from_numpy(noisy), marks.score, 500, 500))
    jitter = np.abs(np.diff(faces.points[:28], axis=0)).mean() / np.abs(np.diff(noisy[:28], axis=0)).mean()
    assert jitter < 0.5
    assert (
        np.abs(faces.points[29] - still[29]).mean() < 0.6 and np.abs(faces.points[30] - still[30] - 25).mean() < 0.6
    )


def test_mask_is_the_same_in_its_box_as_in_the_whole() -> None:
    points = scene.face_at(120, 90)
    polygon = points[list(anchors.LIPS)]
    whole = np.zeros((90, 120), np.uint8)
    anchors.draw(whole, polygon)
    whole = filters.blur(whole.astype(np.float32) / 255, 2.5)
    assert np.abs(anchors.mask((90, 120), [polygon], 2.5) - whole).max() < 0.005  # the tail beyond three sigma


def test_mask_outside_the_picture_is_empty() -> None:
    assert anchors.mask((20, 20), [scene.face_at(20, 20) + 500], 2.0).sum() == 0


# --- filters ------------------------------------------------------------------------------------------------------


def slow_kuwahara(lab, tangents, anisotropy, radius):
    """The definition, pixel by pixel and sector by sector."""
    height, width = lab.shape[:2]
    sigma, reach = 0.35 * radius, 0.75 * radius
    mean = cv2.GaussianBlur(lab, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101).astype(np.float64)
    square = cv2.GaussianBlur((lab * lab).sum(-1), (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
    weight = (1 + np.maximum(square - (mean**2).sum(-1), 0)) ** -4.0
    table = np.concatenate([mean * weight[..., None], weight[..., None]], -1)
    out = np.zeros(lab.shape)

    def reflect(i, n):
        i = abs(i) % (2 * (n - 1))
        return min(i, 2 * (n - 1) - i)

    def bilinear(x, y):
        x0, y0 = int(np.floor(x)), int(np.floor(y))
        total = np.zeros(4)
        for dy in (0, 1):
            for dx in (0, 1):
                share = (1 - abs(x - x0 - dx)) * (1 - abs(y - y0 - dy))
                total += share * table[reflect(y0 + dy, height), reflect(x0 + dx, width)]
        return total

    for row in range(height):
        for column in range(width):
            t = tangents[row, column].astype(np.float64)
            n = np.array([-t[1], t[0]])
            stretch = 1.0 + anisotropy[row, column]
            total = np.zeros(4)
            for sector in range(8):
                angle = 2 * np.pi * sector / 8
                offset = reach * (stretch * np.cos(angle) * t + np.sin(angle) / stretch * n)
                total += bilinear(column + offset[0], row + offset[1])
            out[row, column] = total[:3] / total[3]
    return out


def test_kuwahara_is_its_definition() -> None:
    lab = random_lab(24, 31)
    tangents, anisotropy = filters.structure(lab, 2.0)
    fast = filters.kuwahara(lab, tangents, anisotropy, 4.0)
    # OpenCV's look-up rounds positions to 1/32 px; colours here change by at most about 15 L per px
    assert np.abs(fast - slow_kuwahara(lab, tangents, anisotropy, 4.0)).max() < 1.0


def test_kuwahara_keeps_edges_and_flattens_noise() -> None:
    rng = np.random.default_rng(0)
    lab = np.zeros((64, 64, 3), np.float32)
    lab[:, 32:, 0] = 80
    lab[:, :, 0] += 10
    noisy = lab + rng.normal(0, 3, lab.shape).astype(np.float32)
    out = filters.kuwahara(noisy, *filters.structure(noisy, 2.0), 5.0)
    assert out[8:-8, 8:24, 0].std() < 1.0
    assert (out[8:-8, 36, 0] - out[8:-8, 28, 0]).mean() > 75


def test_tangents_follow_an_edge_and_rest_in_the_flat() -> None:
    lab = np.zeros((40, 40, 3), np.float32)
    lab[:, 20:, 0] = 60
    tangents, clarity = filters.structure(lab, 2.0, rest=(0.5, 1.0))
    assert np.abs(tangents[20, 20, 1]) > 0.999 and clarity[20, 20] > 0.9
    assert np.abs(tangents[20, 2] @ [np.cos(0.5), np.sin(0.5)]) == pytest.approx(1.0, abs=1e-4)


def test_ink_answers_on_the_dark_side_of_an_edge() -> None:
    tone = np.full((40, 40), 80, np.float32)
    tone[:, 20:] = 20
    tangents, _ = filters.structure(np.dstack([tone] * 3), 2.0)
    response = filters.ink_response(tone, tangents, 1.2)[20]
    assert 19 < response.argmax() < 24 and response.max() > 4
    assert np.abs(response[:12]).max() < 0.05


def test_band_curve_gathers_tones() -> None:
    curve = filters.band_curve([20.0, 50.0, 80.0], softness=2.0, remain=0.0)
    tones = np.array([[10.0, 30.0, 40.0, 60.0, 70.0, 95.0]], np.float32)
    assert np.allclose(filters.curve_lookup(tones, curve), [[20, 20, 50, 50, 80, 80]], atol=1e-3)
    assert (np.diff(filters.band_curve([20.0, 50.0, 80.0], 2.0, 0.3)) >= 0).all()


def test_clusters_find_the_levels() -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(level, 1.0, 400) for level in (15, 45, 85)])
    assert np.allclose(filters.cluster_levels(values, 3), [15, 45, 85], atol=0.5)
    assert filters.cluster_levels(np.full(10, 7.0), 3) == [7.0, 7.0, 7.0]


def test_wide_blur_is_a_blur() -> None:
    picture = random_lab(120, 160, seed=4)
    assert np.abs(filters.wide_blur(picture, 14.0) - filters.blur(picture, 14.0)).max() < 1.0


# --- textures -----------------------------------------------------------------------------------------------------


def test_noise_rides_on_the_head() -> None:
    template = scene.face_at(300, 300)
    noise = [
        textures.anchored_noise((300, 300), scene.face_at(300, 300, shift), 1.0, template, 135.0, 0.03, 1)
        for shift in (0.0, 12.0)
    ]
    inside, outside = (slice(120, 180), slice(130, 170)), (slice(5, 40), slice(5, 60))
    moved = np.roll(noise[1], -12, axis=1)
    assert np.abs(noise[0][inside] - moved[inside]).max() < 0.05
    assert np.abs(noise[0][outside] - noise[1][outside]).max() < 1e-4  # the far tail of a soft mask
    assert 0.8 < noise[0].std() < 1.2


def test_tile_repeats_without_a_seam() -> None:
    tile = textures.noise_tile(2.0, 3)
    across = np.abs(tile[:, 0] - tile[:, -1]).mean()
    assert across < 1.5 * np.abs(np.diff(tile, axis=1)).mean()


# --- calming ------------------------------------------------------------------------------------------------------


def test_calming_removes_noise_and_keeps_motion() -> None:
    clean = scene.frames(3, 160, 128, shift_px=2.0)
    noisy = scene.frames(3, 160, 128, shift_px=2.0, noise=5.0)
    error = [np.abs(frame.astype(float) - clean[1]).mean() for frame in (noisy[1], steady.calmed(noisy, 1))]
    assert error[1] < 0.75 * error[0]
    assert np.abs(steady.calmed(clean, 1).astype(int) - clean[1]).mean() < 0.6


def test_a_cut_does_not_bleed() -> None:
    before, after = np.full((64, 64, 3), 30, np.uint8), np.full((64, 64, 3), 200, np.uint8)
    assert np.array_equal(steady.calmed([before, after, after], 1), after)


def test_large_frames_are_calmed_small() -> None:
    noisy = scene.frames(3, 1100, 400, noise=5.0)
    assert np.abs(steady.calmed(noisy, 1).astype(float) - noisy[1]).mean() > 0.5
