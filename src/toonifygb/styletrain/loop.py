"""A whole training: pictures, generator, encoder, style file; interrupted anywhere, it goes on.

    STYLE.safetensors                       what ``toonifygb stylize --style`` takes
    STYLE.training/pictures.safetensors     the aligned pictures
    STYLE.training/generator.safetensors    first stage: everything a step depends on
    STYLE.training/encoder.safetensors      second stage, likewise
    STYLE.training/previews/*.png, *.json   what has been learnt after so many steps, and the losses

All that is random in a step follows from the seed, the stage and the step's number, so no random state need be kept
and a resumed training equals an uninterrupted one bit for bit (on the CPU; GPU kernels may add in another order).
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch

from toonifygb.atomic import replacing
from toonifygb.errors import BackendError, InputError
from toonifygb.progress import Stopped
from toonifygb.styletrain import preview
from toonifygb.styletrain.discriminator import Discriminator
from toonifygb.styletrain.encode import Encode
from toonifygb.styletrain.foundation import LEVELS, SIZES, Foundation, open_foundation, student, swapped
from toonifygb.styletrain.perceptual import FeatureDistance, Lpips
from toonifygb.styletrain.pictures import check_folder, read_pictures
from toonifygb.styletrain.state import read_checkpoint, write_checkpoint
from toonifygb.styletrain.transfer import Transfer
from toonifygb.stylize.styleganex import weights
from toonifygb.video import save_png

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from toonifygb.config import StyleTrainConfig
    from toonifygb.progress import Progress
    from toonifygb.styletrain.pictures import Pictures
    from toonifygb.styletrain.state import Tensors
    from toonifygb.stylize.styleganex.generator import Generator

SUFFIX = ".safetensors"
_RECENT = 50
"""Steps over which the losses that are shown are averaged, about."""
_COUNTS = ("generator_steps", "generator_batch", "ada_images", "ema_images", "encoder_steps", "encoder_batch")
_COUNTS += ("preview_steps",)
"""Settings that count something."""
_HARMLESS = ("checkpoint_seconds", "preview_steps", "device")
"""Settings that change nothing of what is learnt."""


class Reporter(Protocol):
    """The person watching."""

    def stage(self, name: str, title: str) -> Progress:
        """Announces that work begins; returns the receiver of its progress."""
        ...

    def note(self, sentence: str) -> None:
        """Says one thing worth knowing."""
        ...


class Stage(Protocol):
    """What ``transfer.Transfer`` and ``encode.Encode`` have in common."""

    def step(self, step: int) -> dict[str, float]:
        """One step; figures worth showing."""
        ...

    def tensors(self) -> Tensors:
        """Everything a step depends on, beside the notes."""
        ...

    def notes(self) -> dict[str, Any]:
        """What of it is no tensor."""
        ...

    def restore(self, tensors: Tensors, notes: dict[str, Any]) -> None:
        """Goes on from there."""
        ...


@dataclass(frozen=True)
class _Plan:
    """How a stage is run."""

    name: str
    title: str
    n_steps: int
    draw_preview: Callable[[], torch.Tensor]


def train_style(images: Path, base: str, out: Path, config: StyleTrainConfig, reporter: Reporter) -> None:
    """Learns the style of a folder of pictures and writes it to ``out``; goes on where an earlier call stopped.

    Args:
        images: folder of JPEG and PNG files.
        base: see ``foundation.open_foundation``.
        out: the style file (``.safetensors``); ``<out>.training`` beside it holds what is needed to go on.
        config: settings.
        reporter: hears of progress, and of pictures that are left out.

    Raises:
        InputError: the pictures, the base, the settings or the output cannot be used.
        AssetError: the base or the LPIPS weights are damaged or of another kind.
        Stopped: the user asked to stop; every step taken is on disk.
    """
    if out.suffix != SUFFIX:
        raise InputError(f"output {out} does not end in {SUFFIX}, as files of styles do")
    device = _checked(config)
    check_folder(images)
    perceptual = Lpips.read(config.lpips).to(device) if config.lpips else None
    folder = out.with_suffix(".training")
    foundation = open_foundation(base, folder)
    folder.mkdir(parents=True, exist_ok=True)
    reader = reporter.stage("pictures", "finding the faces")
    pictures = read_pictures(images, config, folder / "pictures.safetensors", device, reader)
    for sentence in pictures.problems:
        reporter.note(sentence)
    runner = _Runner(folder, config, _fingerprint(config, pictures, foundation), reporter)
    foundation.network.to(device)
    decoder, discriminator = _taught(foundation, pictures, config, runner)
    distance = perceptual or FeatureDistance(copy.deepcopy(discriminator))
    reporter.note(f"perceptual distance: {distance.description}")
    network = student(foundation.network, decoder, config.seed).to(device)
    stage = Encode(foundation.network, network, discriminator, distance, config)
    runner.run(
        stage,
        _Plan("encoder", "teaching the encoder", config.encoder_steps, lambda: preview.of_encode(stage)),
    )
    weights.save(network.cpu(), out, levels=LEVELS[config.resolution])


def _taught(
    foundation: Foundation, pictures: Pictures, config: StyleTrainConfig, runner: _Runner
) -> tuple[Generator, Discriminator]:
    """The first stage, run to its end: the generator of the style, layers swapped, and its discriminator."""
    base = foundation.network
    discriminator = _discriminator(foundation, config, runner.reporter).to(base.latent_avg.device)
    stage = Transfer(base, discriminator, pictures.images, config)
    runner.run(
        stage,
        _Plan("generator", "teaching the generator", config.generator_steps, lambda: preview.of_transfer(stage)),
    )
    return swapped(base.decoder, stage.average, config.swap, config.swap_size), discriminator


def _discriminator(foundation: Foundation, config: StyleTrainConfig, reporter: Reporter) -> Discriminator:
    """The base's discriminator where there is one of this resolution, else a new one; says which."""
    with torch.random.fork_rng():
        torch.manual_seed(config.seed)
        discriminator = Discriminator(config.resolution, foundation.network.variant.width)
    stored = foundation.discriminator
    shapes = {key: value.shape for key, value in discriminator.state_dict().items()}
    if stored is None:
        reporter.note("the base holds no discriminator; a new one is trained")
    elif {key: value.shape for key, value in stored.items()} != shapes:
        reporter.note(f"the base's discriminator is not one for {config.resolution} px; a new one is trained")
    else:
        reporter.note("the base's discriminator is trained on")
        discriminator.load_state_dict(stored)
    return discriminator


