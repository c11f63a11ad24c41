"""Folders of pictures as people have them: faces are aligned, everything else is left out with a sentence."""

from __future__ import annotations

import dataclasses
import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from styletrain_toy import SIDE, TOY, write_pictures

from toonifygb import synthetic, video
from toonifygb.config import FaceConfig, StyleTrainConfig
from toonifygb.errors import InputError
from toonifygb.face import find_landmarks
from toonifygb.styletrain import pictures
from toonifygb.styletrain.pictures import claimed_size, read_pictures
from toonifygb.stylize.styleganex.align import FaceMarks


def png(width: int, height: int, content: bytes = b"\0" * 10) -> bytes:
    """A PNG file that claims a size; its pixels are ``content``."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(content)) + chunk(b"IEND", b"")
    )


def test_odd_files_are_left_out_with_a_sentence_each(tmp_path: Path) -> None:
    folder = write_pictures(tmp_path / "pictures")
    encoded = cv2.imencode(".jpg", np.full((SIDE, SIDE, 3), 90, np.uint8))[1].tobytes()
    odd = {
        "a-bomb.png": (png(60_000, 60_000), r"claims 60000x60000 px; at most 100 million px are read"),
        "b-nothing.jpg": (b"", "no JPEG or PNG picture"),
        "c-text.png": (b"<script>alert(1)</script>" * 9, "no JPEG or PNG picture"),
        "d-cut.png": (png(SIDE, SIDE), "is not an image that can be read"),
        "e-zero.png": (png(0, SIDE), r"claims 0x64 px"),
        "f-wide.png": (cv2.imencode(".png", np.zeros((SIDE, 80, 3), np.uint8))[1].tobytes(), "80x64 px; aligned"),
        "g-tiny.jpg": (
            cv2.imencode(".jpg", np.zeros((20, 20, 3), np.uint8))[1].tobytes(),
            "20 px wide; .* needs 32",
        ),
        "h-cut.jpg": (encoded[:30], "no JPEG or PNG picture"),
    }
    for name, (content, _) in odd.items():
        (folder / name).write_bytes(content)
    (folder / "i-folder.png").mkdir()
    (folder / "notes.txt").write_text("not looked at")
    (folder / ".hidden.png").write_bytes(b"not looked at")
    found = read_pictures(folder, TOY, tmp_path / "kept.safetensors")
    assert found.images.shape == (6, 3, SIDE, SIDE)
    assert len(found.problems) == len(odd) + 1
    for sentence, (name, (_, pattern)) in zip(found.problems, odd.items(), strict=False):
        assert sentence.startswith(f"{name} is left out: ") and "\n" not in sentence
        assert re.search(pattern, sentence), sentence
    assert "i-folder.png is left out: it cannot be read" in found.problems[-1]


def test_pictures_are_aligned_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, kept = write_pictures(tmp_path / "pictures"), tmp_path / "kept.safetensors"
    (folder / "x.png").write_bytes(b"")
    first = read_pictures(folder, TOY, kept)
    with monkeypatch.context() as patched:
        patched.setattr(pictures, "_decoded", lambda file: pytest.fail("looked at again"))
        second = read_pictures(folder, TOY, kept)
    assert second.images.equal(first.images)
    assert (second.problems, second.fingerprint) == (first.problems, first.fingerprint)
    video.save_png(folder / "0.png", np.zeros((SIDE, SIDE, 3), np.uint8))
    third = read_pictures(folder, TOY, kept)
    assert third.fingerprint != first.fingerprint and not third.images.equal(first.images)


def test_too_few_are_one_sentence(tmp_path: Path) -> None:
    folder = write_pictures(tmp_path / "pictures", 4)
    with pytest.raises(
        InputError, match=r"has 4 usable of 4 pictures .*; a style needs at least 5 — hint"
    ) as raised:
        read_pictures(folder, TOY, tmp_path / "kept.safetensors")
    assert "50 to 300 are best" in raised.value.hint
    (folder / "odd.png").write_bytes(b"?")
    with pytest.raises(InputError, match=r"has 4 usable of 5 pictures .*; odd.png is left out: it is no JPEG"):
        read_pictures(folder, TOY, tmp_path / "kept.safetensors")
    with pytest.raises(InputError, match="is no folder"):
        read_pictures(folder / "0.png", TOY, tmp_path / "kept.safetensors")
    assert not (tmp_path / "kept.safetensors").exists()


def test_sizes_are_read_off_the_headers() -> None:
    image = np.zeros((37, 53, 3), np.uint8)
    for suffix in (".png", ".jpg"):
        assert claimed_size(cv2.imencode(suffix, image)[1].tobytes()) == (53, 37)
    progressive = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    assert claimed_size(progressive) == (53, 37)
    assert claimed_size(progressive[:2] + b"\xff" * 3 + progressive[2:]) == (53, 37)
    assert claimed_size(cv2.imencode(".bmp", image)[1].tobytes()) is None
    assert claimed_size(b"\xff\xd8" + b"\xff\xe0\x00\x00" * 50) is None


def test_faces_are_found_and_brought_upright(tmp_path: Path) -> None:
    """A synthetic person, filmed upright and on the side: eyes and mouth land where FFHQ has them."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    frame = next(iter(synthetic.render_clip(synthetic.make_subject(3), n_frames=1, size=448))).image
    for index in range(5):
        turn = cv2.getRotationMatrix2D((224, 224), 12.0 * (index - 2), 1.0)
        turned = cv2.warpAffine(frame, turn, (448, 448), borderMode=cv2.BORDER_REFLECT)
        video.save_png(folder / f"{index}.png", turned)
    video.save_png(folder / "wall.png", np.full((300, 300, 3), 120, np.uint8))
    config = dataclasses.replace(StyleTrainConfig(), resolution=256)
    found = read_pictures(folder, config, tmp_path / "kept.safetensors")
    assert found.images.shape == (5, 3, 256, 256)
    assert len(found.problems) == 1 and found.problems[0].startswith("wall.png is left out: no face was found")
    for image in found.images[::2]:
        landmarks, _ = find_landmarks([image.permute(1, 2, 0).numpy()], FaceConfig())
        marks = FaceMarks.from_mediapipe(landmarks.points[0].numpy())
        assert abs(marks.eye_left[1] - marks.eye_right[1]) < 8
        assert abs(marks.eye_middle[0] - 128) < 12 and 100 < marks.eye_middle[1] < 130
    assert read_pictures(folder, config, tmp_path / "kept.safetensors").images.equal(found.images)
