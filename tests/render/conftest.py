"""Every renderer and every set of kernels runs the same tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from toonifygb import render
from toonifygb.render import cuda, library

if TYPE_CHECKING:
    from toonifygb.render.fused import Kernels

BACKENDS = ("reference", "native", *(() if cuda.unavailable() else ("cuda",)))
"""CUDA joins where it can run; ``test_render_cuda.py`` says why where it cannot."""


def _require(backend: str) -> None:
    if backend == "native" and (reason := library.unavailable()):
        pytest.skip(f"native engine not available: {reason}")
    if backend == "cuda" and (reason := cuda.unavailable()):
        pytest.skip(f"CUDA renderer not available: {reason}")


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


@pytest.fixture
def cuda_kernels() -> Kernels:
    """The training kernels on the CUDA device, or in Triton's interpreter."""
    _require("cuda")
    return render.kernels("cuda")
