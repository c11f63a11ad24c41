"""A run on disk: its folder, its stages and their fingerprints.

A stage is a function with declared inputs and output files. Its fingerprint hashes the stage's name, its version,
the settings it reads and the fingerprints of the stages it builds on; when the recorded fingerprint equals the
current one and every output exists, the stage is skipped. Outputs are written atomically and the record last, so a
process killed at any moment leaves either the finished stage or nothing of it (training keeps checkpoints of its
own in the run's ``work`` folder).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
import resource
import shutil
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from toonifygb import __version__
from toonifygb.atomic import replacing
from toonifygb.errors import InputError, ToonifyError

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from toonifygb.progress import Progress

log = logging.getLogger(__name__)

STATE_FILE = "run.json"
_LOCK_FILE = ".lock"


class Reporter(Protocol):
    """The person watching a run."""

    def stage(self, name: str, title: str) -> Progress:
        """Announces that work on a stage begins; returns the receiver of its progress."""
        ...

    def cached(self, name: str, title: str) -> None:
        """Says that a stage was finished earlier and is taken as it is."""
        ...

    def finished(self, title: str, seconds: float) -> None:
        """Says that a stage is done."""
        ...

    def note(self, sentence: str) -> None:
        """Says one thing worth knowing."""
        ...


def write_json(path: Path, value: Any) -> None:
    """Writes JSON so that the file is at no moment half there."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, sort_keys=True) + "\n")


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def fingerprint(*parts: Any) -> str:
    """Hash of settings: dataclasses, strings, numbers, lists and dicts of them."""

    def plain(value: Any) -> Any:
        return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else str(value)  # type: ignore[arg-type]

    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=plain).encode()).hexdigest()


@dataclass
class Run:
    """One run's folder, held by one process at a time.

    Use as a context manager: entering makes the folder and takes its lock.

    Raises:
        InputError: the folder cannot be written, holds something else, or is in use by another process.
    """

    path: Path
    reporter: Reporter
    state: dict[str, Any] = field(default_factory=dict)
    _lock: int | None = None
    _is_new: bool = False

    def __enter__(self) -> Run:
        self._make_folder()
        self._take_lock()
        state_path = self.path / STATE_FILE
        if state_path.exists():
            try:
                self.state = json.loads(state_path.read_text())
            except ValueError as error:
                raise InputError(f"{state_path} is not valid JSON", "delete it to start this run afresh") from error
        self.state.setdefault("stages", {})
        self.state.setdefault("problems", {})
        self.state["version"] = __version__
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        finished = any(entry.get("finished") for entry in self.state.get("stages", {}).values())
        if isinstance(error, ToonifyError) and self._is_new and not finished:
            shutil.rmtree(self.path, ignore_errors=True)  # a request that failed at once leaves nothing behind

    def _make_folder(self) -> None:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            probe = self.path / ".writable"
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise InputError(
                f"output folder {self.path} cannot be written ({error.strerror})",
                "pass a folder you may write to with --out",
            ) from error
        others = [p.name for p in self.path.iterdir() if p.name != _LOCK_FILE]
        if others and not (self.path / STATE_FILE).exists():
            raise InputError(
                f"output folder {self.path} holds other files ({others[0]}) and is not a run of toonifygb",
                "pass a new or empty folder with --out",
            )
        (self.path / "work").mkdir(exist_ok=True)
        self._is_new = not (self.path / STATE_FILE).exists()
        if self._is_new:
            write_json(self.path / STATE_FILE, {"stages": {}, "problems": {}, "version": __version__})

    def _take_lock(self) -> None:
        if sys.platform == "win32":
            return
        import fcntl

        self._lock = os.open(self.path / _LOCK_FILE, os.O_CREAT | os.O_RDWR)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            self._lock = None
            raise InputError(
                f"another process is working in {self.path}", "wait for it to end, or pass another --out"
            ) from error

    def file(self, name: str) -> Path:
        """Path of an output of this run."""
        return self.path / name

    def work(self, name: str) -> Path:
        """Path of an intermediate of this run."""
        return self.path / "work" / name

    def save(self) -> None:
        """Writes the state to disk."""
        write_json(self.path / STATE_FILE, self.state)

    def problems(self, stage: str, sentences: list[str]) -> None:
        """Records what a user should know about the clip, one sentence each, replacing the stage's earlier ones."""
        known = self.state["problems"].get(stage, [])
        self.state["problems"][stage] = sentences
        for sentence in sentences:
            if sentence not in known:
                self.reporter.note(sentence)

    def seconds(self) -> dict[str, float]:
        """Wall seconds of each finished stage."""
        return {name: round(entry["seconds"], 2) for name, entry in self.state["stages"].items()}

    def stage(
        self,
        name: str,
        title: str,
        *,
        inputs: list[Any],
        outputs: list[Path],
        work: Callable[[Progress], None],
    ) -> str:
        """Does a stage unless it was done before with the same inputs.

        Args:
            name: key of the stage in ``run.json``.
            title: what it does, for people.
            inputs: settings and earlier fingerprints it depends on.
            outputs: files or folders that exist when it is finished.
            work: the work; receives the progress to update.

        Returns:
            The stage's fingerprint, an input of the stages after it.
        """
        print_ = fingerprint(name, __version__, *inputs)
        entry = self.state["stages"].get(name, {})
        same = entry.get("fingerprint") == print_
        if same and entry.get("finished") and all(path.exists() for path in outputs):
            self.reporter.cached(name, title)
            return print_
        spent = entry.get("seconds", 0.0) if same and not entry.get("finished") else 0.0
        start = time.monotonic()

        def record(finished: bool) -> None:
            self.state["stages"][name] = {
                "fingerprint": print_,
                "finished": finished,
                "seconds": spent + time.monotonic() - start,
                "peak_memory_mb": round(peak_memory_mb(), 1),
            }
            self.save()

        progress = self.reporter.stage(name, title)
        try:
            work(progress)
        except BaseException:
            # Time already spent is kept so that the report adds up over interruptions; the record itself must not
            # hide the reason for stopping, for instance when the disk is full.
            try:
                record(False)
            except OSError as error:
                log.warning("could not record the interrupted stage: %s", error)
            raise
        record(True)
        self.reporter.finished(title, self.state["stages"][name]["seconds"])
        return print_
