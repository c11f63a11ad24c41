"""The paper on one page: a clip becomes a stylised video, a track, an avatar, a preview and a report.

Each function below is one stage: it says what it needs, what it leaves, and does the work by calling one room. The
order of the calls in ``create`` is the order of the paper.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from toonifygb import avatar as avatars
from toonifygb import datasets, face, head, stylize, track, train, video
from toonifygb.config import from_json, to_json
from toonifygb.errors import FaceError, InputError
from toonifygb.pipeline import imported
from toonifygb.pipeline.files import LANDMARK_TRACK, load_landmarks, open_crops, save_landmarks
from toonifygb.pipeline.outcome import outcome
from toonifygb.pipeline.segments import SEGMENT, Segments
from toonifygb.pipeline.source import Source, head_name, open_style, style_inputs
from toonifygb.pipeline.stages import STATE_FILE
from toonifygb.structures import Landmarks, TrackedSequence

if TYPE_CHECKING:
    from toonifygb.config import RunConfig
    from toonifygb.pipeline.stages import Run
    from toonifygb.progress import Progress

MIN_FRAMES = 20
"""Fewer tracked frames cannot train and judge an avatar: 15 % of 20 leave three to test on."""
_CHUNK = 8


def create(source: Source, run: Run, config: RunConfig) -> None:
    """Runs every stage from the clip to the report.

    Raises:
        InputError: the clip or a setting cannot be used.
        FaceError: no usable face in the clip.
        Stopped: the user asked to stop; calling again goes on.
    """
    check_size(config)
    check_bases(source, config)
    imported.check_style(source, config)
    remember_request(source, run, config)
    fitted, styled = track_stages(source, run, config)
    check_trainable(run, source)
    cut = cut_dataset(source, run, config, fitted, styled)
    tracked = finish_track(run, config, fitted, cut)
    draw_overlay(source, run, tracked, styled)
    trained = train_avatar(run, config, cut, tracked)
    outcome(source, run, config, trained)


def check_size(config: RunConfig) -> None:
    """Refuses settings under which stylised frames do not lie on the filmed ones.

    Raises:
        InputError: enlarged frames.
    """
    if config.styleganex.size != "source":
        raise InputError(
            f"setting styleganex.size is '{config.styleganex.size}'; an avatar needs frames of the clip's own size",
            "leave it at source, or write the larger video alone with: toonifygb stylize",
        )


def check_bases(source: Source, config: RunConfig) -> None:
    """Refuses a number of blendshape bases before any work is done.

    Raises:
        InputError: one that the head model has no use for.
    """
    if config.train.n_bases is not None:
        avatars.check_bases(config.train, head.load(head_name(config, source.foreign)))


def import_only(source: Source, run: Run, config: RunConfig) -> None:
    """Runs the stages up to the training set of a dataset of other people; ``train RUN`` goes on from there.

    Raises:
        InputError: the source is no such dataset, or something of it is missing.
    """
    if source.foreign is None:
        raise InputError(
            f"{source.path} is no dataset of a kind that can be read ({', '.join(datasets.LAYOUTS)})",
            "give the folder that holds images and checkpoint, or use toonifygb create for a clip",
        )
    imported.check_style(source, config)
    remember_request(source, run, config)
    fitted, styled = track_stages(source, run, config)
    cut = cut_dataset(source, run, config, fitted, styled)
    tracked = finish_track(run, config, fitted, cut)
    draw_overlay(source, run, tracked, styled)


def track_only(source: Source, run: Run, config: RunConfig) -> None:
    """Runs the stages up to the track and its overlay; the pixels are left out, as they need an avatar."""
    remember_request(source, run, config)
    fitted, styled = track_stages(source, run, config)
    tracked = finish_track(run, config, fitted, None)
    draw_overlay(source, run, tracked, styled)


def track_stages(source: Source, run: Run, config: RunConfig) -> tuple[str, str]:
    """Fingerprints of the landmark track and of the stylised video it stands beside."""
    found = find_landmarks(source, run, config)
    styled = stylize_clip(source, run, config, found)
    if source.foreign is not None:
        return imported.take_track(source, run, config, found), styled
    chosen = choose_landmarks(run, config, found, styled)
    return fit_track(source, run, config, chosen), styled


def remember_request(source: Source, run: Run, config: RunConfig) -> None:
    """Keeps in the run what it was asked for, so that ``train RUN`` can ask again."""
    run.state["request"] = {
        "clip": str(source.path.resolve()),
        "sha256": source.sha256,
        "config": json.loads(to_json(config)),
    }
    run.save()


def read_request(path: Path) -> tuple[Path, RunConfig]:
    """Clip and settings of an existing run.

    Raises:
        InputError: the folder is not a run.
    """
    try:
        request = json.loads((path / STATE_FILE).read_text())["request"]
        return Path(request["clip"]), from_json(json.dumps(request["config"]))
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a run of toonifygb", "make one with: toonifygb create CLIP") from error


def find_landmarks(source: Source, run: Run, config: RunConfig) -> str:
    """478 landmarks in every frame of the original."""
    path = run.work("landmarks.safetensors")

    def work(progress: Progress) -> None:
        frames, problems = source.clip(config)
        try:
            landmarks, report = face.find_landmarks(
                frames, config.face, n_frames=source.n_frames(config), progress=progress
            )
            sentences = list(report.problems)
        except FaceError as error:
            if source.foreign is None:
                raise
            landmarks, sentences = imported.unseen_landmarks(source, config), [error.message]
        run.problems("video", list(problems))
        run.problems("face", sentences)
        save_landmarks(landmarks, path)

    return run.stage(
        "landmarks",
        "finding the face",
        inputs=[source.sha256, config.face, config.max_frames],
        outputs=[path],
        work=work,
    )


def stylize_clip(source: Source, run: Run, config: RunConfig, found: str) -> str:
    """Stage 1: every frame in the chosen style, with the source's sound, size and pace."""
    out = run.file("stylized.mp4")
    inputs = [found, *style_inputs(config), config.max_frames]

    def work(progress: Progress) -> None:
        landmarks = load_landmarks(run.work("landmarks.safetensors"))
        segments = Segments(run.work("stylize"), *inputs)
        write_stylized(source, out, config, landmarks, segments, progress)

    return run.stage("stylize", f"stylising ({config.stylize.style})", inputs=inputs, outputs=[out], work=work)


