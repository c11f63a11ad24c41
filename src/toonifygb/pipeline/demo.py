"""The whole pipeline on a synthetic talking head whose true motion is known."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from toonifygb import head, synthetic, track, video
from toonifygb.pipeline.create import create
from toonifygb.pipeline.source import open_source
from toonifygb.pipeline.stages import write_json

if TYPE_CHECKING:
    from pathlib import Path

    from toonifygb.config import RunConfig
    from toonifygb.pipeline.stages import Run
    from toonifygb.progress import Progress


def demo(run: Run, config: RunConfig, *, seed: int, n_frames: int, size: int = 512) -> None:
    """Makes the clip, makes its avatar, and says how near the track is to the truth.

    Args:
        run: the run to work in; the clip becomes its ``input.mp4``.
        config: settings of the pipeline.
        seed: which synthetic person.
        n_frames: length of the clip, 25 a second.
        size: side of the square clip, px.
    """
    clip, truth_path = run.file("input.mp4"), run.work("truth.safetensors")

    def work(progress: Progress) -> None:
        render_subject(clip, truth_path, progress, seed=seed, n_frames=n_frames, size=size)

    run.stage("clip", "making a talking head", inputs=[seed, n_frames, size], outputs=[clip, truth_path], work=work)
    create(open_source(clip, config), run, config)
    errors = synthetic.errors(track.load(run.file("track.safetensors")), track.load(truth_path), head.load("open"))
    values = json.loads(run.file("metrics.json").read_text())
    write_json(run.file("metrics.json"), {**values, "ground_truth": errors.means()})


def render_subject(
    clip: Path, truth_path: Path, progress: Progress, *, seed: int, n_frames: int, size: int
) -> None:
    """Writes a clip of a synthetic subject and its true track."""
    filmed = synthetic.render_clip(synthetic.make_subject(seed), n_frames=n_frames, size=size)
    with video.Writer(clip, size, size, filmed.sequence.fps) as writer:
        for done, frame in enumerate(filmed.frames, start=1):
            writer.write(frame)
            progress.update(done, n_frames)
    track.save(filmed.sequence, truth_path)
