"""The single steps behind ``toonifygb stylize`` and ``toonifygb render``: files in, one file out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from toonifygb import avatar as avatars
from toonifygb import face, track, video
from toonifygb.errors import FaceError, InputError
from toonifygb.pipeline.create import write_stylized
from toonifygb.pipeline.segments import Segments
from toonifygb.pipeline.source import open_source, style_inputs
from toonifygb.pipeline.viewing import AvatarViewer, parse_color, posed
from toonifygb.structures import Landmarks

TRACK_FILE = "track.safetensors"

if TYPE_CHECKING:
    from toonifygb.config import RunConfig
    from toonifygb.pipeline.stages import Reporter


def stylize_file(clip: Path, out: Path, config: RunConfig, reporter: Reporter) -> None:
    """Writes ``clip`` in its style to ``out``; a clip without a face is stylised without the face's touches.

    Finished stretches wait in a folder ``.parts`` beside ``out``: the same call goes on with it after a stop.

    Raises:
        InputError: the clip, the style or the output cannot be used.
    """
    if out.suffix.lower() != ".mp4":
        raise InputError(f"output {out} does not end in .mp4; stylised clips are written as mp4")
    source = open_source(clip, config)
    progress = reporter.stage("landmarks", "finding the face")
    opened = video.open_clip(clip)
    try:
        landmarks, report = face.find_landmarks(
            source.frames(config), config.face, n_frames=source.n_frames(config), progress=progress
        )
        problems = list(report.problems)
    except FaceError as error:
        landmarks = _no_landmarks(source.info.width, source.info.height, opened.count())
        problems = [f"{error.message}; stylising without the face's touches"]
    for sentence in [*opened.problems, *problems]:
        reporter.note(sentence)
    progress = reporter.stage("stylize", f"stylising ({config.stylize.style})")
    inputs = [source.sha256, config.face, *style_inputs(config), config.max_frames]
    segments = Segments(out.with_suffix(".parts"), *inputs)
    write_stylized(source, out, config, landmarks, segments, progress)


def _no_landmarks(width: int, height: int, n_frames: int) -> Landmarks:
    return Landmarks(torch.full((n_frames, 478, 2), math.nan), torch.zeros(n_frames), width, height)


@dataclass(frozen=True)
class RenderRequest:
    """What ``toonifygb render`` was asked for."""

    avatar: Path
    out: Path
    motion: Path | None
    expression: tuple[str, ...]
    yaw_deg: float
    pitch_deg: float
    orbit_deg: float
    size: int
    n_frames: int | None
    background: str
    backend: str
    threads: int | None


def render_file(request: RenderRequest, reporter: Reporter) -> None:
    """Writes a picture (.png) or a video (.mp4) of an avatar.

    Raises:
        InputError: no avatar there, an unknown expression or colour, an output of another kind.
    """
    model = avatars.load(_inside(request.avatar, "avatar"))
    viewer = AvatarViewer(model, request.size, parse_color(request.background), request.backend, request.threads)
    suffix = request.out.suffix.lower()
    if suffix == ".png":
        motion = posed(model, parse_weights(request.expression))
        frame = viewer.frame(motion, request.yaw_deg, request.pitch_deg)
        video.save_png(request.out, frame)
    elif suffix == ".mp4":
        _render_video(request, model, viewer, reporter)
    else:
        raise InputError(
            f"output {request.out} ends in '{suffix}'; expected .png for a picture or .mp4 for a video"
        )


def _inside(path: Path, name: str) -> Path:
    """``path``, or the ``name`` inside it when ``path`` is a run."""
    return path / name if (path / name).exists() else path


def parse_weights(items: tuple[str, ...]) -> dict[str, float]:
    """``("jawOpen=0.5",)`` → ``{"jawOpen": 0.5}``.

    Raises:
        InputError: an item of another form.
    """
    weights = {}
    for item in items:
        name, _, text = item.partition("=")
        try:
            weights[name] = float(text)
        except ValueError:
            raise InputError(
                f"expression '{item}' is not of the form NAME=WEIGHT, for instance jawOpen=0.5"
            ) from None
    return weights


def _render_video(request: RenderRequest, model: avatars.Avatar, viewer: AvatarViewer, reporter: Reporter) -> None:
    """Plays a motion; the view swings once to each side when an orbit is asked for."""
    place = _inside(request.motion, TRACK_FILE) if request.motion else request.avatar / TRACK_FILE
    if not place.is_file():
        place = request.avatar.parent / TRACK_FILE
    if not place.is_file():
        raise InputError(
            f"no motion to play: {request.avatar} lies in no run", "pass a track.safetensors or a run with --motion"
        )
    sequence = track.load(place)
    motion = sequence.motion
    n = min(request.n_frames or motion.joints.shape[0], motion.joints.shape[0])
    progress = reporter.stage("render", "rendering")
    size = viewer.camera.width
    with video.Writer(request.out, size, viewer.camera.height, sequence.fps) as writer:
        swings = [request.orbit_deg * math.sin(2 * math.pi * index / max(n, 1)) for index in range(n)]
        angles = [(request.yaw_deg + swing, request.pitch_deg) for swing in swings]
        for done, picture in enumerate(viewer.play(motion[:n], angles), start=1):
            writer.write(picture)
            progress.update(done, n)
