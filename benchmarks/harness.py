"""What a benchmark hands back, and how times are taken.

On a shared machine wall time says little, so times are processor time on one thread unless a figure says otherwise:
the median over repetitions, with as many as fit into a time budget.
"""

from __future__ import annotations

import json
import platform
import statistics
import subprocess
import time
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"


@dataclass(frozen=True)
class Figure:
    """One measured number and what to hold it against."""

    claim: str
    """What is measured, in words that make sense in a table."""
    figure: float
    unit: str
    baseline: float | None = None
    """The same job done the plain way (torch reference), same unit."""
    floor: float | None = None
    """The least this machine could need by its measured arithmetic rate or memory bandwidth, same unit."""

    @property
    def ratio(self) -> float | None:
        """How many times better than the baseline; for rates (``/s``) more is better."""
        if self.baseline is None:
            return None
        quotient = self.baseline / self.figure
        return 1 / quotient if self.unit.endswith("/s") else quotient


def cpu_seconds(job: Callable[[], object], *, budget: float = 3.0, repeats: int = 25) -> float:
    """Median processor time of ``job``, s: one warm-up, then at most ``repeats`` runs or ``budget`` s of them."""
    return _median(job, time.process_time, budget, repeats)


def wall_seconds(job: Callable[[], object], *, budget: float = 3.0, repeats: int = 25) -> float:
    """Median wall time of ``job``, s."""
    return _median(job, time.perf_counter, budget, repeats)


def _median(job: Callable[[], object], clock: Callable[[], float], budget: float, repeats: int) -> float:
    job()
    times: list[float] = []
    while len(times) < repeats and (len(times) < 3 or sum(times) < budget):
        start = clock()
        job()
        times.append(clock() - start)
    return statistics.median(times)


@cache
def machine() -> str:
    """Processor and number of cores."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        name = f"{len(models)} x {models[0]}" if models else name
    return f"{name}, {platform.system()}"


@cache
def commit() -> str:
    """Short name of the commit measured, with ``+`` when files differ from it."""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def record(name: str, figures: list[Figure], folder: Path = RESULTS, **facts: str) -> None:
    """Appends one JSON line per figure to ``NAME.jsonl``; ``facts`` replace this machine's name and commit."""
    folder.mkdir(parents=True, exist_ok=True)
    facts = facts or {"machine": machine(), "commit": commit()}
    with (folder / f"{name}.jsonl").open("a", encoding="utf-8") as lines:
        for figure in figures:
            row = {**asdict(figure), "ratio": figure.ratio, **facts}
            lines.write(json.dumps(row) + "\n")


def show(name: str, figures: list[Figure], **facts: str) -> None:
    """Prints the figures as a small table; ``facts`` as in ``record``."""

    def cell(value: float | None) -> str:
        return "" if value is None else f"{value:.3g}"

    width = max(len(figure.claim) for figure in figures)
    facts = facts or {"machine": machine(), "commit": commit()}
    print(f"\n{name} — {facts['machine']}, commit {facts['commit']}")
    print(f"{'':{width}}  {'figure':>10} {'unit':<8} {'baseline':>9} {'ratio':>7} {'floor':>7}")
    for figure in figures:
        numbers = f"{cell(figure.figure):>10} {figure.unit:<8} {cell(figure.baseline):>9}"
        print(f"{figure.claim:{width}}  {numbers} {cell(figure.ratio):>7} {cell(figure.floor):>7}")
