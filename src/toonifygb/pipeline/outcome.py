"""What a run leaves for people: held-out scores, the preview video, the report and ``metrics.json``."""

from __future__ import annotations

import itertools
import json
import platform
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from toonifygb import __version__, head, metrics, stylize, track, train, video
from toonifygb import avatar as avatars
from toonifygb.atomic import replacing
from toonifygb.avatar.model import pose_quantities
from toonifygb.pipeline import pictures
from toonifygb.pipeline.files import LANDMARK_TRACK, open_crops
from toonifygb.pipeline.report import Curve, Picture, Report, render_report
from toonifygb.pipeline.stages import peak_memory_mb, write_json
from toonifygb.pipeline.viewing import AvatarViewer, posed
from toonifygb.progress import Part

if TYPE_CHECKING:
    from jaxtyping import Float

    from toonifygb.config import RunConfig
    from toonifygb.pipeline.source import Source
    from toonifygb.pipeline.stages import Run
    from toonifygb.progress import Progress
    from toonifygb.structures import TrackedSequence
    from toonifygb.train import Dataset

_PANEL = 384
"""Side of each of the preview's four panels, px."""
_SWING_DEG, _SWING_LEAST_DEG, _SWING_BEYOND_DEG, _SWING_SECONDS = 35.0, 15.0, 10.0, 6.0
"""The moving side view: how far it turns to each side, the least it may, how far beyond the head's own turns, and
how long one swing there and back takes at most."""
_LABELS = ("input", "stylised", "avatar", "avatar, moving view")
_VIEWS_DEG = (-50.0, -25.0, 0.0, 25.0, 50.0)
_EYES, _MOUTH, _CLOSE_MARGIN = (33, 263, 159, 145, 386, 374), (61, 291, 0, 17), 1.4
"""Landmarks around both eyes and around the lips, and how much wider their squares in the report are."""
_EXPRESSIONS: tuple[tuple[str, dict[str, float]], ...] = (
    ("calm", {}),
    ("jaw open", {"jawOpen": 0.5}),
    ("smile", {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9}),
    ("pucker", {"mouthPucker": 0.9}),
    ("brows up", {"browInnerUp": 0.9, "browOuterUpLeft": 0.9, "browOuterUpRight": 0.9}),
    ("eyes closed", {"eyesClosed": 1.0}),
)


def outcome(source: Source, run: Run, config: RunConfig, trained: str) -> None:
    """Judges the avatar on the held-out frames and shows it."""
    scored = score(source, run, config, trained)
    shown = make_preview(source, run, config, trained)
    write_report(source, run, config, scored, shown)


def score(source: Source, run: Run, config: RunConfig, trained: str) -> str:
    """Held-out scores of the avatar and steadiness of the stylised video."""
    out = run.work("scores.json")

    def work(progress: Progress) -> None:
        sequence = track.load(run.file("track.safetensors"))
        dataset = open_crops(run, sequence)
        model, engine = avatars.load(run.file("avatar")), {"backend": config.backend, "threads": config.threads}
        test, n_frames = dataset.split.test, sequence.n_frames
        starts = (0, len(test), 2 * len(test), 2 * len(test) + n_frames)
        parts = [Part(progress, start, starts[-1] + n_frames) for start in starts]
        held_out = train.evaluate(model, dataset, sequence, test, **engine, progress=parts[0])
        by_landmarks = track.load(run.work(LANDMARK_TRACK))
        driven = train.evaluate(model, dataset, by_landmarks, test, **engine, progress=parts[1])
        held_out |= {f"{name}_landmark_pose": driven[name] for name in ("psnr", "ssim")}
        refined_error = track.landmark_errors(sequence, head.load(sequence.head_model))
        held_out["landmark_error_refined_px"] = _mean(refined_error[sequence.error_px.isfinite()])
        styled = run.file("stylized.mp4")
        steadiness = metrics.stability(parts[2].over(video.read(styled)))
        with closing(source.frames(config)) as filmed:
            warping = stylize.warping_error(filmed, parts[3].over(_cropped(video.read(styled), source)))
        steady = {"itf": steadiness.itf, "isi": steadiness.isi, "warping_error": warping}
        write_json(out, {**held_out, **steady})

    return run.stage("scores", "judging on held-out frames", inputs=[trained], outputs=[out], work=work)


