"""``python -m benchmarks.gpu``: everything a GPU is asked for, in one call of at most nine minutes.

Needs torch and Triton; what needs more and misses it is skipped with a sentence. ``--device cpu --small`` rehearses
all of it on a processor. Figures are printed and appended to ``benchmarks/results/gpu.jsonl`` part by part, so that
a call cut short leaves what it has measured.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
import traceback
from pathlib import Path

import torch

from benchmarks import harness
from benchmarks.gpu.machine import Bench

PARTS = ("contract", "kernels", "playback", "training", "subject", "styleganex")
BUDGET = 540.0


def main(arguments: list[str]) -> int:
    """Runs the parts asked for; 1 when one of them failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all when none is named")
    parser.add_argument("--device", default="auto", choices=["auto", "cuda", "cpu"])
    parser.add_argument("--backend", default=None, help="of the renderer; cuda on a GPU, reference on a processor")
    parser.add_argument("--small", action="store_true", help="a rehearsal: sizes that a processor manages")
    parser.add_argument("--seconds", type=float, default=BUDGET, help="nothing long is started after this time")
    parser.add_argument("--out", type=Path, default=harness.RESULTS, help="folder of gpu.jsonl")
    parser.add_argument("--commit", default=None, help="what is measured, where git is not to be had")
    options = parser.parse_args(arguments)
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}; there are: {', '.join(PARTS)}")
    device = options.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cuda" and not torch.cuda.is_available():
        print("PyTorch sees no CUDA device; rehearse with --device cpu --small", file=sys.stderr)
        return 2
    backend = options.backend or ("cuda" if device == "cuda" else "reference")
    bench = Bench(torch.device(device), backend, options.small, time.monotonic() + options.seconds)
    print(f"{bench.name}, backend {backend}")
    wrong = [name for name in options.parts or PARTS if not _run(name, bench, options)]
    if wrong:
        print(f"\nfailed: {', '.join(wrong)}", file=sys.stderr)
    return 1 if wrong else 0


def _run(name: str, bench: Bench, options: argparse.Namespace) -> bool:
    """One part; what goes wrong in it does not cost the others their turn."""
    if bench.left <= 0:
        print(f"{name}: skipped, the time is used up")
        return True
    start = time.monotonic()
    try:
        figures = importlib.import_module(f"benchmarks.gpu.{name}").run(bench)
    except ImportError as error:
        print(f"{name}: skipped, because {error}")
        return True
    except Exception:
        traceback.print_exc()
        return False
    facts = {"machine": bench.name, "commit": options.commit or harness.commit()}
    harness.show(f"gpu {name}, {time.monotonic() - start:.0f} s", figures, **facts)
    harness.record("gpu", figures, options.out, **facts)
    return True


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
