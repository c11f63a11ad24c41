"""Our tracks in the layout of INSTA and 3DGB, and back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_makers import HEIGHT, N_FRAMES, WIDTH, insta_folder, movements, picture, pytorch3d_pixels, tiny_flame
from make import tiny_sequence

from toonifygb import datasets
from toonifygb.errors import InputError
from toonifygb.geometry.cameras import project, tracked_camera
from toonifygb.structures import TrackedSequence

SIZE = 64


def sequence(neck: float = 0.0) -> TrackedSequence:
    """A FLAME-like head that turns in front of a camera."""
    shape, motion = movements()
    known = tiny_sequence(N_FRAMES)
    joints = motion.joints.clone()
    joints[:, 0] = known.motion.joints[:, 0]
    joints[:, 1, 1] = neck * torch.linspace(-1, 1, N_FRAMES)
    motion = replace(motion, joints=joints, translation=known.motion.translation)
    return replace(
        known,
        head_model="flame",
        shape=shape,
        motion=motion,
        camera=tracked_camera(170.0, WIDTH, HEIGHT),
        tracked=torch.arange(N_FRAMES) != 2,
    )


def crops(boxes: np.ndarray) -> datasets.Crops:
    """Smooth pictures with soft mattes, each another."""
    rows, columns = np.mgrid[:SIZE, :SIZE]

    def shot(index: int) -> tuple[np.ndarray, np.ndarray]:
        color = np.stack([columns * 3, rows * 3, np.full_like(rows, 9 * index)], -1).astype(np.uint8)
        matte = 255 * np.exp(-(((rows - 30) / 20) ** 2) - ((columns - 34) / 16) ** 2)
        return color, matte.astype(np.uint8)

    return datasets.Crops(boxes, SIZE, shot)


STILL = np.tile([10, 5, 74, 69], (N_FRAMES, 1))


def vertices_px(track: TrackedSequence) -> np.ndarray:
    points, _ = tiny_flame().forward(track.shape, track.motion)
    return project(track.camera, points)[0].numpy()


def back(out: Path) -> tuple[datasets.ForeignFolder, TrackedSequence]:
    folder = datasets.recognize(out)
    assert folder is not None and folder.layout == "insta"
    read = datasets.read_track(folder, tiny_flame())
    assert read.problems == ()
    return folder, read.sequence


def test_there_and_back(tmp_path: Path) -> None:
    ours, out = sequence(), tmp_path / "set"
    written = datasets.export_dataset(ours, tiny_flame(), crops(STILL), out, n_test=3)
    assert written.problems == ("1 frames without a face are written with the motion between their neighbours",)
    folder, theirs = back(out)
    assert folder.n_test == 3 and folder.ids == tuple(range(N_FRAMES))
    # The crop starts at (10, 5) and is not resized.
    assert np.abs(vertices_px(theirs) - (vertices_px(ours) - [10, 5])).max() < 2e-3
    for mine, again in ((ours.motion.joints[:, 2:], theirs.motion.joints[:, 2:]), (ours.shape, theirs.shape)):
        assert (mine - again).abs().max() < 2e-6
    assert (ours.motion.expression - theirs.motion.expression).abs().max() == 0
    for index in range(N_FRAMES):
        color, matte = datasets.read_picture(folder.pictures[index])
        expected = crops(STILL).picture(index)
        assert np.array_equal(color, expected[0]) and matte is not None
        assert np.array_equal(np.rint(matte * 255), expected[1])


def test_torch_and_the_json_say_the_same(tmp_path: Path) -> None:
    """Other programs: ``torch.load``, PyTorch3D's projection, and camera-to-world matrices with OpenCV axes."""
    ours, out = sequence(), tmp_path / "set"
    datasets.export_dataset(ours, tiny_flame(), crops(STILL), out, n_test=3)
    table = json.loads((out / "transforms.json").read_text())
    counts = {name: len(json.loads((out / f"transforms_{name}.json").read_text())["frames"]) for name in SPLITS}
    assert counts == SPLITS
    for index in (0, N_FRAMES - 1):
        frame = torch.load(out / "checkpoint" / f"{index:05d}.frame", weights_only=False)
        assert frame["flame"]["exp"].shape == (1, 100) and frame["flame"]["exp"].dtype == np.float32
        assert frame["frame_id"] == f"{index:05d}" and frame["img_size"].tolist() == [SIZE, SIZE]
        mesh = (out / table["frames"][index]["mesh_path"]).read_text().splitlines()
        vertices = np.array([line.split()[1:] for line in mesh if line.startswith("v ")], np.float64)
        expected = vertices_px(ours)[index] - [10, 5]
        pose = np.linalg.inv(np.array(table["frames"][index]["transform_matrix"]))
        seen = vertices @ pose[:3, :3].T + pose[:3, 3]
        across = table["cx"] + table["fl_x"] * seen[:, 0] / seen[:, 2]
        down = table["cy"] + table["fl_y"] * seen[:, 1] / seen[:, 2]
        assert np.abs(np.stack([across, down], -1) - expected).max() < 2e-3
        camera = {name: value.astype(np.float64) for name, value in frame["camera"].items()}
        half = SIZE / 2
        flipped = pytorch3d_pixels(vertices, camera)
        # That projection is written for the makers' image; undo its size.
        ndc = (np.array([WIDTH, HEIGHT]) / 2 - flipped) / (min(WIDTH, HEIGHT) / 2)
        assert np.abs(half - ndc * half - expected).max() < 2e-3
        lines = (out / table["frames"][index]["exp_path"]).read_text().split()
        assert np.abs(np.array(lines, float) - frame["flame"]["exp"][0]).max() < 1e-8
    canonical = (out / "canonical.obj").read_text()
    assert canonical.count("\nf ") == len(tiny_flame().faces)


