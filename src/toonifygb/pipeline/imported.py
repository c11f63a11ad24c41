"""Runs that start from somebody else's track: the stages of such a run that differ, and the way back.

The pictures are the clip and the dataset's track takes the place of our own fit; everything after it is the same.
Faces are looked for all the same: styles need them, and they say how well the foreign track sits on the pictures.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from toonifygb import datasets, head, track, train, video
from toonifygb.errors import InputError
from toonifygb.pipeline.files import LANDMARK_TRACK, load_landmarks
from toonifygb.pipeline.source import head_name, open_style

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import numpy as np

    from toonifygb.config import RunConfig, TrainConfig
    from toonifygb.pipeline.source import Source
    from toonifygb.pipeline.stages import Reporter, Run
    from toonifygb.progress import Progress
    from toonifygb.structures import Landmarks, TrackedSequence


def check_style(source: Source, config: RunConfig) -> None:
    """Refuses styles that change a face's shape: a track made elsewhere does not follow them.

    Raises:
        InputError: such a style on a dataset.
    """
    if source.foreign is None:
        return
    caricature = open_style(config).exaggeration.scaled(config.stylize.strength)
    if not caricature.is_none:
        raise InputError(
            f"the style '{config.stylize.style}' overdraws eyes and chin, and the track of {source.path.name} does "
            "not know of it",
            "use --style none, arcane, cartoon or pixar, or track the pictures anew with: toonifygb create",
        )


def foreign_track(source: Source, config: RunConfig) -> datasets.ForeignTrack:
    """The dataset's track in our world, with landmarks where its head model has them."""
    assert source.foreign is not None, "the source is no dataset"
    model = head.load(head_name(config, source.foreign))
    return datasets.read_track(source.foreign, model, fps=source.info.fps, source_sha256=source.sha256)


def unseen_landmarks(source: Source, config: RunConfig) -> Landmarks:
    """Landmarks of a dataset in whose pictures no face is found, as drawings may be: the track's own, score 0."""
    landmarks = foreign_track(source, config).sequence.landmarks
    return replace(landmarks, score=torch.zeros_like(landmarks.score))


def take_track(source: Source, run: Run, config: RunConfig, found: str) -> str:
    """The dataset's track, beside the landmarks found in its pictures."""
    foreign = source.foreign
    assert foreign is not None, "the source is no dataset"
    out = run.work(LANDMARK_TRACK)

    def work(progress: Progress) -> None:
        read = foreign_track(source, config)
        landmarks = load_landmarks(run.work("landmarks.safetensors"))
        sequence = replace(read.sequence, landmarks=landmarks)
        errors = track.landmark_errors(sequence, head.load(sequence.head_model))
        errors = torch.where(landmarks.score > 0, errors, torch.nan)
        run.problems("track", list(read.problems))
        run.state["track_on"] = {"choice": "imported", "reason": foreign.layout, "own_mattes": own_mattes(source)}
        track.save(replace(sequence, error_px=errors), out)
        progress.update(1, 1)

    return run.stage("track", "taking the track", inputs=[found, config.head], outputs=[out], work=work)


def own_mattes(source: Source) -> bool:
    """Whether the source is a dataset that says where the head is."""
    return source.foreign is not None and source.foreign.pictures[0].has_matte


def train_config(source: Source, config: RunConfig) -> TrainConfig:
    """Settings of the training set: a dataset says itself how many frames at its end are held out."""
    if source.foreign is None:
        return config.train
    return replace(config.train, test_share=1.0, max_test_frames=source.foreign.n_test, test_parts=1)


def head_pictures(source: Source, run: Run, config: RunConfig) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pictures with the dataset's own mattes; in the style, where there is one."""
    assert source.foreign is not None, "the source is no dataset"
    plain = config.stylize.style == "none"
    styled = itertools.repeat(None) if plain else video.read(run.file("stylized.mp4"))
    for picture, drawn in zip(source.foreign.pictures, styled, strict=False):
        color, matte = datasets.read_picture(picture)
        assert matte is not None, f"{picture.image} has no matte"
        yield (color if drawn is None else drawn[: source.info.height, : source.info.width]), matte


def export_run(path: Path, out: Path, layout: str, reporter: Reporter) -> None:
    """Writes a run's track and head crops as a dataset of ``layout``: ``insta`` or ``3dgb``.

    Raises:
        InputError: the run has no track or crops yet, or was not tracked with FLAME.
    """
    sequence: TrackedSequence = track.load(path / "track.safetensors")
    crops = train.load_dataset(path / "work" / "dataset")
    written = datasets.export_dataset(
        sequence,
        head.load(sequence.head_model),
        datasets.Crops(
            crops.boxes, crops.frames.shape[1], lambda index: (crops.frames[index], crops.mattes[index])
        ),
        out,
        n_test=sequence.n_frames - min(crops.split.test, default=sequence.n_frames),
        meshes=layout == "insta",
        progress=reporter.stage("export", f"writing {layout}"),
    )
    for sentence in written.problems:
        reporter.note(sentence)
    reporter.note(f"{written.n_frames} frames of {written.width} px, the last {written.n_test} held out: {out}")
