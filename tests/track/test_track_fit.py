"""Fitting: the truth is recovered, losses are bridged, results do not depend on how the work is cut."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from track_scene import FPS, N_SHAPE, open_head, true_clip, without

from toonifygb import track
from toonifygb.config import TrackConfig
from toonifygb.errors import FaceError, InputError
from toonifygb.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from toonifygb.structures import Landmarks, TrackedSequence
from toonifygb.track import fitting, gaps

CONFIG = TrackConfig(n_shape=N_SHAPE)


def fitted(landmarks: Landmarks, **options: float | None) -> TrackedSequence:
    return track.fit(landmarks, open_head(), CONFIG, fps=FPS, source_sha256="0" * 64, **options)


def rotation_error_deg(fit: TrackedSequence, truth: TrackedSequence) -> torch.Tensor:
    ours, true = (_head_turn(sequence) for sequence in (fit, truth))
    return torch.rad2deg(matrix_to_axis_angle(ours.mT @ true).norm(dim=-1))


def _head_turn(sequence: TrackedSequence) -> torch.Tensor:
    """Head to world: the root's turn, then the neck's."""
    turns = axis_angle_to_matrix(sequence.motion.joints[:, :2])
    return turns[:, 0] @ turns[:, 1]


@pytest.fixture(scope="module")
def truth() -> TrackedSequence:
    return true_clip(noise_px=0.3)


@pytest.fixture(scope="module")
def fit(truth: TrackedSequence) -> TrackedSequence:
    return fitted(truth.landmarks, focal_px=float(truth.camera.K[0, 0]))


def test_pose_jaw_lids_gaze_and_identity_are_recovered(fit: TrackedSequence, truth: TrackedSequence) -> None:
    # 0.3 px of noise on 478 landmarks leaves little; what remains is the priors' pull towards the mean face.
    assert rotation_error_deg(fit, truth).max() < 1.0
    jaw = torch.rad2deg((fit.motion.joints[:, 2, 0] - truth.motion.joints[:, 2, 0]).abs())
    assert jaw.mean() < 1.0
    gaze = torch.rad2deg((fit.motion.joints[:, 3:, :2] - truth.motion.joints[:, 3:, :2]).abs())
    assert gaze.mean() < 2.0
    ours, _ = open_head().forward(fit.shape, fit.motion)
    true, _ = open_head().forward(truth.shape, truth.motion)
    skin = open_head().regions["face"] > 0.5
    away = ((ours - ours[:, skin].mean(1, keepdim=True)) - (true - true[:, skin].mean(1, keepdim=True)))[:, skin]
    assert 1000 * away.norm(dim=-1).mean() < 2.0
    assert fit.error_px.max() < 1.0
    assert bool(fit.tracked.all())


def test_a_blink_stays_sharp(fit: TrackedSequence, truth: TrackedSequence) -> None:
    middle = truth.n_frames // 2
    assert truth.motion.eyelids[middle, 0] == pytest.approx(1.0)
    assert fit.motion.eyelids[middle].min() > 0.8
    assert fit.motion.eyelids[middle - 5].max() < 0.25
    assert fit.motion.eyelids[:, 0].argmax() == middle


def test_a_given_focal_length_is_kept_and_an_unknown_one_stays_plausible(truth: TrackedSequence) -> None:
    assert float(fitted(truth.landmarks, focal_px=700.0).camera.K[0, 0]) == pytest.approx(700.0)
    estimated = float(fitted(truth.landmarks).camera.K[0, 0])
    expected = fitting.expected_focal(512, 512, float(fitting.face_size(truth.landmarks.points).median()))
    assert abs(math.log(estimated / expected)) < 0.2


def test_the_result_explains_itself_through_the_head_model(fit: TrackedSequence) -> None:
    """The reported error is that of the shared records, recomputed with the head model alone."""
    from toonifygb.geometry.cameras import project

    points, _ = open_head().landmarks().forward(fit.shape, fit.motion)
    pixels, _ = project(fit.camera, points)
    observed = fit.landmarks.points
    size = (observed.amax(1) - observed.amin(1)).amax(-1)
    error = (pixels - observed).norm(dim=-1).mean(-1) * 230 / size
    torch.testing.assert_close(fit.error_px, error, rtol=1e-3, atol=1e-3)


def test_lost_frames_are_bridged_and_marked(truth: TrackedSequence) -> None:
    gap = list(range(7, 11))
    fit = fitted(without(truth.landmarks, gap), focal_px=float(truth.camera.K[0, 0]))
    assert fit.tracked.tolist() == [index not in gap for index in range(truth.n_frames)]
    assert bool(fit.error_px[gap].isnan().all())
    assert bool(fit.motion.joints.isfinite().all())
    # The head turns at nearly constant speed there, so the bridge follows it.
    assert rotation_error_deg(fit, truth)[gap].max() < 4.0
    steps = matrix_to_axis_angle(_head_turn(fit)[6:10].mT @ _head_turn(fit)[7:11])
    torch.testing.assert_close(steps, steps[:1].expand_as(steps), rtol=0, atol=1e-4)


def test_losses_at_both_ends_stand_still(truth: TrackedSequence) -> None:
    fit = fitted(without(truth.landmarks, [0, 1, truth.n_frames - 1]))
    torch.testing.assert_close(fit.motion.joints[0], fit.motion.joints[2], rtol=0, atol=0)
    torch.testing.assert_close(fit.motion.translation[-1], fit.motion.translation[-2], rtol=0, atol=0)


def test_a_frame_that_leaps_away_is_bridged(truth: TrackedSequence) -> None:
    points = truth.landmarks.points.clone()
    points[5] += torch.tensor([90.0, -40.0])
    fit = fitted(replace(truth.landmarks, points=points))
    assert fit.tracked.logical_not().nonzero().flatten().tolist() == [5]
    around = fit.motion.translation[4:7]
    assert (around[1] - (around[0] + around[2]) / 2).norm() < 1e-4


def test_quick_motion_in_a_slow_clip_is_no_leap(truth: TrackedSequence) -> None:
    points = truth.landmarks.points.clone()
    points[5] += torch.tensor([90.0, -40.0])
    assert gaps.jumps(points, 25.0).nonzero().flatten().tolist() == [5]
    assert not bool(gaps.jumps(points, 5.0).any())


def test_a_frame_that_is_no_face_is_bridged(truth: TrackedSequence) -> None:
    points = truth.landmarks.points.clone()
    points[11] = points[11][torch.randperm(478, generator=torch.Generator().manual_seed(0))]
    fit = fitted(replace(truth.landmarks, points=points))
    assert not bool(fit.tracked[11])
    assert int(fit.tracked.sum()) == truth.n_frames - 1


def test_one_frame_is_enough(truth: TrackedSequence) -> None:
    still = Landmarks(truth.landmarks.points[:1], truth.landmarks.score[:1], 512, 512)
    fit = fitted(still, focal_px=float(truth.camera.K[0, 0]))
    assert fit.n_frames == 1
    assert fit.error_px[0] < 1.0


def test_two_frames_are_enough(truth: TrackedSequence) -> None:
    pair = Landmarks(truth.landmarks.points[:2], truth.landmarks.score[:2], 512, 512)
    assert fitted(pair).error_px.max() < 1.0


def test_a_clip_without_a_face_is_refused(truth: TrackedSequence) -> None:
    with pytest.raises(FaceError, match="none of the 16 frames shows a face"):
        fitted(without(truth.landmarks, slice(None)))


@pytest.mark.parametrize("focal", [0.0, -5.0, math.nan, math.inf])
def test_an_impossible_focal_length_is_refused(truth: TrackedSequence, focal: float) -> None:
    with pytest.raises(InputError, match="focal length"):
        fitted(truth.landmarks, focal_px=focal)


def test_stretches_give_the_same_motion_as_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    long = true_clip(48, noise_px=0.3)
    focal = float(long.camera.K[0, 0])
    whole = fitted(long.landmarks, focal_px=focal)
    monkeypatch.setattr(fitting, "CHUNK", 16)
    monkeypatch.setattr(fitting, "HALO", 12)
    pieces = fitted(long.landmarks, focal_px=focal)
    torch.testing.assert_close(pieces.shape, whole.shape, rtol=0, atol=1e-3)
    # The halo is half of what real clips get, and both stop when the energy has settled, not at its minimum.
    assert rotation_error_deg(pieces, whole).max() < 0.1
    assert (pieces.motion.expression - whole.motion.expression).abs().max() < 0.03
    assert 1000 * (pieces.motion.translation - whole.motion.translation).norm(dim=-1).max() < 1.0


def test_the_same_input_gives_the_same_result(fit: TrackedSequence, truth: TrackedSequence) -> None:
    again = fitted(truth.landmarks, focal_px=float(truth.camera.K[0, 0]))
    # Not bit by bit: matrix libraries sum in an order that depends on where memory happens to lie.
    torch.testing.assert_close(again.motion.joints, fit.motion.joints, rtol=0, atol=1e-4)
    torch.testing.assert_close(again.motion.expression, fit.motion.expression, rtol=0, atol=1e-3)
    torch.testing.assert_close(again.shape, fit.shape, rtol=0, atol=1e-3)
    assert torch.equal(again.tracked, fit.tracked)


def test_smoothing_has_no_lag_and_less_jitter_than_the_landmarks() -> None:
    truth = true_clip(28, noise_px=1.0)
    fit = fitted(truth.landmarks, focal_px=float(truth.camera.K[0, 0]))
    yaw, true_yaw = (matrix_to_axis_angle(_head_turn(sequence))[:, 1] for sequence in (fit, truth))
    shifted = {lag: float((yaw[4:-4] - true_yaw[4 - lag : 24 - lag]).abs().mean()) for lag in (-1, 0, 1)}
    assert shifted[0] < min(shifted[-1], shifted[1])
    points, _ = open_head().landmarks().forward(fit.shape, fit.motion)
    from toonifygb.geometry.cameras import project

    assert track.jitter_px(project(fit.camera, points)[0]) < 0.6 * track.jitter_px(truth.landmarks.points)


def test_progress_counts_frames(truth: TrackedSequence) -> None:
    seen: list[tuple[int, int | None]] = []

    class Watch:
        def update(self, done: int, total: int | None, **figures: float) -> None:
            seen.append((done, total))

    track.fit(truth.landmarks, open_head(), CONFIG, fps=FPS, source_sha256="", progress=Watch())
    assert seen[-1] == (truth.n_frames, truth.n_frames)
