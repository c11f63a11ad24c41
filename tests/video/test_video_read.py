"""Clips in: every frame, upright, in the right colours, and a sentence for whatever is odd."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

import av
import numpy as np
import pytest
from video_clips import corners, moving, quarters, write_clip

from toonifygb.errors import InputError
from toonifygb.video import open_clip, probe, read, source_sha256

if TYPE_CHECKING:
    from pathlib import Path

UPRIGHT = ("red", "green", "blue", "white")
ONE = 1 << 16


def test_every_frame_arrives_and_the_clip_can_be_read_again(tmp_path: Path):
    images = [moving(i) for i in range(30)]
    clip = open_clip(write_clip(tmp_path / "clip.mp4", images, options={"crf": "5"}))
    assert (clip.info.width, clip.info.height, clip.info.fps, clip.info.n_frames) == (64, 48, 25.0, 30)
    assert not clip.info.has_audio and clip.info.problems == ()
    for _ in range(2):
        frames = list(clip)
        assert len(frames) == clip.count() == 30
        # Chroma is stored at half resolution: the mean, not the maximum, is bounded.
        errors = [np.abs(a.astype(int) - b).mean() for a, b in zip(frames, images, strict=True)]
        assert max(errors) < 6
    assert frames[0].dtype == np.uint8 and frames[0].flags.c_contiguous
    assert clip.problems == []


@pytest.mark.parametrize(
    ("suffix", "codec", "pix_fmt"), [(".mov", "qtrle", "rgb24"), (".mp4", "libx264", "yuv420p")]
)
def test_frames_may_be_drawn_upon(tmp_path: Path, suffix: str, codec: str, pix_fmt: str):
    """A codec that codes differences keeps its last picture; the caller's copy must be another."""
    images = [moving(0)] * 4
    path = write_clip(tmp_path / f"clip{suffix}", images, codec=codec, pix_fmt=pix_fmt)
    expected = [frame.copy() for frame in read(path)]
    for frame, untouched in zip(read(path), expected, strict=True):
        assert (frame == untouched).all()
        frame[:] = 0


def test_read_stops_after_max_frames(tmp_path: Path):
    path = write_clip(tmp_path / "clip.mp4", [moving(i) for i in range(10)])
    assert len(list(read(path, max_frames=4))) == 4
    assert len(list(read(path))) == 10


# Display matrices a, b, u, c, d, v, x, y, w; the picture's corners after them, in reading order.
@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        ((ONE, 0, 0, 0, ONE, 0), UPRIGHT),
        ((0, ONE, 0, -ONE, 0, 0), ("blue", "red", "white", "green")),  # quarter clockwise: a phone held upright
        ((-ONE, 0, 0, 0, -ONE, 0), ("white", "blue", "green", "red")),
        ((0, -ONE, 0, ONE, 0, 0), ("green", "white", "red", "blue")),
        ((-ONE, 0, 0, 0, ONE, 0), ("green", "red", "white", "blue")),  # mirrored: a front camera
        ((ONE, 0, 0, 0, -ONE, 0), ("blue", "white", "red", "green")),
        ((0, ONE, 0, ONE, 0, 0), ("red", "blue", "green", "white")),  # transposed
        ((0, -ONE, 0, -ONE, 0, 0), ("white", "green", "blue", "red")),
    ],
)
def test_display_matrix_is_applied(tmp_path: Path, matrix: tuple[int, ...], expected: tuple[str, ...]):
    if not hasattr(av.VideoStream, "set_display_matrix"):
        pytest.skip("this PyAV cannot write a display matrix")

    def setup(stream: av.VideoStream) -> None:
        stream.set_display_matrix([*matrix, 0, 0, 1 << 30])

    clip = open_clip(write_clip(tmp_path / "turned.mp4", [quarters(48, 64)] * 3, setup=setup))
    frames = list(clip)
    size = (64, 48) if matrix[0] else (48, 64)
    assert (clip.info.width, clip.info.height) == size
    assert frames[0].shape == (size[1], size[0], 3)
    assert corners(frames[0]) == expected


