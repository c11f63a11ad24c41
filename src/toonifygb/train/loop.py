"""The training loop: steps, checkpoints, a log, and the avatar at the end.

Everything random comes from one generator that is saved with the checkpoint, and the kernels give the same bits for
any number of threads; so a training that is stopped, killed or moved goes on as if it had never paused.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from toonifygb import __version__, render
from toonifygb.atomic import replacing
from toonifygb.avatar import init_avatar
from toonifygb.progress import SILENT, Stopped
from toonifygb.render import RenderInfo
from toonifygb.threads import one_torch_thread
from toonifygb.train.densify import Densifier
from toonifygb.train.state import TrainState, read_checkpoint, write_checkpoint
from toonifygb.train.step import Stepper
from toonifygb.train.views import TrainingViews

if TYPE_CHECKING:
    from toonifygb.avatar import Avatar
    from toonifygb.config import TrainConfig
    from toonifygb.head import HeadModel
    from toonifygb.progress import Progress
    from toonifygb.structures import TrackedSequence
    from toonifygb.train.data import Dataset
    from toonifygb.train.losses import LossTerms

log = logging.getLogger(__name__)

CHECKPOINT, METRICS = "checkpoint.safetensors", "metrics.jsonl"
_LOG_EVERY = 50
"""Steps per line of ``metrics.jsonl``."""


def train(
    dataset: Dataset,
    sequence: TrackedSequence,
    head: HeadModel,
    config: TrainConfig,
    out_dir: Path | str,
    *,
    backend: str = "auto",
    threads: int | None = None,
    progress: Progress = SILENT,
) -> Avatar:
    """Trains an avatar, going on from the checkpoint in ``out_dir`` where one belongs to the same training.

    Args:
        dataset: crops and mattes; only the frames of ``split.train`` are looked at.
        sequence: the track they belong to.
        head: the head model of the track.
        config: numbers of Gaussians and steps, weights, seed.
        out_dir: gets ``checkpoint.safetensors`` and ``metrics.jsonl``.
        backend: see ``render.get``; the whole training lives on the device of ``cuda``.
        threads: threads of the native engine.
        progress: told after every step; figures ``loss`` and ``steps_per_s``.

    Raises:
        Stopped: the user asked to stop; the checkpoint holds every step taken.
    """
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    with one_torch_thread():
        template = first_avatar(dataset, sequence, head, config)
        facts = {"fingerprint": fingerprint(config, dataset, sequence)}
        renderer, kernels = render.get(backend, threads), render.kernels(backend, threads)
        state = (_resumed(folder, facts) or TrainState.start(template, config.seed)).to(kernels.device)
        stepper = Stepper(state, template, dataset, sequence, config, renderer, kernels)
        _run(stepper, folder, config, facts, progress)
        return _with_facts(state.to(torch.device("cpu")).avatar(template), sequence, dataset, config)


def first_avatar(dataset: Dataset, sequence: TrackedSequence, head: HeadModel, config: TrainConfig) -> Avatar:
    """The untrained avatar, coloured from the training frames."""
    frames = torch.tensor(dataset.split.train)
    return init_avatar(
        head,
        sequence.shape,
        config,
        motion=sequence.motion[frames],
        camera=dataset.camera(dataset.split.train[0]),
        full_camera=dataset.full_camera,
        views=TrainingViews(dataset, sequence, head),
    )


def _run(stepper: Stepper, folder: Path, config: TrainConfig, facts: dict[str, str], progress: Progress) -> None:
    """All remaining steps; ``facts`` go into every checkpoint."""
    state = stepper.state
    densifier = Densifier(stepper.first_counts, config.steps) if config.densify else None
    journal, saved = _Journal(folder / METRICS, state.step), time.monotonic()
    try:
        while state.step < config.steps:
            terms = _step(stepper, densifier)
            figures = journal.note(state.step, terms, stepper)
            if time.monotonic() - saved > config.checkpoint_seconds:
                write_checkpoint(state, folder / CHECKPOINT, facts)
                saved = time.monotonic()
            progress.update(state.step, config.steps, **figures)
    except Stopped:
        write_checkpoint(state, folder / CHECKPOINT, facts)
        raise
    write_checkpoint(state, folder / CHECKPOINT, facts)


def _step(stepper: Stepper, densifier: Densifier | None) -> LossTerms:
    """One step, and a new generation of Gaussians after it when one is due."""
    if densifier is None or not densifier.wanted(stepper.state.step + 1):
        return stepper.step()
    info = RenderInfo()
    terms = stepper.step(info)
    densifier.observe(stepper.state, info)
    if densifier.due(stepper.state.step):
        stepper.finish()
        densifier.apply(stepper.state)
        stepper.rebind()
    return terms


class _Journal:
    """``metrics.jsonl``: one line per ``_LOG_EVERY`` steps; lines after the resumed step are dropped."""

    def __init__(self, path: Path, step: int) -> None:
        self._path = path
        self._since, self._first, self._losses = time.monotonic(), step, []
        kept = []
        if path.is_file():
            lines = path.read_text(encoding="utf-8").splitlines()
            kept = [line for line in lines if _step_of(line) <= step]
        with replacing(path) as temporary:
            temporary.write_text("".join(line + "\n" for line in kept), encoding="utf-8")

    def note(self, step: int, terms: LossTerms, stepper: Stepper) -> dict[str, float]:
        """Remembers a step, writes a line when one is due, and gives the figures worth showing."""
        self._losses.append(terms.total)
        pace = (step - self._first) / max(time.monotonic() - self._since, 1e-9)
        recent = self._losses[-_LOG_EVERY:]
        loss = sum(recent) / len(recent)
        if step % _LOG_EVERY == 0:
            line = {
                "step": step,
                "loss": round(loss, 6),
                "photo": round(terms.photo, 6),
                "alpha": round(terms.alpha, 6),
                "mouth": round(terms.mouth, 6),
                "sh_degree": stepper.sh_degree,
                "n_gaussians": stepper.state.counts.all,
                "steps_per_s": round(pace, 2),
            }
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            self._losses = recent
        return {"loss": loss, "steps_per_s": pace}


def _step_of(line: str) -> float:
    """Step of a log line; a line cut short by a crash counts as never taken."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return float("inf")


def _resumed(folder: Path, wanted: dict[str, str]) -> TrainState | None:
    path = folder / CHECKPOINT
    if not path.is_file():
        return None
    state, facts, _ = read_checkpoint(path)
    if facts.get("fingerprint") != wanted["fingerprint"]:
        log.info("checkpoint %s belongs to another training; starting anew", path)
        return None
    log.info("going on from step %d", state.step)
    return state


def fingerprint(config: TrainConfig, dataset: Dataset, sequence: TrackedSequence) -> str:
    """What a training depends on; a checkpoint of another one is not continued."""
    settings = dataclasses.asdict(replace(config, checkpoint_seconds=0.0))
    digest = hashlib.sha256(f"{json.dumps(settings, sort_keys=True)}\n{dataset.fingerprint}".encode())
    motion = sequence.motion
    for tensor in (sequence.shape, motion.expression, motion.joints, motion.translation, motion.eyelids):
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def _with_facts(avatar: Avatar, sequence: TrackedSequence, dataset: Dataset, config: TrainConfig) -> Avatar:
    facts = {
        "toonifygb": __version__,
        "config": dataclasses.asdict(config),
        "n_train": len(dataset.split.train),
        "fps": sequence.fps,
        "source_sha256": sequence.source_sha256,
    }
    return replace(avatar, meta=avatar.meta | facts)
