"""Markers, seeds and the places of reference data."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def _folder(variable: str, default: str) -> Path:
    return Path(os.environ.get(variable, str(ROOT / default)))


@pytest.fixture(scope="session")
def golden_dir() -> Path:
    """Reference arrays; tests that need them are skipped where the folder is absent."""
    path = _folder("TOONIFYGB_GOLDEN", "../shared/golden")
    if not path.is_dir():
        pytest.skip(f"reference arrays not found at {path}; set TOONIFYGB_GOLDEN to their folder")
    return path


@pytest.fixture(scope="session")
def videos_dir() -> Path:
    """Real clips; tests that need them are skipped where the folder is absent."""
    path = _folder("TOONIFYGB_VIDEOS", "../shared/data/videos")
    if not path.is_dir():
        pytest.skip(f"clips not found at {path}; set TOONIFYGB_VIDEOS to their folder")
    return path


@pytest.fixture(autouse=True)
def _seeded() -> None:
    import torch

    torch.manual_seed(0)
    # Small kernels on a busy machine wait for each other: with one thread the suites are many times faster.
    torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """GPU tests are skipped where there is no GPU; they are the only ones."""
    import torch

    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))
