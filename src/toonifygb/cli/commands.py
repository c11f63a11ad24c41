"""The commands. Each imports what it needs when it runs, so that ``--help`` stays instant."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from toonifygb.cli.assets import assets
from toonifygb.cli.progress import Terminal
from toonifygb.cli.style import style
from toonifygb.config import (
    PRESETS,
    WHOLE_PICTURE,
    Blendshapes,
    FaceConfig,
    Quality,
    RunConfig,
    StylizeConfig,
    TrackConfig,
    TrackOn,
    override,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def create(
    clip: Path,
    /,
    out: Path | None = None,
    style: str = "toon",
    quality: Quality = "standard",
    strength: float = 1.0,
    track_on: TrackOn = "auto",
    head: str = "open",
    choose_face: str = "largest",
    blendshapes: Blendshapes = "full",
    n_bases: int | None = None,
    max_frames: int | None = None,
    backend: str = "auto",
    threads: int | None = None,
    settings: tuple[str, ...] = (),
    quiet: bool = False,
) -> None:
    """Make an avatar from a clip: stylise, track, train, preview, report. The same line resumes a stopped run.

    Args:
        clip: Video file or folder of images with one person's head.
        out: Folder of the run; runs/<clip name>-<style> when unset.
        style: toon, paint, ink or none; arcane, cartoon, pixar, age or hair (assets get styleganex-...); or a file.
        quality: draft (minutes), standard, or paper (the published regime).
        strength: Blend between the original (0) and the full style (1).
        track_on: Video whose landmarks the head model is fitted to.
        head: Head model: open, or flame or flame2023 once you have added it (toonifygb assets add flame).
        choose_face: Which face to follow: largest, left, right, centre, or a number counted from the left.
        blendshapes: full, or reduced: a few learned bases for all expressions, for smaller avatars.
        n_bases: Learned bases of reduced blendshapes, 20 when unset; of full ones, expression units kept.
        max_frames: Use only the first frames.
        backend: Rasteriser: auto, cuda, gsplat, native or reference.
        threads: Threads of the native engine; all cores when unset.
        settings: Any other setting by name, for instance train.steps=500.
        quiet: Say nothing but errors.
    """
    run_config = RunConfig(
        head=head,
        quality=quality,
        stylize=StylizeConfig(style=style, strength=strength),
        face=FaceConfig(choose=choose_face),
        track=TrackConfig(on=track_on),
        train=dataclasses.replace(PRESETS[quality], blendshapes=blendshapes, n_bases=n_bases),
        max_frames=max_frames,
        backend=backend,
        threads=threads,
    )
    _create(clip, out or Path("runs") / f"{clip.stem}-{Path(style).stem}", _with(run_config, settings), quiet)


def demo(
    out: Path = Path("runs/demo"), style: str = "toon", n_frames: int = 150, seed: int = 1, quiet: bool = False
) -> None:
    """Show the whole pipeline on a synthetic talking head, made on the fly: no camera, no downloads.

    Args:
        out: Folder of the run.
        style: toon, paint, ink or none; arcane, cartoon, pixar, age or hair (assets get styleganex-...); or a file.
        n_frames: Length of the synthetic clip.
        seed: Which synthetic person.
        quiet: Say nothing but errors.
    """
    from toonifygb.pipeline.demo import demo as run_demo
    from toonifygb.pipeline.stages import Run

    terminal = _terminal(quiet)
    run_config = RunConfig(quality="draft", stylize=StylizeConfig(style=style), train=PRESETS["draft"])
    with Run(out, terminal) as run:
        run_demo(run, run_config, seed=seed, n_frames=n_frames)
    _done(out, terminal)


def stylize(
    clip: Path,
    /,
    out: Path,
    style: str = "toon",
    strength: float = 1.0,
    choose_face: str = "largest",
    max_frames: int | None = None,
    settings: tuple[str, ...] = (),
    quiet: bool = False,
) -> None:
    """Stage 1 alone: a clip in a style, with its size, pace and sound. The same line resumes a stopped one.

    Args:
        clip: Video file or folder of images.
        out: Video file to write (.mp4).
        style: toon, paint, ink or none; arcane, cartoon, pixar, age or hair (assets get styleganex-...); or a file.
        strength: Blend between the original (0) and the full style (1).
        choose_face: Which face to follow where several are visible.
        max_frames: Use only the first frames.
        settings: Any other setting by name, for instance styleganex.size=super.
        quiet: Say nothing but errors.
    """
    from toonifygb.pipeline.single import stylize_file

    run_config = RunConfig(
        stylize=StylizeConfig(style=style, strength=strength),
        face=FaceConfig(choose=choose_face),
        max_frames=max_frames,
    )
    stylize_file(clip, out, _with(run_config, settings), _terminal(quiet))


def track(
    clip: Path,
    /,
    out: Path,
    head: str = "open",
    choose_face: str = "largest",
    max_frames: int | None = None,
    settings: tuple[str, ...] = (),
    quiet: bool = False,
) -> None:
    """Fit the head model to a clip: track.safetensors and overlay.mp4.

    Args:
        clip: Video file or folder of images.
        out: Folder of the run.
        head: Head model: open, or flame or flame2023 once you have added it (toonifygb assets add flame).
        choose_face: Which face to follow where several are visible.
        max_frames: Use only the first frames.
        settings: Any other setting by name, for instance track.iterations=40.
        quiet: Say nothing but errors.
    """
    from toonifygb.pipeline.create import track_only
    from toonifygb.pipeline.source import open_source
    from toonifygb.pipeline.stages import Run

    run_config = RunConfig(
        head=head,
        stylize=StylizeConfig(style="none"),
        face=FaceConfig(choose=choose_face),
        max_frames=max_frames,
    )
    run_config = _with(run_config, settings)
    source = open_source(clip, run_config)
    with Run(out, _terminal(quiet)) as run:
        track_only(source, run, run_config)


def train(
    run: Path,
    /,
    quality: Quality | None = None,
    head: str | None = None,
    blendshapes: Blendshapes | None = None,
    n_bases: int | None = None,
    settings: tuple[str, ...] = (),
    quiet: bool = False,
) -> None:
    """Train the avatar of an existing run again, with other settings; earlier stages are kept.

    Args:
        run: Folder that ``create`` or ``import`` made.
        quality: Another quality; the run's own when unset.
        head: Another head model, with which the clip is tracked again; the run's own when unset.
        blendshapes: full, or reduced: a few learned bases for all expressions; the run's own when unset.
        n_bases: Their number; of full ones, expression units kept.
        settings: Any setting by name, for instance train.steps=20000.
        quiet: Say nothing but errors.
    """
    from toonifygb.pipeline.create import read_request

    clip, run_config = read_request(run)
    if quality:
        # What the crops show belongs to the clip rather than to the quality.
        preset = dataclasses.replace(PRESETS[quality], crop_scale=run_config.train.crop_scale)
        run_config = dataclasses.replace(run_config, quality=quality, train=preset)
    if head:
        run_config = dataclasses.replace(run_config, head=head)
    training = run_config.train
    if blendshapes:
        training = dataclasses.replace(training, blendshapes=blendshapes, n_bases=None)
    if n_bases is not None:
        training = dataclasses.replace(training, n_bases=n_bases)
    run_config = dataclasses.replace(run_config, train=training)
    _create(clip, run, _with(run_config, settings), quiet)


def render(
    avatar: Path,
    /,
    out: Path,
    motion: Path | None = None,
    expression: tuple[str, ...] = (),
    yaw: float = 0.0,
    pitch: float = 0.0,
    orbit: float = 0.0,
    size: int = 512,
    n_frames: int | None = None,
    background: str = "black",
    backend: str = "auto",
    threads: int | None = None,
    quiet: bool = False,
) -> None:
    """Render an avatar: a picture (.png) of one expression, or a video (.mp4) of a motion from any view.

    Args:
        avatar: Avatar folder, or a run that holds one.
        out: File to write: .png for one picture, .mp4 for a video.
        motion: Track whose motion is played (track.safetensors or a run); the avatar's own when unset.
        expression: Expression weights for a picture, for instance jawOpen=0.5 mouthSmileLeft=1.
        yaw: View angle to the side, degrees; positive shows the subject's left.
        pitch: View angle from above, degrees.
        orbit: Swing of the view to each side over a video, degrees.
        size: Side of the square picture, px.
        n_frames: Length of the video; the whole motion when unset.
        background: black, white, or a colour as #rrggbb.
        backend: Rasteriser: auto, cuda, gsplat, native or reference.
        threads: Threads of the native engine.
        quiet: Say nothing but errors.
    """
    from toonifygb.pipeline.single import RenderRequest, render_file

    request = RenderRequest(
        avatar=avatar,
        out=out,
        motion=motion,
        expression=expression,
        yaw_deg=yaw,
        pitch_deg=pitch,
        orbit_deg=orbit,
        size=size,
        n_frames=n_frames,
        background=background,
        backend=backend,
        threads=threads,
    )
    render_file(request, _terminal(quiet))


def import_(
    folder: Path,
    /,
    out: Path,
    style: str = "none",
    quality: Quality = "standard",
    head: str | None = None,
    max_frames: int | None = None,
    settings: tuple[str, ...] = (),
    quiet: bool = False,
) -> None:
    """Take a dataset of INSTA, 3DGB, FlashAvatar, metrical-tracker or VHAP as it is; then: toonifygb train RUN.

    Args:
        folder: The dataset: pictures and what its tracker left (checkpoint/*.frame or flame_param.npz).
        out: Folder of the run.
        style: none, or a style that keeps the face's shape (arcane, cartoon, pixar, a model file).
        quality: draft (minutes), standard, or paper (the published regime).
        head: FLAME version of the track, flame or flame2023; what such datasets usually have when unset.
        max_frames: Use only the first frames.
        settings: Any other setting by name, for instance track.photometric=true to refine the head's poses.
        quiet: Say nothing but errors.
    """
    from toonifygb.pipeline.create import import_only
    from toonifygb.pipeline.source import open_source
    from toonifygb.pipeline.stages import Run

    run_config = RunConfig(
        head=head or "open",
        quality=quality,
        stylize=StylizeConfig(style=style),
        # Poses of these trackers were fitted to the pixels already, and pictures are crops of the head already.
        track=TrackConfig(photometric=False),
        train=dataclasses.replace(PRESETS[quality], crop_scale=WHOLE_PICTURE),
        max_frames=max_frames,
    )
    run_config = _with(run_config, settings)
    terminal = _terminal(quiet)
    source = open_source(folder, run_config)
    with Run(out, terminal) as run:
        import_only(source, run, run_config)
    terminal.say(f"done: look at {out / 'overlay.mp4'}, then: toonifygb train {out}")


def export(run: Path, /, out: Path, layout: Literal["insta", "3dgb"] = "insta", quiet: bool = False) -> None:
    """Write a run's track and head crops as a dataset for INSTA or 3D Gaussian Blendshapes.

    Args:
        run: Folder that ``create``, ``train`` or ``import`` made, tracked with FLAME.
        out: New folder for the dataset.
        layout: insta (everything), or 3dgb (pictures and tracker files alone).
        quiet: Say nothing but errors.
    """
    from toonifygb.pipeline.imported import export_run

    export_run(run, out, layout, _terminal(quiet))


def doctor() -> None:
    """Say what this machine has, what toonifygb will use, and what is wrong, if anything."""
    from toonifygb.cli.doctor import report

    print(report())


COMMANDS: dict[str, Callable[..., Any]] = {
    "create": create,
    "demo": demo,
    "stylize": stylize,
    "track": track,
    "train": train,
    "render": render,
    "import": import_,
    "export": export,
    "assets": assets,
    "style": style,
    "doctor": doctor,
}


def _with(run_config: RunConfig, assignments: tuple[str, ...]) -> RunConfig:
    for assignment in assignments:
        run_config = override(run_config, assignment)
    return run_config


def _terminal(quiet: bool) -> Terminal:
    terminal = Terminal(quiet)
    terminal.listen()
    return terminal


def _create(clip: Path, out: Path, run_config: RunConfig, quiet: bool) -> None:
    from toonifygb.pipeline.create import create as create_avatar
    from toonifygb.pipeline.source import open_source
    from toonifygb.pipeline.stages import Run

    terminal = _terminal(quiet)
    source = open_source(clip, run_config)
    with Run(out, terminal) as run:
        create_avatar(source, run, run_config)
    _done(out, terminal)


def _done(out: Path, terminal: Terminal) -> None:
    terminal.say(f"done: open {out / 'report.html'}")
