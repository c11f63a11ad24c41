"""Foreign datasets: every vertex lands where their own formulas put it, and bad ones are refused in a sentence."""

from __future__ import annotations

import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_makers import (
    HEIGHT,
    N_FRAMES,
    WIDTH,
    Truth,
    cameras,
    flashavatar_folder,
    insta_folder,
    picture,
    pytorch3d,
    pytorch3d_pixels,
    save,
    tiny_flame,
    tracker_folder,
    vhap_folder,
)

from toonifygb import datasets
from toonifygb.errors import AssetError, InputError
from toonifygb.geometry.cameras import project

MAKERS = {
    "insta": insta_folder,
    "flashavatar": flashavatar_folder,
    "tracker": lambda folder: tracker_folder(folder, "input"),
    "tracker without opencv": lambda folder: tracker_folder(folder, "input", opencv=False),
    "vhap": vhap_folder,
    "vhap, a file per frame": lambda folder: vhap_folder(folder, each=True),
}


def read(folder: Path) -> tuple[datasets.ForeignFolder, datasets.ForeignTrack]:
    found = datasets.recognize(folder)
    assert found is not None
    return found, datasets.read_track(found, tiny_flame())


def drawn(track: datasets.ForeignTrack) -> np.ndarray:
    """Pixels of all vertices in our world."""
    sequence = track.sequence
    vertices, _ = tiny_flame().forward(sequence.shape, sequence.motion)
    return project(sequence.camera, vertices)[0].numpy()


@pytest.mark.parametrize("name", MAKERS)
def test_vertices_land_where_the_dataset_puts_them(name: str, tmp_path: Path) -> None:
    truth = MAKERS[name](tmp_path)
    folder, track = read(tmp_path)
    assert folder.layout == name.split()[0].rstrip(",")
    assert folder.ids == tuple(range(N_FRAMES))
    # float32 on both sides: 1e-7 of half a metre through a focal length of 190 px.
    assert np.abs(drawn(track) - truth.pixels).max() < 2e-3
    assert torch.equal(track.sequence.shape, truth.shape)
    assert (track.sequence.motion.expression - truth.motion.expression).abs().max() < 1e-6
    assert (track.sequence.motion.eyelids - truth.motion.eyelids).abs().max() < 1e-6
    assert track.problems == ()
    camera = track.sequence.camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert torch.equal(camera.world_to_camera, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))


def test_pytorch3d_agrees_with_its_own_projection(tmp_path: Path) -> None:
    """The stored camera, projected by PyTorch3D's definition rather than by the relation that the reader uses."""
    truth = tracker_folder(tmp_path, "input", opencv=False)
    _, track = read(tmp_path)
    vertices, _ = tiny_flame().forward(truth.shape, truth.motion)
    rotation, translation = cameras()
    for index in range(N_FRAMES):
        camera = pytorch3d(rotation[index], translation[index])
        assert np.abs(pytorch3d_pixels(vertices[index].numpy(), camera) - drawn(track)[index]).max() < 2e-3


