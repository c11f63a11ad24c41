"""What only the native engine promises: the same bits for every thread count, the same image for every
instruction set, and one clear sentence where it is missing."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

import pytest
import torch
from render_scenes import camera, gradients, relative_errors, splats, variables

from toonifygb import render
from toonifygb.errors import BackendError, InputError
from toonifygb.render import library

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

VIEW = camera(150, 90, focal=120.0)
BACKGROUND = torch.tensor([0.1, 0.4, 0.7])


def everything(renderer: render.Renderer, n: int = 2500) -> list[Tensor]:
    """Image, gradients and statistic of a scene of several chunks and tiles."""
    scene, leaves = variables(splats(n, degree=2, frames=True, size=0.03).to(torch.float32))
    info = render.RenderInfo()
    rendering = renderer.render(scene, VIEW, background=BACKGROUND, info=info)
    results = gradients(rendering, leaves)
    assert info.mean2d_gradient is not None
    return [rendering.color.detach(), rendering.alpha.detach(), *results, info.mean2d_gradient]


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_every_thread_count_gives_the_same_bits(native: render.Renderer, threads: int) -> None:
    expected = everything(native)
    for found, one_thread in zip(everything(render.get("native", threads)), expected, strict=True):
        assert torch.equal(found, one_thread)


@pytest.fixture
def restored_isa() -> Iterator[str]:
    """Name of the best instruction set, which is in use again afterwards."""
    best = library.isa()
    yield best
    library.set_isa(best)


@pytest.mark.parametrize("isa", ["avx512", "avx2", "generic"])
def test_every_instruction_set_gives_the_same_image(native: render.Renderer, restored_isa: str, isa: str) -> None:
    best = everything(native)
    try:
        library.set_isa(isa)
    except BackendError:
        pytest.skip(f"this machine has no {isa}")
    assert library.isa() == isa
    color, alpha, *results = everything(native)
    # orders of summation differ, and with them the side of a threshold for single pixels
    for found, expected in ((color, best[0]), (alpha, best[1])):
        errors = (found - expected).abs().flatten()
        assert torch.quantile(errors, 0.999) < 1e-5 and errors.max() < 2 / 255
    for found, expected in zip(results, best[2:], strict=True):
        errors = relative_errors(found, expected)
        assert errors.median() < 2e-5 and torch.quantile(errors, 0.95) < 1e-3


def test_two_renderings_may_wait_for_their_backward_passes(native: render.Renderer) -> None:
    scenes = [variables(splats(60, degree=1, seed=seed).to(torch.float32)) for seed in (1, 2)]
    alone = [gradients(native.render(scene, VIEW), leaves) for scene, leaves in scenes]
    renderings = [native.render(scene, VIEW) for scene, _ in scenes]
    together = [gradients(rendering, leaves) for rendering, (_, leaves) in zip(renderings, scenes, strict=True)]
    for first, second in zip(alone, together, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_rendering_from_several_python_threads(native: render.Renderer) -> None:
    scene = splats(400, degree=1).to(torch.float32)
    expected, found = native.render(scene, VIEW).color, {}

    def work(name: int) -> None:
        renderer = render.get("native", threads=2)
        found[name] = all(torch.equal(renderer.render(scene, VIEW).color, expected) for _ in range(10))

    workers = [threading.Thread(target=work, args=(name,)) for name in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=60)
    assert found == {0: True, 1: True, 2: True}


def _python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter: the library is loaded once per process."""
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_a_missing_library_is_one_clear_sentence() -> None:
    code = (
        "import logging; logging.basicConfig(format='%(message)s')\n"
        "from toonifygb import render\n"
        "for _ in range(2):\n"
        "    try: render.get('native')\n"
        "    except render.library.BackendError as error: print(error)\n"
        "print(render.get('auto').name, render.kernels('auto').name)\n"
    )
    done = _python(code, TOONIFYGB_NATIVE_LIB="/nowhere/engine.so")
    assert done.returncode == 0, done.stderr
    first, second, names = done.stdout.splitlines()
    assert (
        first
        == second
        == (
            "the native engine is not available: TOONIFYGB_NATIVE_LIB names /nowhere/engine.so, which is not a file"
            f" — hint: {library.BUILD_HINT}"
        )
    )
    assert names == "reference reference"
    assert done.stderr.count("slow reference renderer") == 1


def test_a_file_that_is_no_library_is_named(tmp_path) -> None:
    fake = tmp_path / "toonifygb_native.so"
    fake.write_text("not a library")
    code = "from toonifygb.render import library; print(library.unavailable())"
    assert f"{fake} cannot be loaded" in _python(code, TOONIFYGB_NATIVE_LIB=str(fake)).stdout


@pytest.mark.usefixtures("native")
def test_the_instruction_set_can_be_forced() -> None:
    code = "from toonifygb.render import library; print(library.unavailable() or library.isa())"
    assert _python(code, TOONIFYGB_NATIVE_ISA="generic").stdout.strip() == "generic"
    refused = _python(code, TOONIFYGB_NATIVE_ISA="mmx").stdout
    assert "TOONIFYGB_NATIVE_ISA asks for mmx" in refused


def test_unknown_backends_are_refused() -> None:
    names = "auto, cuda, gsplat, native, reference"
    with pytest.raises(InputError, match=f"backend is 'vulkan', expected one of {names}"):
        render.get("vulkan")


def test_auto_says_what_it_chose(native: render.Renderer, caplog: pytest.LogCaptureFixture) -> None:
    render.resolve_backend.cache_clear()
    with caplog.at_level(logging.INFO, logger="toonifygb.render"):
        chosen = render.get("auto")
    assert chosen.name == native.name
    assert caplog.messages == [f"backend auto: native engine ({library.isa()})"]