def _mean(values: torch.Tensor) -> float | None:
    """Mean of the finite values; ``None`` where there are none, as JSON has no NaN."""
    values = values[values.isfinite()]
    return float(values.mean()) if len(values) else None


def _cropped(frames: Iterator[np.ndarray], source: Source) -> Iterator[np.ndarray]:
    """Frames without the row or column that an odd size gains in the file."""
    yield from (frame[: source.info.height, : source.info.width] for frame in frames)


def make_preview(source: Source, run: Run, config: RunConfig, trained: str) -> str:
    """Side by side: input, stylised, avatar at the same pose, avatar from a moving view."""
    out = run.file("preview.mp4")

    def work(progress: Progress) -> None:
        sequence = track.load(run.file("track.safetensors"))
        height = _PANEL + pictures.LABEL_HEIGHT
        with video.Writer(out, 4 * _PANEL, height, source.info.fps, audio_from=source.path) as writer:
            for index, panels in enumerate(preview_panels(source, run, config, sequence)):
                writer.write(pictures.row(panels, _LABELS))
                progress.update(index + 1, sequence.n_frames)

    return run.stage("preview", "filming the preview", inputs=[trained], outputs=[out], work=work)


def preview_panels(
    source: Source, run: Run, config: RunConfig, sequence: TrackedSequence
) -> Iterator[list[np.ndarray]]:
    """The four panels of every frame, uint8 RGB squares of one size."""
    dataset = train.load_dataset(run.work("dataset"))
    viewer = AvatarViewer(avatars.load(run.file("avatar")), _PANEL, backend=config.backend, threads=config.threads)
    swing = swing_deg(sequence, source.info.fps)
    films = zip(source.frames(config), video.read(run.file("stylized.mp4")), strict=False)
    for index, film in enumerate(itertools.islice(films, dataset.n_frames)):
        motion = sequence.motion[index]
        viewer.look_through(dataset.camera(index))
        yield [
            *(train.crop(frame, dataset.boxes[index], _PANEL) for frame in film),
            *viewer.frames(motion, [(0.0, 0.0), (float(swing[index]), 0.0)]),
        ]


def swing_deg(sequence: TrackedSequence, fps: float) -> Float[np.ndarray, " t"]:
    """Yaw of the moving view in every frame: a swing to both sides that never goes far beyond what was filmed.

    No clip shows what an avatar looks like from where nothing was filmed, so the view keeps within a few degrees of
    the sides that the head showed of itself.

    Args:
        sequence: the track.
        fps: frames per second.
    """
    yaw = pose_quantities(sequence.motion)[:, 2].rad2deg().numpy()
    seen = yaw[sequence.tracked.numpy()]
    middle, (low, high) = np.median(seen), np.quantile(seen, (0.05, 0.95))
    low = min(low - _SWING_BEYOND_DEG, middle - _SWING_LEAST_DEG)
    high = max(high + _SWING_BEYOND_DEG, middle + _SWING_LEAST_DEG)
    period = min(_SWING_SECONDS * fps, len(yaw))
    swing = _SWING_DEG * np.sin(2 * np.pi * np.arange(len(yaw)) / period)
    return swing.clip(yaw - high, yaw - low)  # seen from the camera's place the head is turned by yaw - swing