def test_a_wrong_convention_would_be_noticed(tmp_path: Path) -> None:
    """Cameras of one convention read as the other's put vertices many pixels off."""
    truth = insta_folder(tmp_path)
    for path in tmp_path.glob("transforms*.json"):
        table = json.loads(path.read_text())
        for frame in table["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])).tolist()
        path.write_text(json.dumps(table))
    _, track = read(tmp_path)
    assert "place the camera up to 2" in track.problems[0] and "the checkpoint is used" in track.problems[0]
    assert np.abs(drawn(track) - truth.pixels).max() < 2e-3


@pytest.mark.parametrize("name", ["insta", "flashavatar", "vhap"])
def test_pictures_keep_their_colours_and_have_mattes(name: str, tmp_path: Path) -> None:
    truth = MAKERS[name](tmp_path)
    folder, _ = read(tmp_path)
    for index in (0, N_FRAMES - 1):
        color, matte = datasets.read_picture(folder.pictures[index])
        expected = picture(truth.pixels[index], 20 * index)
        tolerance = 12 if name == "flashavatar" else 0  # JPEG
        assert np.abs(color.astype(int) - expected[..., :3]).max() <= tolerance
        assert matte is not None and matte.dtype == np.float32
        wanted = expected[..., 3] / 255
        if name == "flashavatar":
            wanted = wanted * (np.arange(WIDTH) > 40)
        # Mask files lose 8 levels at either end; JPEG rings at their edges.
        off = np.abs(matte - wanted)
        assert np.median(off) == 0 and off.max() < {"insta": 1e-6, "vhap": 0.04, "flashavatar": 0.4}[name]


def test_clothes_are_cut_out_of_matted_pictures(tmp_path: Path) -> None:
    truth = insta_folder(tmp_path)
    for index in range(N_FRAMES):
        image = picture(truth.pixels[index], 0)
        save(tmp_path / "images" / f"{index:05d}.png", image[..., :3])
        save(tmp_path / "matted" / f"{index:05d}.png", image)
        parsing = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        parsing[60:, :, 0] = 90
        save(tmp_path / "seg_mask" / f"{index:05d}.png", parsing)
    folder, _ = read(tmp_path)
    _, matte = datasets.read_picture(folder.pictures[2])
    expected = picture(truth.pixels[2], 0)[..., 3] / np.float32(255)
    assert matte is not None and not matte[60:].any() and np.abs(matte[:60] - expected[:60]).max() < 1e-6


def test_a_tracker_alone_has_no_mattes(tmp_path: Path) -> None:
    tracker_folder(tmp_path, "input")
    folder, _ = read(tmp_path)
    assert datasets.read_picture(folder.pictures[0])[1] is None


def test_held_out_frames(tmp_path: Path) -> None:
    insta_folder(tmp_path / "a", n_test=3)
    tracker_folder(tmp_path / "b", "input")
    a, b = datasets.recognize(tmp_path / "a"), datasets.recognize(tmp_path / "b")
    assert a is not None and b is not None
    assert a.n_test == 3
    assert b.n_test == N_FRAMES // 2  # of 700 frames and more the last 350
    assert datasets.folders.held_out(datasets.folders.HELD_OUT, 4000) == 350
    assert a.first(4).n_test == 2 and len(a.first(4).parameters) == 4
    assert a.first(None) is a


def test_frames_without_a_picture_are_left_out(tmp_path: Path) -> None:
    truth = insta_folder(tmp_path)
    (tmp_path / "images" / "00002.png").unlink()
    folder, track = read(tmp_path)
    assert folder.ids == (0, 1, 3, 4, 5, 6, 7)
    assert np.abs(drawn(track) - truth.pixels[list(folder.ids)]).max() < 2e-3


def test_what_cannot_be_kept_is_said(tmp_path: Path) -> None:
    def zoomed(index: int, frame: dict) -> None:
        frame["opencv"]["K"][0, 0, 0] += index

    tracker_folder(tmp_path / "a", "input", change=zoomed)
    assert "changes by up to 7.0 px" in read(tmp_path / "a")[1].problems[0]
    vhap_folder(tmp_path / "b", offset=0.002)
    assert "up to 2.0 mm (static_offset)" in read(tmp_path / "b")[1].problems[0]


def test_other_folders_are_not_recognised(tmp_path: Path) -> None:
    assert datasets.recognize(tmp_path) is None
    assert datasets.recognize(tmp_path / "absent") is None
    save(tmp_path / "images" / "00000.png", np.zeros((4, 4, 3), np.uint8))
    assert datasets.recognize(tmp_path) is None


# --- refused ---------------------------------------------------------------------------------------------------


def hostile_frame(truth: Truth) -> None:
    class Malice:
        def __reduce__(self):
            return (Path.touch, (truth.folder / "trace",))

    torch.save({"flame": Malice()}, truth.folder / "checkpoint" / "00003.frame")


def object_frame(truth: Truth) -> None:
    torch.save({"flame": {"exp": np.array([{}], dtype=object)}}, truth.folder / "checkpoint" / "00003.frame")


def edit(truth: Truth, change) -> None:
    path = truth.folder / "checkpoint" / "00003.frame"
    frame = torch.load(path, weights_only=False)
    change(frame)
    torch.save(frame, path)


def short_expression(truth: Truth) -> None:
    edit(truth, lambda frame: frame["flame"].update(exp=np.zeros((1, 50), np.float32)))


def no_jaw(truth: Truth) -> None:
    edit(truth, lambda frame: frame["flame"].pop("jaw"))


def no_camera(truth: Truth) -> None:
    edit(truth, lambda frame: (frame.pop("opencv"), frame.pop("camera")))


def not_finite(truth: Truth) -> None:
    edit(truth, lambda frame: frame["flame"].update(shape=np.full((1, 300), np.nan, np.float32)))


def other_size(truth: Truth) -> None:
    save(truth.folder / "images" / "00000.png", np.zeros((10, 10, 4), np.uint8))


def no_pictures(truth: Truth) -> None:
    for path in (truth.folder / "images").iterdir():
        path.unlink()


def no_checkpoints(truth: Truth) -> None:
    for path in (truth.folder / "checkpoint").iterdir():
        path.unlink()


def broken_json(truth: Truth) -> None:
    (truth.folder / "transforms_test.json").write_text("[" * 100_000)


def mirrored_pose(truth: Truth) -> None:
    path = truth.folder / "transforms.json"
    table = json.loads(path.read_text())
    table["frames"][0]["transform_matrix"] = np.diag([1.0, 1, -1, 1]).tolist()
    path.write_text(json.dumps(table))


INSTA_CASES = {
    hostile_frame: r"holds code",
    object_frame: r"array of objects|type 'O",
    short_expression: r"flame\.exp is not 100 finite numbers",
    no_jaw: r"lacks flame\.jaw",
    no_camera: r"lacks opencv or camera",
    not_finite: r"flame\.shape is not 300 finite",
    other_size: r"is 10x10 px but was tracked at 96x80 px",
    no_pictures: r"no picture of any of them",
    no_checkpoints: r"cameras but no tracked heads",
    broken_json: r"is not valid JSON",
    mirrored_pose: r"frame without a camera pose",
}


@pytest.mark.parametrize("case", INSTA_CASES, ids=lambda case: case.__name__)
def test_bad_trackers_output_is_refused_in_a_sentence(case, tmp_path: Path) -> None:
    case(insta_folder(tmp_path))
    with pytest.raises((InputError, AssetError), match=INSTA_CASES[case]) as caught:
        read(tmp_path)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "trace").exists()


