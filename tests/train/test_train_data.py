"""The training set: where crops lie, what is written, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from make import TINY, tiny_head, tiny_sequence

from toonifygb.errors import InputError
from toonifygb.geometry.cameras import project
from toonifygb.train import build_dataset, crop, crop_boxes, load_dataset, split_frames

if TYPE_CHECKING:
    from pathlib import Path

    from toonifygb.structures import TrackedSequence

CONFIG = replace(TINY, resolution=40)


def pairs(sequence: TrackedSequence, n: int | None = None):
    """Frames whose red is the column, green the row and blue the frame number; the matte is a left half."""
    height, width = sequence.camera.height, sequence.camera.width
    rows, columns = np.mgrid[:height, :width]
    for index in range(sequence.n_frames if n is None else n):
        frame = np.stack([columns, rows, np.full_like(rows, index)], -1).astype(np.uint8)
        yield frame, (columns < width / 2).astype(np.float32)


def moving(sequence: TrackedSequence, metres: float) -> TrackedSequence:
    """The same clip with the head wandering sideways."""
    shift = torch.zeros(sequence.n_frames, 3)
    shift[:, 0] = torch.linspace(-metres, metres, sequence.n_frames)
    motion = replace(sequence.motion, translation=sequence.motion.translation + shift)
    points, _ = tiny_head().landmarks().forward(sequence.shape, motion)
    pixels, _ = project(sequence.camera, points)
    return replace(sequence, motion=motion, landmarks=replace(sequence.landmarks, points=pixels))


def test_crops_show_the_box_through_their_camera(tmp_path: Path) -> None:
    sequence = tiny_sequence(20, 128)
    dataset = build_dataset(pairs(sequence), sequence, tiny_head(), CONFIG, tmp_path)
    assert dataset.frames.shape == (20, 40, 40, 3)
    assert dataset.frames[7, ..., 2].min() == dataset.frames[7, ..., 2].max() == 7
    index = 5
    point = torch.tensor([[0.01, 0.02, -0.55]])
    inside, _ = project(dataset.camera(index), point)
    full, _ = project(sequence.camera, point)
    left, top, right, _ = dataset.boxes[index].tolist()
    scale = 40 / (right - left)
    assert torch.allclose(inside[0], (full[0] - torch.tensor([left, top])) * scale, atol=1e-3)
    # Pixel (row, column) of the crop shows column left + (column + ½) / scale of the frame, whose red says so.
    red = dataset.frames[index, 20, :, 0].astype(float)
    assert np.abs(red - (left + (np.arange(40) + 0.5) / scale - 0.5)).max() < 1.0
    color, matte = dataset.target(index)
    assert set(matte.unique().tolist()) <= {0.0, 1.0} or matte.unique().numel() < 12
    assert (color[matte == 0] == 0).all()
    assert color.dtype == matte.dtype == torch.float32


def test_box_stands_still_while_the_head_stays(tmp_path: Path) -> None:
    sequence = tiny_sequence(20, 256)
    boxes = crop_boxes(sequence, tiny_head(), 3.0)
    assert (boxes == boxes[0]).all()
    assert (boxes[:, 2] - boxes[:, 0] == boxes[:, 3] - boxes[:, 1]).all()
    vertices, _ = tiny_head().forward(sequence.shape, sequence.motion)
    pixels, _ = project(sequence.camera, vertices)
    low, high = pixels.amin((0, 1)).numpy(), pixels.amax((0, 1)).numpy()
    assert (boxes[0, :2] <= low).all()
    assert (boxes[0, 2:] >= high).all()


def test_box_follows_a_wandering_head_smoothly() -> None:
    sequence = moving(tiny_sequence(60, 256), 0.12)
    boxes = crop_boxes(sequence, tiny_head(), 1.4)
    assert boxes[-1, 0] - boxes[0, 0] > 20
    assert np.abs(np.diff(boxes[:, 0])).max() <= 4
    sides = boxes[:, 2] - boxes[:, 0]
    assert (sides == sides[0]).all()
    assert boxes.min() >= 0
    assert boxes.max() <= 256


def test_a_large_head_is_cropped_to_the_frame() -> None:
    sequence = tiny_sequence(20, 64)
    boxes = crop_boxes(sequence, tiny_head(), 50.0)
    assert boxes.tolist() == [[0, 0, 64, 64]] * 20


def test_end_is_held_out_and_lost_frames_are_in_neither_set() -> None:
    sequence = tiny_sequence(20)
    tracked = torch.ones(20, dtype=torch.bool)
    tracked[[3, 17]] = False
    split = split_frames(replace(sequence, tracked=tracked), replace(CONFIG, test_share=0.25))
    assert split.test == (15, 16, 18, 19)
    assert split.train == tuple(index for index in range(15) if index != 3)
    limited = split_frames(sequence, replace(CONFIG, test_share=0.25, max_test_frames=2))
    assert limited.test == (18, 19)


def test_the_held_out_share_can_be_taken_from_several_parts() -> None:
    sequence = tiny_sequence(30)
    split = split_frames(sequence, replace(CONFIG, test_share=0.2, test_parts=3))
    assert split.test == (8, 9, 18, 19, 28, 29)
    assert sorted(split.train + split.test) == list(range(30))
    uneven = split_frames(sequence, replace(CONFIG, test_share=0.2, test_parts=4))
    assert len(uneven.test) == 6 and uneven.test[-1] == 29
    for parts in (29, 30, 100):  # shorter than a frame: still the same number, none twice
        many = split_frames(sequence, replace(CONFIG, test_share=0.2, test_parts=parts))
        assert len(many.test) == 6


def test_finished_set_is_taken_as_it_is(tmp_path: Path) -> None:
    sequence = tiny_sequence(20, 64)
    first = build_dataset(pairs(sequence), sequence, tiny_head(), CONFIG, tmp_path)

    def unwanted():
        raise AssertionError("the frames are not needed again")
        yield

    again = build_dataset(unwanted(), sequence, tiny_head(), CONFIG, tmp_path)
    assert again.fingerprint == first.fingerprint
    other = build_dataset(pairs(sequence), sequence, tiny_head(), replace(CONFIG, resolution=24), tmp_path)
    assert other.size == 24
    assert other.fingerprint != first.fingerprint


def test_short_clip_is_told(tmp_path: Path) -> None:
    sequence = tiny_sequence(20, 64)
    with pytest.raises(InputError, match="ends after 12 frames but was tracked for 20"):
        build_dataset(pairs(sequence, 12), sequence, tiny_head(), CONFIG, tmp_path)
    with pytest.raises(InputError, match=r"dataset\.json is missing"):
        load_dataset(tmp_path)


def test_damage_is_told(tmp_path: Path) -> None:
    sequence = tiny_sequence(20, 64)
    build_dataset(pairs(sequence), sequence, tiny_head(), CONFIG, tmp_path)
    frames = (tmp_path / "frames.npy").read_bytes()
    (tmp_path / "frames.npy").write_bytes(frames[: len(frames) // 2])
    with pytest.raises(InputError, match="damaged"):
        load_dataset(tmp_path)
    np.save(tmp_path / "frames.npy", np.zeros((3, 40, 40, 3), np.uint8))
    with pytest.raises(InputError, match="3 frames, 20 mattes and 20 boxes"):
        load_dataset(tmp_path)
    (tmp_path / "dataset.json").write_text("no")
    with pytest.raises(InputError, match="not valid JSON"):
        load_dataset(tmp_path)
    (tmp_path / "dataset.json").write_text("[]")
    with pytest.raises(InputError, match="does not describe"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("size", [10, 40, 80])
def test_crop_keeps_flat_colours(size: int) -> None:
    image = np.full((64, 64, 3), 77, np.uint8)
    cut = crop(image, np.array([8, 4, 48, 44]), size)
    assert cut.shape == (size, size, 3)
    assert (cut == 77).all()
