"""From a clip to an avatar: everything a run promises, resumed at every stage, killed in the middle."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from toonifygb import avatar, synthetic, track, video
from toonifygb.cli.main import run

SETTINGS = (
    "train.steps=60",
    "train.resolution=96",
    "train.n_gaussians=1200",
    "train.n_mouth_gaussians=100",
    "train.checkpoint_seconds=0.2",
    "track.iterations=8",
)
OUTPUTS = (
    "stylized.mp4",
    "overlay.mp4",
    "track.safetensors",
    "preview.mp4",
    "report.html",
    "metrics.json",
    "run.json",
)
N_FRAMES = 26


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short clip of a synthetic subject."""
    path = tmp_path_factory.mktemp("clip") / "subject.mp4"
    filmed = synthetic.render_clip(synthetic.make_subject(3), n_frames=N_FRAMES, size=224)
    with video.Writer(path, 224, 224, 25) as writer:
        for frame in filmed.frames:
            writer.write(frame)
    return path


def command(clip: Path, out: Path) -> list[str]:
    return ["create", str(clip), "--out", str(out), "--quality", "draft", "--settings", *SETTINGS]


@pytest.fixture(scope="module")
def finished(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run from end to end without interruption."""
    out = tmp_path_factory.mktemp("straight") / "run"
    assert run([*command(clip, out), "--quiet"]) == 0
    return out


def test_a_run_leaves_what_it_promises(finished: Path) -> None:
    for name in OUTPUTS:
        assert (finished / name).stat().st_size > 0, name
    values = json.loads((finished / "metrics.json").read_text())
    assert values["n_frames"] == N_FRAMES
    assert values["n_test"] == round(0.15 * N_FRAMES)
    assert values["n_train"] + values["n_test"] == N_FRAMES
    assert values["resolution"] == 96
    assert values["n_gaussians"] == avatar.load(finished / "avatar").n
    assert 0 < values["landmark_error_px"] < 4
    assert values["psnr"] > 12  # sixty steps: a blurred head, but a head
    assert 0 < values["ssim"] <= 1
    assert values["lpips"] is None
    assert values["itf"] > 15
    assert 0 < values["isi"] <= 1
    assert 0 < values["warping_error"] < 0.1
    assert values["peak_memory_mb"] > 50
    for stage in ("landmarks", "stylize", "track", "dataset", "train", "scores", "preview"):
        assert values["seconds"][stage] >= 0


def test_every_video_has_every_frame(finished: Path) -> None:
    for name in ("stylized.mp4", "overlay.mp4", "preview.mp4"):
        assert video.open_clip(finished / name).count() == N_FRAMES, name


def test_the_same_line_again_does_nothing_again(
    clip: Path, finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {name: (finished / name).read_bytes() for name in ("stylized.mp4", "avatar/avatar.safetensors")}
    assert run(command(clip, finished)) == 0
    said = capsys.readouterr().err
    assert said.count("as before") >= 7
    assert {name: (finished / name).read_bytes() for name in before} == before


def test_the_avatar_renders_with_nothing_else_on_disk(finished: Path, tmp_path: Path) -> None:
    alone = shutil.copytree(finished / "avatar", tmp_path / "avatar")
    picture = tmp_path / "smile.png"
    argv = ["render", str(alone), "--out", str(picture), "--expression", "mouthSmileLeft=1", "jawOpen=0.3"]
    assert run([*argv, "--yaw", "20", "--size", "128", "--quiet"]) == 0
    image = video.load_image(picture)
    assert image.shape == (128, 128, 3)
    assert image.max() > 30


def test_the_motion_can_be_played_from_a_swinging_camera(finished: Path, tmp_path: Path) -> None:
    film = tmp_path / "orbit.mp4"
    argv = ["render", str(finished), "--out", str(film), "--orbit", "30", "--size", "96", "--n-frames", "5"]
    assert run([*argv, "--quiet"]) == 0
    assert video.open_clip(film).count() == 5


ORDER = (
    "landmarks",
    "stylize",
    "source",
    "track",
    "dataset",
    "refine",
    "overlay",
    "train",
    "scores",
    "preview",
    "report",
)
MADE_BY = {
    "landmarks": ("work/landmarks.safetensors",),
    "stylize": ("stylized.mp4",),
    "track": ("work/landmark_track.safetensors",),
    "dataset": ("work/dataset/frames.npy", "work/dataset/mattes.npy"),
    "refine": ("track.safetensors",),
    "overlay": ("overlay.mp4",),
    "train": ("avatar/avatar.safetensors",),
    "preview": ("preview.mp4",),
}
TITLES = {
    "landmarks": "finding the face",
    "stylize": "stylising",
    "track": "tracking the head",
    "dataset": "cutting out the head",
    "refine": "refining the track",
    "overlay": "drawing the overlay",
    "train": "training the avatar",
    "preview": "filming the preview",
}


def rewound(finished: Path, out: Path, stage: str) -> Path:
    """A copy of a finished run in which ``stage`` and all after it have not happened yet."""
    shutil.copytree(finished, out)
    state = json.loads((out / "run.json").read_text())
    undone = ORDER[ORDER.index(stage) :]
    state["stages"] = {name: entry for name, entry in state["stages"].items() if name not in undone}
    (out / "run.json").write_text(json.dumps(state))
    for name in ("metrics.json", "report.html", *(file for later in undone for file in MADE_BY.get(later, ()))):
        (out / name).unlink()
    if stage != "scores" and "train" in undone:
        shutil.rmtree(out / "avatar")
        shutil.rmtree(out / "work" / "training")
    if "dataset" in undone:
        shutil.rmtree(out / "work" / "dataset")
    return out


@pytest.mark.slow
@pytest.mark.parametrize("stage", list(MADE_BY))
def test_killed_in_any_stage_it_goes_on_to_the_same_result(
    stage: str, clip: Path, finished: Path, tmp_path: Path
) -> None:
    out = rewound(finished, tmp_path / "run", stage)
    kill_in_stage(command(clip, out), out, stage)
    assert not (out / "metrics.json").exists()
    assert run([*command(clip, out), "--quiet"]) == 0
    for name in MADE_BY[stage]:
        if name == "work/landmark_track.safetensors":  # linear algebra does not promise equal bits from run to run
            ours, theirs = (track.load(folder / name) for folder in (out, finished))
            torch.testing.assert_close(ours.motion.joints, theirs.motion.joints, atol=1e-3, rtol=0)
            torch.testing.assert_close(ours.error_px, theirs.error_px, atol=1e-2, rtol=0)
        else:
            assert (out / name).read_bytes() == (finished / name).read_bytes(), name
    assert json.loads((out / "metrics.json").read_text())["n_frames"] == N_FRAMES


def kill_in_stage(argv: list[str], out: Path, stage: str) -> None:
    """Starts the command in another process and kills it as soon as the stage has been announced."""
    env = {**os.environ, "PYTHONUNBUFFERED": "1"}
    program = "from toonifygb.cli.main import main; import torch; torch.set_num_threads(1); main()"
    process = subprocess.Popen([sys.executable, "-c", program, *argv], stderr=subprocess.PIPE, text=True, env=env)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith(TITLES[stage]) and line.rstrip().endswith("…"):
            break
    else:
        pytest.fail(f"the command ended before the stage {stage}")
    if stage == "train":  # let it take some steps and write a checkpoint first
        checkpoint = out / "work" / "training" / "checkpoint.safetensors"
        deadline = time.monotonic() + 120
        while not checkpoint.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        assert checkpoint.exists()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()