def pickled_array(folder: Path) -> None:
    class Malice:
        def __reduce__(self):
            return (Path.touch, (folder / "trace",))

    np.savez(folder / "flame_param.npz", shape=np.array([Malice()], dtype=object), allow_pickle=True)


def plain_pickle(folder: Path) -> None:
    (folder / "flame_param.npz").write_bytes(pickle.dumps({"shape": 1}))


def unpacks_to_gigabytes(folder: Path) -> None:
    path = folder / "flame_param.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("shape.npy", bytes(2**16))
    content = bytearray(path.read_bytes())
    size = content.index(b"PK\x01\x02") + 24
    content[size : size + 4] = (1_200_000_000).to_bytes(4, "little")
    path.write_bytes(content)


def lying_header(folder: Path) -> None:
    """An array that claims 8 TB."""
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(folder / "flame_param.npz", "w") as archive:
        archive.writestr("shape.npy", b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(64))


def text_array(folder: Path) -> None:
    np.savez(folder / "flame_param.npz", shape=np.array(["a"]))


def too_few_frames(folder: Path) -> None:
    with np.load(folder / "flame_param.npz") as file:
        arrays = dict(file)
    np.savez(folder / "flame_param.npz", **{**arrays, "expr": arrays["expr"][:3]})


def other_head(folder: Path) -> None:
    with np.load(folder / "flame_param.npz") as file:
        arrays = dict(file)
    np.savez(folder / "flame_param.npz", **{**arrays, "shape": np.zeros(10)})


NPZ_CASES = {
    pickled_array: r"damaged or holds more than arrays of numbers",
    plain_pickle: r"damaged or holds more than arrays of numbers",
    unpacks_to_gigabytes: r"unpacks to 1\.2 GB",
    lying_header: r"damaged or holds more than arrays of numbers",
    text_array: r"shape, which is no array of numbers",
    too_few_frames: r"lacks expr of some frame",
    other_head: r"holds 10 shape and 100 expression coefficients",
}


@pytest.mark.parametrize("case", NPZ_CASES, ids=lambda case: case.__name__)
def test_bad_parameters_are_refused_in_a_sentence(case, tmp_path: Path) -> None:
    vhap_folder(tmp_path)
    case(tmp_path)
    with pytest.raises(InputError, match=NPZ_CASES[case]) as caught:
        read(tmp_path)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "trace").exists()