def write_stylized(
    source: Source,
    out: Path,
    config: RunConfig,
    landmarks: Landmarks,
    segments: Segments,
    progress: Progress,
) -> None:
    """Streams the clip through its style into ``out``, from where an earlier attempt was interrupted."""
    stylizer = open_style(config)
    strength = config.stylize.strength

    def prepare() -> dict[str, Any]:
        with closing(source.frames(config)) as frames:
            return stylize.prepare(frames, landmarks, stylizer, strength=strength)

    state = segments.state(prepare)
    start = len(segments.finished()) * SEGMENT
    with closing(source.frames(config)) as frames:
        styled = stylize.stylize_frames(frames, landmarks, stylizer, state, strength=strength, start=start)
        segments.write(styled, source.info.fps, progress, landmarks.points.shape[0])
    segments.join(out, source)


def choose_landmarks(run: Run, config: RunConfig, found: str, styled: str) -> str:
    """Landmarks that the head model is fitted to: the original's, carried along by the style's caricature, or those
    found anew in the stylised video.
    """
    out = run.work("landmarks_chosen.safetensors")

    def work(progress: Progress) -> None:
        original = load_landmarks(run.work("landmarks.safetensors"))
        stylizer = open_style(config)
        carried = stylize.warp_landmarks(original, stylizer, config.stylize.strength)
        choice, reason, chosen = "original", "", carried
        if config.track.on != "original" and config.stylize.style != "none":
            choice, reason, chosen = _compare_landmarks(run, config, carried, progress)
        run.state["track_on"] = {"choice": choice, "reason": reason}
        if reason:
            run.reporter.note(f"tracking the {choice} video: {reason}")
        save_landmarks(chosen, out)

    inputs = [found, styled, config.track.on]
    return run.stage("source", "choosing what to track", inputs=inputs, outputs=[out], work=work)


def _compare_landmarks(
    run: Run, config: RunConfig, carried: Landmarks, progress: Progress
) -> tuple[str, str, Landmarks]:
    """Choice, reason and landmarks when the stylised video is a candidate."""
    frames = video.read(run.file("stylized.mp4"))
    n = carried.points.shape[0]
    try:
        stylized, _ = face.find_landmarks(frames, config.face, n_frames=n, progress=progress)
    except FaceError:
        if config.track.on == "stylized":
            raise
        return "original", "the face is not found in the stylised video", carried
    if config.track.on == "stylized":
        return "stylized", "as asked for", stylized
    choice = track.choose_source(carried, stylized)
    return choice.on, choice.reason, stylized if choice.on == "stylized" else carried


def fit_track(source: Source, run: Run, config: RunConfig, chosen: str) -> str:
    """The head model fitted to the landmarks."""
    out = run.work(LANDMARK_TRACK)

    def work(progress: Progress) -> None:
        sequence = track.fit(
            load_landmarks(run.work("landmarks_chosen.safetensors")),
            head.load(config.head),
            config.track,
            fps=source.info.fps,
            source_sha256=source.sha256,
            progress=progress,
        )
        run.problems("track", list(track.report(sequence).problems))
        track.save(sequence, out)

    settings = {"head": config.head, "n_shape": config.track.n_shape, "iterations": config.track.iterations}
    return run.stage("track", "tracking the head", inputs=[chosen, settings], outputs=[out], work=work)