@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize("matrix", [("bt709", 1), ("bt601", 6)])
def test_tagged_colours_are_honoured(tmp_path: Path, matrix: tuple[str, int], full_range: bool):
    """Frames coded by hand with the standard's own formula come back as the RGB they stand for."""
    name, number = matrix
    red, blue = (0.2126, 0.0722) if name == "bt709" else (0.299, 0.114)
    colours = np.random.default_rng(0).integers(20, 235, (4, 6, 3))
    chart = colours.repeat(16, 0).repeat(16, 1).astype(float)
    luma = red * chart[..., 0] + (1 - red - blue) * chart[..., 1] + blue * chart[..., 2]
    u, v = (chart[..., 2] - luma) / (2 - 2 * blue), (chart[..., 0] - luma) / (2 - 2 * red)
    if not full_range:
        luma, u, v = 16 + luma * 219 / 255, u * 224 / 255, v * 224 / 255
    planes = np.concatenate(
        [np.rint(p).astype(np.uint8).ravel() for p in (luma, u[::2, ::2] + 128, v[::2, ::2] + 128)]
    )
    picture = planes.reshape(luma.shape[0] * 3 // 2, luma.shape[1])

    path = tmp_path / "chart.mp4"
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=25, options={"qp": "0"})
        stream.height, stream.width, stream.pix_fmt = *luma.shape, "yuv420p"
        stream.codec_context.colorspace, stream.codec_context.color_range = number, 2 if full_range else 1
        output.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="yuv420p")))
        output.mux(stream.encode(None))
    (frame,) = read(path)
    # Rounding of three planes to 8 bits and back.
    assert np.abs(frame[8::16, 8::16].astype(int) - colours).max() <= 3


def test_odd_sizes_are_kept(tmp_path: Path):
    path = write_clip(tmp_path / "odd.webm", [quarters(47, 63)] * 3, codec="libvpx-vp9")
    clip = open_clip(path)
    assert (clip.info.width, clip.info.height) == (63, 47)
    assert [frame.shape for frame in clip] == [(47, 63, 3)] * 3


def test_variable_frame_rate_keeps_every_frame_and_says_so(tmp_path: Path):
    times = [i * 40 + (400 if i > 10 else 0) for i in range(30)]
    clip = open_clip(write_clip(tmp_path / "vfr.mp4", [moving(i) for i in range(30)], times_ms=times))
    assert len(list(clip)) == 30
    assert clip.info.fps == pytest.approx(30 / 1.6, rel=0.05)
    assert any("variable frame rate" in problem for problem in clip.problems)


