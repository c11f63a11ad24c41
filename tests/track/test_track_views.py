"""What is drawn and measured on a track: overlay, boxes, region, steadiness, choice of the video."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from track_scene import SIZE, open_head, true_clip, without

from toonifygb import track
from toonifygb.structures import Landmarks, TrackedSequence
from toonifygb.track import overlay
from toonifygb.track.source import lasting_displacement


@pytest.fixture(scope="module")
def sequence() -> TrackedSequence:
    return true_clip(6)


def grey() -> np.ndarray:
    return np.full((SIZE, SIZE, 3), 90, np.uint8)


def pixel(image: np.ndarray, point: torch.Tensor) -> np.ndarray:
    x, y = point.tolist()
    return image[int(y), int(x)]


def test_overlay_draws_on_the_head_and_nowhere_else(sequence: TrackedSequence) -> None:
    frame = grey()
    drawn = track.overlay.draw(frame, sequence, 3, open_head())
    assert drawn.shape == frame.shape
    assert drawn.dtype == np.uint8
    assert (frame == 90).all()
    changed = (drawn != frame).any(-1)
    left, top, right, bottom = (
        sequence.landmarks.points[3].amin(0).tolist() + sequence.landmarks.points[3].amax(0).tolist()
    )
    inside = changed[int(top) : int(bottom), int(left) : int(right)]
    assert inside.mean() > 0.9
    assert not changed[:, :20].any()
    assert not changed[:8].any()


def test_overlay_puts_contours_on_the_landmarks(sequence: TrackedSequence) -> None:
    drawn = track.overlay.draw(grey(), sequence, 0, open_head())
    for number in (61, 291, 0, 17):  # corners and edges of the lips, drawn in red
        red, green, _ = pixel(drawn, sequence.landmarks.points[0, number]).astype(int)
        assert red > green + 40


def test_overlay_marks_frames_without_a_face(sequence: TrackedSequence) -> None:
    lost = replace(sequence, tracked=torch.zeros(6, dtype=torch.bool))
    drawn = track.overlay.draw(grey(), lost, 0, open_head())
    assert (drawn == np.array([255, 176, 64])).all(-1).any()
    assert not np.array_equal(drawn, track.overlay.draw(grey(), sequence, 0, open_head()))


def test_overlay_of_a_head_outside_the_image_is_the_image(sequence: TrackedSequence) -> None:
    away = replace(sequence.motion, translation=sequence.motion.translation + torch.tensor([3.0, 0.0, 0.0]))
    frame = grey()
    assert np.array_equal(track.overlay.draw(frame, replace(sequence, motion=away), 0, open_head()), frame)


def test_overlay_works_at_any_image_size(sequence: TrackedSequence) -> None:
    small = np.zeros((40, 300, 3), np.uint8)
    assert track.overlay.draw(small, sequence, 0, open_head()).shape == small.shape


def test_the_surface_is_that_painted_in_colour(sequence: TrackedSequence) -> None:
    """One channel of tones looked up in a table, blended in one pass, against three channels blended in float."""
    pose = track.Overlay(sequence, open_head())._project(3)
    canvas = np.random.default_rng(0).integers(0, 256, (SIZE, SIZE, 3), np.uint8)
    layer = np.zeros_like(canvas)
    colors = np.clip(pose.shade[:, None] * overlay.SKIN, 1, 255)
    corners = np.round((pose.vertices[pose.faces] - 0.5) * 2**overlay.SHIFT).astype(np.int32)
    for triangle, color in zip(corners, colors.tolist(), strict=True):
        cv2.fillConvexPoly(layer, triangle, color, cv2.LINE_8, overlay.SHIFT)
    soft = (
        cv2.GaussianBlur((layer.max(-1) > 0).astype(np.float64), (0, 0), 2.0)[..., None] * overlay.SURFACE_OPACITY
    )
    expected = canvas * (1 - soft) + layer * soft
    found = overlay._surface(canvas, pose, overlay.SKIN)
    assert (found != canvas).any(-1).mean() > 0.1
    assert np.abs(found - expected).max() < 1


def test_one_overlay_draws_any_frame(sequence: TrackedSequence) -> None:
    kept = track.Overlay(sequence, open_head())
    for index in (2, 0):
        assert np.array_equal(kept(grey(), index), track.overlay.draw(grey(), sequence, index, open_head()))


def test_boxes_hold_their_points(sequence: TrackedSequence) -> None:
    boxes = track.head_boxes(sequence, open_head())
    points = sequence.landmarks.points
    torch.testing.assert_close(boxes.face, torch.cat([points.amin(1), points.amax(1)], -1), rtol=0, atol=0.05)
    width = boxes.head[:, 2] - boxes.head[:, 0]
    face_width = boxes.face[:, 2] - boxes.face[:, 0]
    assert bool((width >= face_width).all())
    assert bool((boxes.head[:, 1] < boxes.face[:, 1]).all())


def head_region(sequence: TrackedSequence) -> torch.Tensor:
    """Region of the first frame, ending where the neck does."""
    camera, head = sequence.camera, open_head()
    mask = track.HeadRegion(sequence, head)(0)
    first, kept = track.neck_cuts(sequence, head).rows(0, camera.height, camera.width)
    mask[first:] *= kept
    return mask


def test_region_holds_face_and_hair_and_neck_but_not_the_shoulders(sequence: TrackedSequence) -> None:
    head = open_head()
    mask = head_region(sequence)
    assert mask.shape == (SIZE, SIZE)
    assert 0 <= float(mask.min()) <= float(mask.max()) <= 1
    points, box = sequence.landmarks.points[0], track.head_boxes(sequence, head).head[0]
    assert float(mask[points[:, 1].long(), points[:, 0].long()].min()) > 0.99
    middle = float((box[0] + box[2]) / 2)
    height = float(box[3] - box[1])
    above, below = round(float(box[1]) - 0.08 * height), round(float(box[3]) + 0.08 * height)
    assert float(mask[max(above, 0), round(middle)]) > 0.9
    assert float(mask[below, round(middle)]) > 0.9
    assert float(mask[min(round(float(box[3]) + 0.45 * height), SIZE - 1), round(middle)]) < 0.05
    assert float(mask[:, 2].max()) == 0.0


def test_region_moves_with_the_head(sequence: TrackedSequence) -> None:
    still = head_region(sequence)
    moved = replace(sequence.motion, translation=sequence.motion.translation + torch.tensor([0.05, 0.0, 0.0]))
    other = head_region(replace(sequence, motion=moved))
    x = torch.arange(SIZE) + 0.5
    shift = float((other.sum(0) * x).sum() / other.sum() - (still.sum(0) * x).sum() / still.sum())
    focal, depth = float(sequence.camera.K[0, 0]), 0.65
    assert shift == pytest.approx(0.05 * focal / depth, rel=0.15)


def test_region_of_a_picture_larger_than_the_grid_is_the_same_region(sequence: TrackedSequence) -> None:
    camera = replace(
        sequence.camera, K=sequence.camera.K * torch.tensor([[2.0], [2.0], [1.0]]), width=1024, height=1024
    )
    large = head_region(replace(sequence, camera=camera))
    halved = torch.nn.functional.avg_pool2d(large[None, None], 2)[0, 0]
    # Both come from one grid of 256 px, once doubled and once fourfold.
    assert (halved - head_region(sequence)).abs().max() < 0.02


def test_a_nod_leaves_the_end_of_the_neck_where_it_is(sequence: TrackedSequence) -> None:
    joints = sequence.motion.joints.clone()
    joints[:, 1, 0] += 0.3
    still = track.neck_cuts(sequence, open_head())
    nodded = track.neck_cuts(replace(sequence, motion=replace(sequence.motion, joints=joints)), open_head())
    assert torch.equal(nodded.normal, still.normal) or (nodded.normal - still.normal).abs().max() < 0.02
    middle = torch.tensor([SIZE / 2, 0.0])
    ends = [(cuts.reach - cuts.normal @ middle) / cuts.normal[:, 1] for cuts in (still, nodded)]
    assert (ends[1] - ends[0]).abs().max() < 0.01 * SIZE
    turned = sequence.motion.joints.clone()
    turned[:, 0, 2] += 0.3  # the whole body leans over, and the cut with it
    leaning = track.neck_cuts(replace(sequence, motion=replace(sequence.motion, joints=turned)), open_head())
    angle = torch.atan2(leaning.normal[:, 0], leaning.normal[:, 1]) - torch.atan2(
        still.normal[:, 0], still.normal[:, 1]
    )
    assert (angle.abs() - 0.3).abs().max() < 0.05


def test_cuts_in_crops_are_the_same_cuts(sequence: TrackedSequence) -> None:
    cuts = track.neck_cuts(sequence, open_head())
    n = sequence.n_frames
    boxes = torch.tensor([[40.0, 60.0, 440.0, 460.0]]).expand(n, -1)
    first, full = cuts.rows(0, SIZE, SIZE)
    whole = torch.cat([torch.ones(first, SIZE), full])[60:460, 40:440]
    first, part = cuts.within(boxes, 200).rows(0, 200, 200)
    small = torch.cat([torch.ones(first, 200), part])
    assert 0 < float(small.mean()) < 1
    assert (small - torch.nn.functional.avg_pool2d(whole[None, None], 2)[0, 0]).abs().max() < 0.01


def test_jitter_is_zero_for_steady_motion_and_three_sigma_for_noise() -> None:
    points = true_clip(3).landmarks.points[:1] + torch.arange(50)[:, None, None] * torch.tensor([1.0, 0.5])
    assert track.jitter_px(points) == pytest.approx(0.0, abs=1e-3)
    noisy = points + torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    size = float((points[0].amax(0) - points[0].amin(0)).max())
    # Second differences of unit noise have variance 6 per axis; the mean length in the plane is √(π/2) √6.
    assert track.jitter_px(noisy) * size / 230 == pytest.approx(3.07, rel=0.05)
    assert np.isnan(track.jitter_px(points[:2]))


def test_report_names_lost_stretches_and_poor_fits(sequence: TrackedSequence) -> None:
    assert track.report(sequence).problems == ()
    tracked = torch.tensor([True, False, False, True, True, False])
    report = track.report(replace(sequence, tracked=tracked, error_px=torch.full((6,), 4.0)))
    assert report.tracked_share == pytest.approx(0.5)
    assert report.problems[0].startswith("frames 1 to 2 have no usable face")
    assert report.problems[1].startswith("frame 5 has no usable face")
    assert "4.0 px" in report.problems[2]


def noisy(landmarks: Landmarks, sigma: float, seed: int = 0) -> Landmarks:
    noise = sigma * torch.randn(landmarks.points.shape, generator=torch.Generator().manual_seed(seed))
    return replace(landmarks, points=landmarks.points + noise)


def test_the_steadier_video_is_tracked() -> None:
    truth = true_clip(20).landmarks
    assert track.choose_source(noisy(truth, 0.5), noisy(truth, 1.5)).on == "original"
    assert track.choose_source(noisy(truth, 1.5), noisy(truth, 0.5)).on == "stylized"


def test_a_style_that_moves_features_is_tracked_if_steady_enough() -> None:
    truth = true_clip(20).landmarks
    middle = truth.points.mean(1, keepdim=True)
    redrawn = replace(truth, points=middle + 1.15 * (truth.points - middle))
    choice = track.choose_source(noisy(truth, 0.5), noisy(redrawn, 0.6, seed=1))
    assert choice.on == "stylized"
    assert "moves the features" in choice.reason
    assert track.choose_source(noisy(truth, 0.5), noisy(redrawn, 3.0, seed=1)).on == "original"


def test_a_style_that_hides_the_face_is_not_tracked() -> None:
    truth = true_clip(20).landmarks
    choice = track.choose_source(noisy(truth, 1.0), without(truth, slice(0, 5)))
    assert choice.on == "original"
    assert "25%" in choice.reason


def test_lasting_displacement_ignores_noise_and_follows_roll() -> None:
    truth = true_clip(20).landmarks.points
    assert lasting_displacement(truth, truth) == pytest.approx(0.0, abs=1e-5)
    middle = truth.mean(1, keepdim=True)
    moved = middle + 1.1 * (truth - middle)
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    assert lasting_displacement(truth, moved + noise) == pytest.approx(lasting_displacement(truth, moved), rel=0.1)
