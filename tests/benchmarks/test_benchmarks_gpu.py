"""The GPU benchmark: rehearsed whole on a processor, so that the one call on a GPU is not spent on a slip."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parent.parent.parent
KEYS = {"claim", "figure", "unit", "baseline", "ratio", "floor", "machine", "commit"}


def benchmark(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.gpu", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900, check=False)


def rehearse(folder: Path, *parts: str) -> list[dict]:
    """Figures of a rehearsal."""
    done = benchmark("--device", "cpu", "--small", "--out", str(folder), "--commit", "abc", *parts)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [json.loads(line) for line in (folder / "gpu.jsonl").read_text().splitlines()]
    assert all(set(row) == KEYS and row["commit"] == "abc" for row in rows)
    return rows


def test_kernels_and_training(tmp_path: Path) -> None:
    rows = {row["claim"]: row["figure"] for row in rehearse(tmp_path, "kernels", "training")}
    errors = [figure for claim, figure in rows.items() if "error" in claim]
    assert len(errors) > 8 and max(errors) < 1e-4
    assert sum("training steps" in claim for claim in rows) == 2


@pytest.mark.slow
def test_everything(tmp_path: Path) -> None:
    claims = " ".join(row["claim"] for row in rehearse(tmp_path))
    said = ("contract tests passed", "blend", "animate + render", "training steps", "PSNR, held out", "bfloat16")
    for claim in said:
        assert claim in claims


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_no_gpu_is_one_sentence() -> None:
    done = benchmark("--device", "cuda")
    assert done.returncode == 2
    assert done.stderr.strip() == "PyTorch sees no CUDA device; rehearse with --device cpu --small"


def test_unknown_parts_are_named() -> None:
    done = benchmark("cooking")
    assert done.returncode == 2 and "no part cooking; there are: contract, kernels" in done.stderr
