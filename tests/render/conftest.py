"""Every renderer and every set of kernels runs the same tests."""

from __future__ import annotations

import pytest

from toonifygb import render
from toonifygb.render import library

BACKENDS = ("reference", "native")


def _require(backend: str) -> None:
    if backend == "native" and (reason := library.unavailable()):
        pytest.skip(f"native engine not available: {reason}")


@pytest.fixture(params=BACKENDS)
def renderer(request: pytest.FixtureRequest) -> render.Renderer:
    """Each renderer in turn."""
    _require(request.param)
    return render.get(request.param)


@pytest.fixture
def native() -> render.Renderer:
    """The native renderer, on one thread."""
    _require("native")
    return render.get("native", threads=1)


@pytest.fixture
def native_kernels() -> object:
    """The native training kernels, on one thread."""
    _require("native")
    return render.kernels("native", threads=1)
