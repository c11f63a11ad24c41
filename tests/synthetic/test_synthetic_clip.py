"""Synthetic clips: deterministic, true to their parameters, and alive."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np
import pytest
import torch

from toonifygb import synthetic
from toonifygb.errors import InputError
from toonifygb.head import PARTS
from toonifygb.render.mesh import rasterize_mesh
from toonifygb.synthetic import motion as motions
from toonifygb.synthetic import scene
from toonifygb.synthetic.clip import SyntheticClip

SIZE = 128


@pytest.fixture(scope="module")
def subject() -> synthetic.Subject:
    return synthetic.make_subject(2)  # short hair: its outline is nearly the head's


@pytest.fixture(scope="module")
def clip(subject: synthetic.Subject) -> SyntheticClip:
    return synthetic.render_clip(subject, n_frames=60, size=SIZE)


def digest(frame: synthetic.SyntheticFrame) -> str:
    return hashlib.sha256(frame.image.tobytes() + frame.person.tobytes() + frame.head.tobytes()).hexdigest()


def test_the_same_seed_gives_the_same_picture_whatever_the_threads(clip: SyntheticClip) -> None:
    again = synthetic.render_clip(synthetic.make_subject(2), n_frames=60, size=SIZE, threads=1)
    assert digest(clip[31]) == digest(again[31])
    torch.testing.assert_close(clip.sequence.motion.joints, again.sequence.motion.joints, rtol=0, atol=0)
    assert clip.sequence.source_sha256 == again.sequence.source_sha256


def test_frames_differ_in_time_and_between_subjects(clip: SyntheticClip) -> None:
    first, later = clip[0], clip[40]
    assert digest(first) != digest(later)
    other = synthetic.render_clip(synthetic.make_subject(6), n_frames=2, size=SIZE)
    assert not torch.equal(other.sequence.shape, clip.sequence.shape)  # a variation of the same person
    assert other.sequence.source_sha256 != clip.sequence.source_sha256


def test_lighting_only_what_is_seen_changes_no_pixel(clip: SyntheticClip, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = clip[7]
    monkeypatch.setattr(scene, "_seen_vertices", lambda face_id, faces, n_vertices: np.ones(n_vertices, bool))
    everything_lit = clip[7]
    # the linear algebra may round the last bit differently for another number of rows
    assert np.abs(frame.image.astype(int) - everything_lit.image).max() <= 1
    assert np.array_equal(frame.person, everything_lit.person)
    assert np.array_equal(frame.head, everything_lit.head)


def test_shapes_types_and_ranges(clip: SyntheticClip) -> None:
    assert len(clip) == clip.sequence.n_frames == 60
    frame = clip[0]
    in_order = [digest(drawn) for drawn, _ in zip(clip, range(3), strict=False)]
    assert in_order == [digest(clip[index]) for index in range(3)]
    assert np.array_equal(frame.image, next(clip.frames))
    assert frame.image.shape == (SIZE, SIZE, 3)
    assert frame.image.dtype == np.uint8
    for matte in (frame.person, frame.head):
        assert matte.shape == (SIZE, SIZE)
        assert 0 <= matte.min() < matte.max() <= 1
    assert (frame.head <= frame.person + 1e-6).all()
    assert frame.head[-1].max() < 0.01  # the lowest row shows clothes, if anyone


def test_pictures_may_be_oblong(subject: synthetic.Subject) -> None:
    frame = synthetic.render_clip(subject, n_frames=1, size=(160, 96))[0]
    assert frame.image.shape == (96, 160, 3)
    columns = np.flatnonzero(frame.head.max(0) > 0.5)
    assert abs(columns.mean() - 80) < 20


def test_the_matte_covers_the_head_mesh_of_the_true_parameters(clip: SyntheticClip) -> None:
    sequence = clip.sequence
    head = clip.subject.head
    face_only = head.faces[(head.regions["face"][head.faces] > 0.9).all(1)]
    for index in (0, 25, 50):
        vertices, _ = head.forward(sequence.shape, sequence.motion[index])
        face = rasterize_mesh(vertices, face_only, sequence.camera).covered.numpy()
        matte = clip[index].head
        assert face.sum() > 300
        assert matte[face].mean() > 0.995
        assert (clip[index].person < 0.01).mean() > 0.25  # and not everything


def test_true_landmarks_sit_on_what_is_drawn(clip: SyntheticClip) -> None:
    """The iris landmarks are dark, the white beside them is not: the picture agrees with the parameters."""
    big = synthetic.render_clip(clip.subject, size=384, motion=clip.sequence.motion[0:1])
    points, image = big.sequence.landmarks.points[0], big[0].image.astype(float).mean(-1)
    pupil_x, pupil_y = points[468].floor().long().tolist()  # centre of the right iris
    cheek_x, cheek_y = points[50].floor().long().tolist()
    assert image[pupil_y - 1 : pupil_y + 2, pupil_x - 1 : pupil_x + 2].min() < 60
    assert image[cheek_y, cheek_x] > 110
    assert big.sequence.landmarks.valid.all()


def test_drawn_motion_can_be_given(subject: synthetic.Subject, clip: SyntheticClip) -> None:
    shown = synthetic.render_clip(subject, size=SIZE, motion=clip.sequence.motion[10:12])
    assert len(shown) == 2
    assert digest(shown[0]) == digest(clip[10])


def test_motion_is_smooth_bounded_and_varied(subject: synthetic.Subject) -> None:
    motion = motions.make_motion(subject.head, 300, 25.0, seed=3)
    assert 0 <= motion.expression.min() <= motion.expression.max() <= 1
    assert 0 <= motion.eyelids.min() <= motion.eyelids.max() <= 1
    neck = torch.rad2deg(motion.joints[:, 1])
    assert neck[:, 1].abs().max() <= motions.YAW_DEG
    assert neck[:, 1].max() - neck[:, 1].min() > motions.YAW_DEG
    assert neck[:, 0].abs().max() <= motions.PITCH_DEG
    assert neck.diff(dim=0).abs().max() < 3.0  # degrees in 1/25 s
    shut = (motion.eyelids[:, 0] > 0.95).int()
    assert 3 <= int((shut.diff() == 1).sum()) <= 8  # blinks in twelve seconds
    assert (motion.expression.max(0).values > 0.3).float().mean() > 0.6  # most units have their moment
    assert motion.joints[:, 2, 0].max() > 0.2
    gaze_against_head = np.corrcoef(motion.joints[:, 3, 1], motion.joints[:, 1, 1])[0, 1]
    assert gaze_against_head < -0.5


def test_a_clip_may_be_empty(subject: synthetic.Subject) -> None:
    clip = synthetic.render_clip(subject, n_frames=0, size=32)
    assert len(clip) == 0
    assert list(clip) == []


def test_every_expression_family_names_units_of_the_head(subject: synthetic.Subject) -> None:
    names = set(subject.head.expression_names)
    for family in (*motions.FAMILIES, *(weights for _, weights in motions.VISEMES)):
        for name in family:
            assert name == "jaw" or name in names or f"{name}Left" in names


# --- errors -----------------------------------------------------------------------------------------------------


def changed(clip: SyntheticClip, **fields: torch.Tensor):
    sequence = clip.sequence
    return dataclasses.replace(sequence, motion=dataclasses.replace(sequence.motion, **fields))


def test_the_truth_has_no_error(clip: SyntheticClip) -> None:
    means = synthetic.errors(clip.sequence, clip.sequence, clip.subject.head).means()
    assert means["rotation_deg"] < 0.05  # the angle of a float32 rotation near identity is known to about 0.02°
    assert means["jaw_deg"] < 0.05
    assert means["face_mm"] < 1e-3


def test_errors_measure_what_was_changed(clip: SyntheticClip) -> None:
    head, motion = clip.subject.head, clip.sequence.motion
    joints = motion.joints.clone()
    joints[:, 2, 0] += np.deg2rad(4.0)
    jaw = synthetic.errors(changed(clip, joints=joints), clip.sequence, head)
    assert jaw.means()["jaw_deg"] == pytest.approx(4.0, abs=0.05)
    assert jaw.means()["rotation_deg"] < 0.05
    assert jaw.means()["face_mm"] > 0.3
    moved = synthetic.errors(changed(clip, translation=motion.translation + 0.1), clip.sequence, head)
    assert moved.means()["face_mm"] < 1e-3  # the alignment removes it


def test_a_turn_of_root_or_neck_is_the_same_error(clip: SyntheticClip) -> None:
    joints = torch.zeros_like(clip.sequence.motion.joints)
    truth = changed(clip, joints=joints)
    for joint in (0, 1):
        turned = joints.clone()
        turned[:, joint, 1] = np.deg2rad(10.0)
        found = synthetic.errors(changed(clip, joints=turned), truth, clip.subject.head)
        assert found.rotation_deg.mean().item() == pytest.approx(10.0, abs=0.05)


def test_lost_frames_do_not_count(clip: SyntheticClip) -> None:
    tracked = clip.sequence.tracked.clone()
    tracked[:10] = False
    fitted = dataclasses.replace(clip.sequence, tracked=tracked)
    found = synthetic.errors(fitted, clip.sequence, clip.subject.head)
    assert found.face_mm[:10].isnan().all()
    assert np.isfinite(found.means()["face_mm"])


def test_sequences_of_different_length_are_refused(clip: SyntheticClip) -> None:
    shorter = dataclasses.replace(clip.sequence, tracked=clip.sequence.tracked[:5])
    with pytest.raises(InputError, match="5 frames"):
        synthetic.errors(shorter, clip.sequence, clip.subject.head)


def test_parts_of_the_head_are_those_the_room_paints(subject: synthetic.Subject) -> None:
    """Every part has a colour: nothing is left black."""
    part = subject.body.refinement.spread(np.where(subject.body.part >= len(PARTS), 0, subject.body.part))
    for number in np.unique(subject.body.part[subject.body.part < len(PARTS)]):
        rows = part == number
        assert np.median(subject.materials.albedo[rows].max(1)) > 0.02, PARTS[number]
