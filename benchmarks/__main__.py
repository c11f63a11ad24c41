"""``python -m benchmarks``: all benchmarks but the longest; ``python -m benchmarks rasterizer``: one of them."""

from __future__ import annotations

import importlib
import pkgutil
import sys

import benchmarks
from benchmarks import harness

SUPPORT = {"__main__", "harness", "scenes", "limits", "gpu"}
ON_REQUEST = {"avatar_size", "memory", "styleganex", "styleganex_clip", "styleganex_steady", "styleganex_tried"}
"""Run only when named: a part of another one, or long work about one room."""


def main(arguments: list[str]) -> int:
    """Runs the named benchmarks, or all; prints their tables and appends their figures to the history."""
    available = sorted({module.name for module in pkgutil.iter_modules(benchmarks.__path__)} - SUPPORT)
    unknown = [name for name in arguments if name not in available]
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; there are: {', '.join(available)}", file=sys.stderr)
        return 2
    for name in arguments or sorted(set(available) - ON_REQUEST):
        figures = importlib.import_module(f"benchmarks.{name}").run()
        harness.show(name, figures)
        harness.record(name, figures)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