def write_report(source: Source, run: Run, config: RunConfig, scored: str, shown: str) -> None:
    """``report.html`` and ``metrics.json``."""
    sheet = run.work("pictures")

    def work(progress: Progress) -> None:
        sheet.mkdir(exist_ok=True)
        for name, image in report_pictures(run, config).items():
            (sheet / f"{name}.jpg").write_bytes(video.encode_jpeg(image))

    run.stage("report", "writing the report", inputs=[scored, shown], outputs=[sheet], work=work)
    scores = json.loads(run.work("scores.json").read_text())
    values = metrics_record(source, run, config, scores)
    write_json(run.file("metrics.json"), values)
    page = render_report(report_page(source, run, config, values))
    with replacing(run.file("report.html")) as temporary:
        temporary.write_text(page, encoding="utf-8")


def metrics_record(source: Source, run: Run, config: RunConfig, scores: dict[str, Any]) -> dict[str, Any]:
    """Everything measured in a run, by name."""
    sequence = track.load(run.file("track.safetensors"))
    dataset = train.load_dataset(run.work("dataset"))
    model = avatars.load(run.file("avatar"))
    errors = sequence.error_px[sequence.tracked]
    stages = run.state["stages"]
    return {
        "clip": source.path.name,
        "clip_sha256": source.sha256,
        "style": config.stylize.style,
        "quality": config.quality,
        **{name: value for name, value in scores.items() if not isinstance(value, list)},
        "n_frames": sequence.n_frames,
        "n_train": len(dataset.split.train),
        "n_test": len(dataset.split.test),
        "resolution": dataset.size,
        "n_gaussians": model.n,
        "landmark_error_px": _mean(errors),
        "track_on": run.state["track_on"]["choice"],
        "seconds": run.seconds(),
        "peak_memory_mb": max([peak_memory_mb(), *(entry["peak_memory_mb"] for entry in stages.values())]),
        "versions": {
            "toonifygb": __version__,
            "torch": str(torch.__version__),
            "python": platform.python_version(),
        },
        "problems": [sentence for sentences in run.state["problems"].values() for sentence in sentences],
    }