@dataclass(frozen=True)
class _Runner:
    """Runs stages with checkpoints and previews."""

    folder: Path
    config: StyleTrainConfig
    fingerprint: str
    reporter: Reporter

    def run(self, stage: Stage, plan: _Plan) -> None:
        """All steps of a stage that are missing."""
        path = self.folder / f"{plan.name}.safetensors"
        step = 0
        found = read_checkpoint(path, self.fingerprint)
        if found is not None:
            tensors, notes = found
            step = notes["step"]
            stage.restore(tensors, notes["stage"])
        if step >= plan.n_steps:
            return
        progress = self.reporter.stage(plan.name, plan.title)
        figures: dict[str, float] = {}
        seen: dict[str, int] = {}
        saved = time.monotonic()
        try:
            while step < plan.n_steps:
                for key, value in self._step(stage, plan, step).items():
                    seen[key] = seen.get(key, 0) + 1
                    figures[key] = figures.get(key, 0.0) + (value - figures.get(key, 0.0)) / min(seen[key], _RECENT)
                step += 1
                if step % self.config.preview_steps == 0 or step == plan.n_steps:
                    self._preview(plan, step, figures)
                if time.monotonic() - saved >= self.config.checkpoint_seconds:
                    self._save(stage, path, step)
                    saved = time.monotonic()
                progress.update(step, plan.n_steps, **figures)
        except Stopped:
            self._save(stage, path, step)
            raise
        self._save(stage, path, step)

    def _step(self, stage: Stage, plan: _Plan, step: int) -> dict[str, float]:
        """One step, with the random numbers that belong to it."""
        with torch.random.fork_rng():
            torch.manual_seed(_seed_of(self.config.seed, plan.name, step))
            try:
                figures = stage.step(step)
            except torch.cuda.OutOfMemoryError as error:
                raise BackendError(
                    f"the GPU's memory is too small for {plan.title} at {self.config.resolution} px",
                    f"lower --{plan.name}-batch or --resolution",
                ) from error
        if not all(map(math.isfinite, figures.values())):
            raise InputError(
                f"{plan.title} failed in step {step + 1}: the losses are no numbers any more",
                f"lower --{plan.name}-rate and begin anew with another --out",
            )
        return figures

    def _preview(self, plan: _Plan, step: int, figures: dict[str, float]) -> None:
        """Writes a picture of what has been learnt, and the losses beside it."""
        folder = self.folder / "previews"
        folder.mkdir(exist_ok=True)
        path = folder / f"{plan.name}-{step:06}.png"
        with torch.random.fork_rng():
            torch.manual_seed(0)
            save_png(path, plan.draw_preview().numpy())
        with replacing(path.with_suffix(".json")) as temporary:
            temporary.write_text(json.dumps({"step": step, **figures}, indent=1) + "\n", encoding="utf-8")

    def _save(self, stage: Stage, path: Path, step: int) -> None:
        notes = {"fingerprint": self.fingerprint, "step": step, "stage": stage.notes()}
        write_checkpoint(path, stage.tensors(), notes)


def _seed_of(seed: int, name: str, step: int) -> int:
    """Seed of a step, unlike that of any other step or stage."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name} {step}".encode()).digest()[:7], "little")


def _checked(config: StyleTrainConfig) -> str:
    """The device, after a look at the settings.

    Raises:
        InputError: a setting is out of its range.
        BackendError: there is no such device.
    """
    for name in _COUNTS:
        if getattr(config, name) < 1:
            raise InputError(f"setting {name} is {getattr(config, name)}; expected 1 or more")
    for name, choices in (("resolution", tuple(LEVELS)), ("swap_size", SIZES)):
        if getattr(config, name) not in choices:
            listed = ", ".join(map(str, choices))
            raise InputError(f"setting {name} is {getattr(config, name)}; expected one of {listed}")
    if config.device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return str(torch.zeros(0, device=config.device).device)
    except (RuntimeError, AssertionError) as error:
        raise BackendError(f"device '{config.device}' cannot be used here", "use cpu, cuda or auto") from error


def _fingerprint(config: StyleTrainConfig, pictures: Pictures, foundation: Foundation) -> str:
    """What a training depends on; a checkpoint of another one is not continued."""
    settings = {key: str(value) for key, value in dataclasses.asdict(config).items() if key not in _HARMLESS}
    text = json.dumps([settings, pictures.fingerprint, foundation.sha256], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