SPLITS = {"train": N_FRAMES - 3, "test": 3, "val": N_FRAMES}


def test_crops_that_move_lie_where_they_were(tmp_path: Path) -> None:
    ours, out = sequence(), tmp_path / "set"
    corner = np.stack([10 + np.arange(N_FRAMES), 5 + np.arange(N_FRAMES) // 2], -1)
    boxes = np.concatenate([corner, corner + 51], -1)  # 51 px shown at 64: crops start between pixels
    written = datasets.export_dataset(ours, tiny_flame(), crops(boxes), out, n_test=2, meshes=False)
    assert "put on one canvas" in written.problems[-1] and not (out / "transforms.json").exists()
    folder, theirs = back(out)
    scale = SIZE / 51
    assert np.abs(vertices_px(theirs) - (vertices_px(ours) - corner[0]) * scale).max() < 2e-3
    for index in range(N_FRAMES):
        color, matte = datasets.read_picture(folder.pictures[index])
        assert matte is not None
        rows, columns = np.mgrid[: written.height, : written.width]
        solid = matte > 0.3
        # Red counts the crop's columns in threes, so it says where the crop lies: a third of a pixel at 8 bits.
        shown = color[..., 0][solid] / 3 + (corner[index] - corner[0])[0] * scale
        assert np.abs(shown - columns[solid]).max() < 0.5
        peak = (matte * rows).sum() / matte.sum(), (matte * columns).sum() / matte.sum()
        original = crops(boxes).picture(index)[1].astype(float)
        own = np.mgrid[:SIZE, :SIZE]
        expected = [(original * axis).sum() / original.sum() for axis in own]
        expected = np.array(expected) + ((corner[index] - corner[0]) * scale)[::-1]
        assert np.abs(np.array(peak) - expected).max() < 0.05


def test_a_turning_neck_keeps_the_face_in_place(tmp_path: Path) -> None:
    ours, out = sequence(neck=0.3), tmp_path / "set"
    written = datasets.export_dataset(ours, tiny_flame(), crops(STILL), out, n_test=2, meshes=False)
    assert "the neck turns by up to 17 degrees" in written.problems[0]
    _, theirs = back(out)
    head = tiny_flame()
    skull = head.skin_weights[:, 0] == 0
    assert int(skull.sum()) > 100
    off = np.abs(vertices_px(theirs) - (vertices_px(ours) - [10, 5]))
    assert off[:, skull.numpy()].max() < 2e-3 < off.max()


def test_an_imported_dataset_exports_to_itself(tmp_path: Path) -> None:
    truth = insta_folder(tmp_path / "theirs")
    folder = datasets.recognize(tmp_path / "theirs")
    assert folder is not None
    track = datasets.read_track(folder, tiny_flame()).sequence
    square = np.tile([8, 0, 8 + HEIGHT, HEIGHT], (N_FRAMES, 1))

    def shot(index: int) -> tuple[np.ndarray, np.ndarray]:
        image = picture(truth.pixels[index], 20 * index)[:, 8 : 8 + HEIGHT]
        return image[..., :3], image[..., 3]

    datasets.export_dataset(track, tiny_flame(), datasets.Crops(square, HEIGHT, shot), tmp_path / "ours", n_test=3)
    _, again = back(tmp_path / "ours")
    assert np.abs(vertices_px(again) - (truth.pixels - [8, 0])).max() < 2e-3


def test_refusals(tmp_path: Path) -> None:
    ours, flame = sequence(), tiny_flame()
    other = replace(flame, name="open", shape_basis=flame.shape_basis[..., :3])
    with pytest.raises(InputError, match="this layout holds FLAME's 300 and 100"):
        datasets.export_dataset(ours, other, crops(STILL), tmp_path / "set", n_test=3)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "holiday.jpg").touch()
    with pytest.raises(InputError, match="exists and is not empty"):
        datasets.export_dataset(ours, flame, crops(STILL), tmp_path / "full", n_test=3)
    assert not (tmp_path / "set").exists()