@pytest.mark.parametrize(
    ("suffix", "codec", "pix_fmt"), [(".mov", "png", "rgba"), (".webm", "libvpx-vp9", "yuva420p")]
)
def test_alpha_is_announced(tmp_path: Path, suffix: str, codec: str, pix_fmt: str):
    image = np.full((48, 64, 4), 200, np.uint8)
    image[24:, :, 3] = 0
    path = write_clip(tmp_path / f"alpha{suffix}", [image] * 3, codec=codec, pix_fmt=pix_fmt, source_format="rgba")
    clip = open_clip(path)
    frames = list(clip)
    assert any("transparent" in problem or "alpha" in problem for problem in clip.problems)
    if codec == "png":
        assert frames[0][30:].max() == 0 and (np.abs(frames[0][:20].astype(int) - 200 * 200 // 255) <= 1).all()


def test_gif_is_a_clip(tmp_path: Path):
    path = write_clip(tmp_path / "x.gif", [moving(i) for i in range(8)], codec="gif", pix_fmt="rgb8", rate=10)
    clip = open_clip(path)
    assert len(list(clip)) == 8 and clip.info.fps == pytest.approx(10)


def test_ten_bits_become_eight(tmp_path: Path):
    path = write_clip(tmp_path / "ten.mov", [quarters(48, 64)] * 2, codec="prores_ks", pix_fmt="yuv422p10le")
    clip = open_clip(path)
    assert corners(next(iter(clip))) == UPRIGHT and clip.problems == []


@pytest.mark.parametrize(("transfer", "white"), [(16, 0.5807), (18, 0.75)])
def test_hdr_keeps_diffuse_white_bright_and_highlights_below_it_apart(tmp_path: Path, transfer: int, white: float):
    """BT.2408 puts diffuse white at 58 % of PQ and 75 % of HLG; brighter light must stay distinguishable."""
    levels = np.array([0.0, white / 2, white, min(1.0, white * 1.2)])
    luma = np.rint(64 + 876 * levels).astype("<u2").repeat(16)[None].repeat(32, 0)
    picture = av.VideoFrame(64, 32, "yuv420p10le")
    for plane, values in zip(picture.planes, (luma, np.full((16, 32), 512), np.full((16, 32), 512)), strict=True):
        rows = np.zeros((plane.height, plane.line_size // 2), "<u2")
        rows[:, : plane.width] = values
        plane.update(rows.tobytes())

    def setup(stream: av.VideoStream) -> None:
        context = stream.codec_context
        context.color_trc, context.colorspace, context.color_primaries, context.color_range = transfer, 9, 9, 1

    path = tmp_path / "hdr.mkv"
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=25, options={"qp": "0"})
        stream.height, stream.width, stream.pix_fmt = 32, 64, "yuv420p10le"
        setup(stream)
        output.mux(stream.encode(picture))
        output.mux(stream.encode(None))
    clip = open_clip(path)
    (frame,) = clip
    black, middle, diffuse, highlight = frame[16, 8::16].astype(int)
    assert np.ptp(frame[16, 8::16].astype(int), axis=1).max() <= 2  # grey stays grey
    assert black.max() <= 2 and 40 < middle[0] < 190 and 215 < diffuse[0] < 250 and highlight[0] > diffuse[0] + 4
    assert any("HDR" in problem for problem in clip.problems)


def test_non_square_pixels_are_stretched(tmp_path: Path):
    def setup(stream: av.VideoStream) -> None:
        stream.sample_aspect_ratio = Fraction(4, 3)

    clip = open_clip(write_clip(tmp_path / "wide.mp4", [quarters(48, 64)] * 2, setup=setup))
    assert (clip.info.width, clip.info.height) == (85, 48)
    assert corners(next(iter(clip))) == UPRIGHT
    assert any("stretched" in problem for problem in clip.problems)


def test_names_that_look_like_protocols_and_patterns(tmp_path: Path):
    for name in ("talk 12:30.mp4", "100%d.mp4", "größe.mp4"):
        path = tmp_path / name
        # The test's own writer would trip over the name, too.
        write_clip(tmp_path / "plain.mp4", [moving(0)] * 2).rename(path)
        assert len(list(read(path))) == 2


def test_checksum_follows_content_only(tmp_path: Path):
    one, two = tmp_path / "one.mp4", tmp_path / "two.mp4"
    one.write_bytes(b"abc")
    two.write_bytes(b"abc")
    assert source_sha256(one) == source_sha256(two)
    assert source_sha256(one).startswith("ba7816bf")  # FIPS 180's example
    two.write_bytes(b"abd")
    assert source_sha256(one) != source_sha256(two)
    with pytest.raises(InputError, match="cannot be read"):
        source_sha256(tmp_path / "absent.mp4")


def test_real_clips_are_read_whole(videos_dir: Path):
    info = probe(videos_dir / "wojtek_1.mp4")
    assert (info.width, info.height, info.fps, info.n_frames) == (512, 512, 25.0, 400)
    assert len(list(read(videos_dir / "wojtek_1.mp4", max_frames=50))) == 50