def finish_track(run: Run, config: RunConfig, fitted: str, cut: str | None) -> str:
    """The final track: head poses fitted to the pixels of the crops, or as the landmarks have them."""
    out = run.file("track.safetensors")
    dataset = cut if config.track.photometric else None
    checkpoint = run.work("refine.safetensors")

    def work(progress: Progress) -> None:
        sequence = track.load(run.work(LANDMARK_TRACK))
        if dataset is not None:
            sequence = train.refine_track(
                open_crops(run, sequence),
                sequence,
                head.load(sequence.head_model),
                seed=config.train.seed,
                backend=config.backend,
                threads=config.threads,
                checkpoint=checkpoint,
                progress=progress,
            )
        track.save(sequence, out)
        checkpoint.unlink(missing_ok=True)

    title = "keeping the track" if dataset is None else "refining the track"
    return run.stage("refine", title, inputs=[fitted, dataset, config.train.seed], outputs=[out], work=work)


def draw_overlay(source: Source, run: Run, tracked: str, styled: str) -> None:
    """The head model drawn on the clip: how well it is tracked."""
    out = run.file("overlay.mp4")

    def work(progress: Progress) -> None:
        info, sequence = source.info, track.load(run.file("track.safetensors"))
        draw = track.Overlay(sequence, head.load(sequence.head_model))
        films = video.read(run.file("stylized.mp4"), max_frames=sequence.n_frames)
        with video.Writer(out, info.width, info.height, info.fps, audio_from=source.path) as writer:
            for index, frame in enumerate(films):
                writer.write(draw(frame[: info.height, : info.width], index))
                progress.update(index + 1, sequence.n_frames)

    run.stage("overlay", "drawing the overlay", inputs=[tracked, styled], outputs=[out], work=work)


def check_trainable(run: Run, source: Source) -> None:
    """Refuses clips too short for an avatar.

    Raises:
        InputError: fewer than ``MIN_FRAMES`` tracked frames.
    """
    usable = int(track.load(run.work(LANDMARK_TRACK)).tracked.sum())
    if usable < MIN_FRAMES:
        raise InputError(
            f"{source.path.name} has {usable} usable frame{'' if usable == 1 else 's'}; an avatar needs at least "
            f"{MIN_FRAMES} with a face",
            "record 10 to 30 seconds in which the head turns and the mouth moves",
        )


def cut_dataset(source: Source, run: Run, config: RunConfig, fitted: str, styled: str) -> str:
    """The square head crops and mattes that Stage 2 is trained on."""
    out, training = run.work("dataset"), imported.train_config(source, config)

    def work(progress: Progress) -> None:
        sequence = track.load(run.work(LANDMARK_TRACK))
        model = head.load(sequence.head_model)
        if imported.own_mattes(source):
            pairs = imported.head_pictures(source, run, config)
            train.build_dataset(pairs, sequence, model, training, out, progress=progress)
            return
        frames = (f[: source.info.height, : source.info.width] for f in video.read(run.file("stylized.mp4")))
        landmarks = load_landmarks(run.work("landmarks.safetensors"))
        stylizer = open_style(config)
        photos = stylize.warp_frames(source.frames(config), landmarks, stylizer, config.stylize.strength)
        pairs = head_frames(photos, frames, sequence, model)
        train.build_dataset(pairs, sequence, model, training, out, progress=progress)

    keys = ("resolution", "crop_scale", "test_share", "max_test_frames", "test_parts")
    settings = {key: getattr(training, key) for key in keys}
    return run.stage(
        "dataset",
        "cutting out the head",
        inputs=[fitted, styled, settings],
        outputs=[out],
        work=work,
    )


def head_frames(
    original: Iterable[np.ndarray],
    styled: Iterable[np.ndarray],
    sequence: TrackedSequence,
    model: head.HeadModel,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Stylised frames with the matte of the head: hair kept, cut below the neck.

    The person is segmented in photographs with the style's outlines: the segmenter knows photographs, and the matte
    must end where the drawn person does.

    Args:
        original: filmed frames, warped as the style warps them.
        styled: the same frames in the style.
        sequence: the track.
        model: the head model of the track.

    Yields:
        frame uint8 ``(h, w, 3)`` and matte float32 ``(h, w)``.
    """
    segmenter = face.PersonSegmenter()
    boxes = track.head_boxes(sequence, model).face.numpy()
    region = track.HeadRegion(sequence, model)
    pairs = enumerate(zip(original, styled, strict=False))
    while chunk := list(itertools.islice(pairs, _CHUNK)):
        indices = [index for index, _ in chunk]
        photos = np.stack([photo for _, (photo, _) in chunk])
        persons = segmenter.segment(photos, boxes=boxes[indices])
        for (index, (photo, frame)), person in zip(chunk, persons, strict=True):
            matte = face.head_matte(photo, person, region(index).numpy())
            yield face.foreground(frame, matte), matte


def train_avatar(run: Run, config: RunConfig, cut: str, tracked: str) -> str:
    """Stage 2: Gaussian blendshapes trained on the crops."""
    out = run.file("avatar")

    def work(progress: Progress) -> None:
        sequence = track.load(run.file("track.safetensors"))
        trained = train.train(
            open_crops(run, sequence),
            sequence,
            head.load(sequence.head_model),
            config.train,
            run.work("training"),
            backend=config.backend,
            threads=config.threads,
            progress=progress,
        )
        avatars.save(trained, out, storage=config.train.storage)

    return run.stage("train", "training the avatar", inputs=[cut, tracked, config.train], outputs=[out], work=work)
