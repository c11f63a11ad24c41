"""The contract suite of the renderers, and the checks of the CUDA kernels, on this device."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import TYPE_CHECKING

from benchmarks.harness import ROOT, Figure

if TYPE_CHECKING:
    from benchmarks.gpu.machine import Bench

SUITE = ("tests/render/test_render_contract.py", "tests/render/test_render_cuda.py")


def run(bench: Bench) -> list[Figure]:
    """How many tests pass and fail; the names of those that fail are printed."""
    chosen = "reference and every_degree" if bench.small else bench.backend
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider", "-k", chosen, *SUITE]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=max(60, bench.left)
    )
    counts = {what: int(n) for n, what in re.findall(r"(\d+) (passed|failed|error|skipped)", done.stdout)}
    if done.returncode:
        print(done.stdout[-6000:], done.stderr[-2000:], sep="\n")
    if not counts.get("passed"):
        raise RuntimeError(f"pytest ran no test that passed (exit code {done.returncode})")
    wrong = counts.get("failed", 0) + counts.get("error", 0)
    return [
        Figure("contract tests passed", counts["passed"], "1"),
        Figure("contract tests failed", wrong, "1", floor=0),
    ]
