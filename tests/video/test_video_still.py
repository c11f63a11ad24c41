"""Single images and folders of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from video_clips import corners, moving, quarters

from toonifygb.errors import InputError
from toonifygb.video import encode_jpeg, load_image, open_clip, save_png, source_sha256

if TYPE_CHECKING:
    from pathlib import Path


def test_png_round_trip_is_exact(tmp_path: Path):
    image = moving(3)
    save_png(tmp_path / "größe.png", image)
    assert (load_image(tmp_path / "größe.png") == image).all()
    assert [path.name for path in tmp_path.iterdir()] == ["größe.png"]


def test_png_in_a_missing_folder_is_one_sentence(tmp_path: Path):
    with pytest.raises(InputError, match="cannot be written"):
        save_png(tmp_path / "absent" / "x.png", moving(0))


def test_jpeg_bytes_hold_the_image():
    image = quarters(64, 64)
    back = cv2.imdecode(np.frombuffer(encode_jpeg(image, 95), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert corners(back) == corners(image)


def test_depths_and_channels_become_rgb(tmp_path: Path):
    grey = moving(0)[..., 0]
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    assert (load_image(tmp_path / "grey.png") == grey[..., None]).all()
    cv2.imwrite(str(tmp_path / "deep.png"), moving(0)[..., ::-1].astype(np.uint16) * 257)
    assert np.abs(load_image(tmp_path / "deep.png").astype(int) - moving(0)).max() <= 1
    for dtype, top in ((np.uint8, 255), (np.uint16, 65_535)):
        rgba = np.full((4, 4, 4), top, dtype)
        rgba[2:, :, 3] = 0
        cv2.imwrite(str(tmp_path / "alpha.png"), rgba)
        image = load_image(tmp_path / "alpha.png")
        assert (image[:2] == 255).all() and (image[2:] == 0).all()


def test_exif_rotation_is_applied(tmp_path: Path):
    jpeg = encode_jpeg(quarters(48, 64), 95)
    # APP1 with one EXIF entry: orientation (0x0112) = 6, "turn a quarter clockwise to view".
    tiff = b"II*\0\x08\0\0\0" + b"\x01\0" + b"\x12\x01\x03\0\x01\0\0\0\x06\0\0\0" + b"\0\0\0\0"
    body = b"Exif\0\0" + tiff
    path = tmp_path / "phone.jpg"
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + jpeg[2:])
    image = load_image(path)
    assert image.shape == (64, 48, 3) and corners(image) == ("blue", "red", "white", "green")


def test_folder_is_read_in_natural_order(tmp_path: Path):
    for number in (1, 2, 10):
        save_png(tmp_path / f"frame{number}.png", np.full((8, 8, 3), number, np.uint8))
    (tmp_path / "notes.txt").write_text("not a frame")
    (tmp_path / ".hidden.png").write_bytes(b"not a frame")
    clip = open_clip(tmp_path)
    assert [int(frame[0, 0, 0]) for frame in clip] == [1, 2, 10]
    assert (clip.count(), clip.info.n_frames, clip.info.has_audio) == (3, 3, False)
    assert "25 frames per second" in clip.problems[0]


def test_folder_checksum_follows_images_and_order(tmp_path: Path):
    a, b = tmp_path / "a", tmp_path / "b"
    for folder, names in ((a, ("1.png", "2.png")), (b, ("x1.png", "x2.png"))):
        folder.mkdir()
        for name, value in zip(names, (10, 20), strict=True):
            save_png(folder / name, np.full((4, 4, 3), value, np.uint8))
    assert source_sha256(a) == source_sha256(b)
    (b / "x1.png").rename(b / "x3.png")
    assert source_sha256(a) != source_sha256(b)


def test_folder_of_mixed_sizes_is_one_sentence(tmp_path: Path):
    save_png(tmp_path / "1.png", np.zeros((8, 8, 3), np.uint8))
    save_png(tmp_path / "2.png", np.zeros((8, 10, 3), np.uint8))
    with pytest.raises(InputError, match=r"2\.png is 10x8 px, expected 8x8 px"):
        list(open_clip(tmp_path))


@pytest.mark.parametrize("content", [b"", b"not an image"])
def test_damaged_image_is_one_sentence(tmp_path: Path, content: bytes):
    (tmp_path / "1.png").write_bytes(content)
    with pytest.raises(InputError, match=r"1\.png is not an image"):
        open_clip(tmp_path)