def report_pictures(run: Run, config: RunConfig) -> dict[str, np.ndarray]:
    """The report's pictures by name, uint8 RGB."""
    sequence = track.load(run.file("track.safetensors"))
    dataset = open_crops(run, sequence)
    model = avatars.load(run.file("avatar"))
    viewer = AvatarViewer(model, dataset.size, backend=config.backend, threads=config.threads)
    middle = model.motion_mean
    test = dataset.split.test or dataset.split.train
    held_out, close = [], []
    for index in sorted({test[0], test[len(test) // 2], test[-1]}):
        viewer.look_through(dataset.camera(index))
        target = (dataset.target(index)[0] * 255).round().to(torch.uint8).numpy()
        image = viewer.frame(sequence.motion[index])
        held_out.append(
            pictures.row(
                [target, image, pictures.error_map(image, target)], ("held out", "avatar", "difference × 4"), 360
            )
        )
        places = face_parts(sequence, dataset, index)
        cuts = [pictures.cut(picture, place) for place in places for picture in (target, image)]
        if cuts:
            close.append(pictures.row(cuts, ("eyes, held out", "avatar", "mouth, held out", "avatar"), 270))
    viewer.look_through(dataset.camera(dataset.split.train[len(dataset.split.train) // 2]))
    views = viewer.frames(middle, [(yaw, 0.0) for yaw in _VIEWS_DEG])
    shown = expressions(model)
    faces = [viewer.frame(posed(model, weights)) for _, weights in shown]
    found = {
        "1-held-out": pictures.stack(held_out),
        "3-views": pictures.row(views, [f"{yaw:+.0f} deg" for yaw in _VIEWS_DEG], 240),
        "4-expressions": pictures.row(faces, [name for name, _ in shown], 200),
        "5-tracking": overlay_sheet(run, sequence),
    }
    return found | ({"2-close": pictures.stack(close)} if close else {})


def face_parts(sequence: TrackedSequence, dataset: Dataset, index: int) -> list[tuple[int, int, int]]:
    """Squares around the eyes and the mouth of a frame: left, top and side in px of its crop; none where no
    landmarks were found.
    """
    points = sequence.landmarks.points[index]
    if not points.isfinite().all():
        return []
    left, top, right, _ = (float(edge) for edge in dataset.boxes[index])
    points = (points - points.new_tensor([left, top])) * (dataset.size / (right - left))
    squares = []
    for part in (_EYES, _MOUTH):
        low, high = points[list(part)].amin(0), points[list(part)].amax(0)
        side = _CLOSE_MARGIN * float((high - low).max())
        x, y = ((low + high - side) / 2).tolist()
        squares.append((round(x), round(y), round(side)))
    return squares


def expressions(model: avatars.Avatar) -> list[tuple[str, dict[str, float]]]:
    """Expressions for the report: known faces by name, and, of a head model without such names, its first units."""
    known = {"jawOpen", "eyesClosed", *model.blendshape_names[: model.n_expressions]}
    if all(weights.keys() <= known for _, weights in _EXPRESSIONS):
        return list(_EXPRESSIONS)
    named = [entry for entry in _EXPRESSIONS if entry[1].keys() <= known]
    return named + [(name, {name: 2.0}) for name in model.blendshape_names[: len(_EXPRESSIONS) - len(named)]]


def overlay_sheet(run: Run, sequence: TrackedSequence) -> np.ndarray:
    """Four moments of the overlay video side by side."""
    wanted = set(np.linspace(0, sequence.n_frames - 1, 4).round().astype(int).tolist())
    frames = [f for i, f in enumerate(video.read(run.file("overlay.mp4"))) if i in wanted]
    return np.concatenate(frames, axis=1)


_CAPTIONS = {
    "1-held-out": "Frames the training never saw: the target, the avatar, and the difference.",
    "2-close": "Their eyes and mouths.",
    "3-views": "The mean pose from new views.",
    "4-expressions": "Expressions set by name.",
    "5-tracking": "The head model on the clip.",
}


def report_page(source: Source, run: Run, config: RunConfig, values: dict[str, Any]) -> Report:
    """The report's record from the run's files and figures."""
    sheet = run.work("pictures")
    seconds, error = list(values["seconds"].items()), values["landmark_error_px"]
    tiles = [
        ("PSNR, held out", f"{values['psnr']:.2f} dB"),
        ("SSIM, held out", f"{values['ssim']:.4f}"),
        ("landmark error", "no face found" if error is None else f"{error:.2f} px"),
        ("Gaussians", f"{values['n_gaussians']:,}"),
        ("steadiness (ITF)", f"{values['itf']:.1f} dB"),
        ("time", f"{sum(s for _, s in seconds) / 60:.1f} min"),
    ]
    facts = [
        ("clip", values["clip"]),
        ("frames", f"{values['n_frames']} ({values['n_train']} trained on, {values['n_test']} held out)"),
        ("crop", f"{values['resolution']} px square"),
        ("tracked video", values["track_on"]),
        ("PSNR with the head pose of the landmarks alone", f"{values['psnr_landmark_pose']:.2f} dB"),
        ("ISI", f"{values['isi']:.4f}"),
        ("warping error of the stylised video", f"{values['warping_error']:.4f}"),
        ("peak memory", f"{values['peak_memory_mb']:.0f} MB"),
        *((name, str(version)) for name, version in values["versions"].items()),
    ]
    drawn = [(sheet / f"{name}.jpg", caption) for name, caption in _CAPTIONS.items()]
    captions = [Picture(path.read_bytes(), caption) for path, caption in drawn if path.is_file()]
    return Report(
        title=f"{source.path.stem} · {config.stylize.style}",
        lead=f"{config.quality} quality, made by toonifygb {__version__}",
        scores=tiles,
        pictures=captions,
        curves=training_curves(run.work("training")),
        stages=seconds,
        problems=values["problems"],
        facts=facts,
    )


def training_curves(folder: Path) -> list[Curve]:
    """Loss over the training steps, from the lines the training wrote."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    lines = [line for line in lines if "loss" in line]
    if len(lines) < 2:
        return []
    return [Curve("training loss", [line["step"] for line in lines], [line["loss"] for line in lines])]
