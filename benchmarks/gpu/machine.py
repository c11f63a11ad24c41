"""The device measured: its name, its clock, its bandwidth and arithmetic rates, and a native engine beside it."""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import time
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import torch

from benchmarks import harness

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Bench:
    """Where and how large everything is measured."""

    device: torch.device
    backend: str
    """Of ``toonifygb.render``."""
    small: bool
    """Sizes at which all of it runs on a processor in minutes: a rehearsal, not a measurement."""
    deadline: float
    """``time.monotonic()`` after which nothing long is started."""

    @property
    def left(self) -> float:
        """Seconds until the deadline."""
        return self.deadline - time.monotonic()

    def pick(self, full: int, small: int) -> int:
        """A size."""
        return small if self.small else full

    def seconds(self, job: Callable[[], object], repeats: int = 30, rounds: int = 3) -> float:
        """Seconds of one ``job``: the median of rounds of ``repeats`` jobs with one wait at the end of a round."""
        repeats = 2 if self.small else repeats
        for _ in range(2 if self.small else 10):
            job()
        times = []
        for _ in range(rounds):
            self.wait()
            start = time.perf_counter()
            for _ in range(repeats):
                job()
            self.wait()
            times.append((time.perf_counter() - start) / repeats)
        return statistics.median(times)

    def wait(self) -> None:
        """Until the device has done everything asked of it."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    @property
    def name(self) -> str:
        """Device and libraries, for the record."""
        if self.device.type != "cuda":
            return f"{harness.machine()}, torch {torch.__version__}"
        return f"{torch.cuda.get_device_name(self.device)}, torch {torch.__version__}, CUDA {torch.version.cuda}"


@cache
def bandwidth(bench: Bench) -> float:
    """Bytes per second read and written by a copy far larger than the caches."""
    x = torch.empty(bench.pick(1 << 28, 1 << 22), device=bench.device)
    y = torch.empty_like(x)
    return 8 * x.numel() / bench.seconds(lambda: y.copy_(x), repeats=10)


@cache
def matmul_rate(bench: Bench, precision: str) -> float:
    """Multiply-adds per second of a large matrix product in ``float32``, ``tf32`` or ``bfloat16``."""
    n = bench.pick(8192, 256)
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    a, b = (torch.randn(n, n, device=bench.device).to(dtype) for _ in range(2))
    torch.backends.cuda.matmul.allow_tf32 = precision == "tf32"
    try:
        return n**3 / bench.seconds(lambda: a @ b, repeats=5)
    finally:
        torch.backends.cuda.matmul.allow_tf32 = False


def build_native() -> str | None:
    """Builds the native engine where it is missing, to draw synthetic frames; why it could not, else ``None``."""
    from toonifygb.render import library

    if library.unavailable() is None:
        return None
    if not shutil.which("cmake"):
        return f"{library.unavailable()}, and there is no cmake"
    folder = harness.ROOT / "build" / "native-gpu"
    for command in (["cmake", "-S", "native", "-B", str(folder)], ["cmake", "--build", str(folder), "--parallel"]):
        done = subprocess.run(command, cwd=harness.ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            return f"{' '.join(command[:3])} failed: {done.stderr.strip().splitlines()[-1:]}"
    found = sorted(folder.glob("**/toonifygb_native.so"))
    if not found:
        return f"the build left no library in {folder}"
    os.environ[library.PATH_VARIABLE] = str(found[0])
    library._load.cache_clear()
    return library.unavailable()
