"""What only the CUDA backends promise.

Without a GPU the kernels run where ``TRITON_INTERPRET=1`` is set; tile lists, the choice of a backend and gsplat's
conventions are tested everywhere.
"""

from __future__ import annotations

import logging
import os
import sys
import types
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import pytest
import torch
from render_scenes import camera, gradients, relative_errors, splats, variables
from test_render_fused import WIDTHS, coefficients, doubles, skinned

from toonifygb import render
from toonifygb.errors import BackendError
from toonifygb.render import RenderInfo, cuda, library, reference
from toonifygb.render.base import DEFAULT_CONSTANTS, RasterConstants
from toonifygb.render.fused import Kernels, ReferenceKernels, expand_scale, learning_rates
from toonifygb.render.proof import disagreement
from toonifygb.render.reference import ReferenceRenderer
from toonifygb.render.tiles import tile_lists

N, K = 103, 5
P = N * sum(WIDTHS)
DEFINITION = ReferenceKernels()
BACKGROUND = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)


def needs(backend: str) -> None:
    """Skips a test that runs kernels where none can."""
    if reason := cuda.unavailable(backend):
        pytest.skip(f"{backend} renderer not available: {reason}")


def compare(name: str, scene: Any, view: Any, constants: RasterConstants = DEFAULT_CONSTANTS) -> None:
    """Image, gradients and statistic of a backend against the reference in float64."""
    reports = []
    for backend, dtype in ((ReferenceRenderer(), torch.float64), (render.get(name), torch.float32)):
        info = RenderInfo()
        leaf_scene, leaves = variables(scene.to(dtype))
        shown = backend.render(leaf_scene, view, background=BACKGROUND, constants=constants, info=info)
        reports.append(([shown.color, shown.alpha], gradients(shown, leaves), info))
    (images, pulls, report), (found_images, found_pulls, found_report) = reports
    for found, expected in zip(found_images, images, strict=True):
        assert (found - expected).abs().max() < 1e-5
    assert torch.equal(found_report.radii, report.radii)
    for found, expected in zip(
        [*found_pulls, found_report.mean2d_gradient], [*pulls, report.mean2d_gradient], strict=True
    ):
        errors = relative_errors(found, expected)
        assert errors.median() < 2e-5 and torch.quantile(errors, 0.95) < 1e-3


@pytest.mark.parametrize("tile", [4, 12, 16])
def test_kernels_agree_with_the_reference(tile: int) -> None:
    needs("cuda")
    compare("cuda", splats(30, degree=1, frames=True), camera(20, 18, focal=22.0), RasterConstants(tile=tile))


def test_opaque_pixels_stop_where_the_reference_stops() -> None:
    needs("cuda")
    scene = splats(60, degree=0, size=0.4)
    opaque = type(scene)(scene.means, scene.quats, scene.scales, 0.9 + 0.1 * scene.opacities, scene.sh)
    compare("cuda", opaque, camera(16, 16, focal=20.0))


def test_the_same_bits_every_time() -> None:
    needs("cuda")
    found = []
    for _ in range(2):
        scene, leaves = variables(splats(25, degree=1).to(torch.float32))
        shown = render.get("cuda").render(scene, camera(16, 16, focal=20.0))
        found.append([shown.color.detach(), *gradients(shown, leaves)])
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_blend(cuda_kernels: Kernels, dtype: torch.dtype) -> None:
    base, deltas, psi = (
        tensor.to(cuda_kernels.device) for tensor in (torch.randn(P), torch.randn(K, P), coefficients()[:K])
    )
    deltas = deltas.to(dtype)
    expected = base.double() + (psi.double()[:, None] * deltas.double()).sum(0)
    torch.testing.assert_close(cuda_kernels.blend(base, deltas, psi).double(), expected, rtol=0, atol=5e-6)
    deltas[psi == 0] = torch.nan
    assert cuda_kernels.blend(base, deltas, psi, out=base) is base
    torch.testing.assert_close(base.double(), expected, rtol=0, atol=5e-6)


@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize("scaled", [False, True])
def test_adam(cuda_kernels: Kernels, scaled: bool, frames: int) -> None:
    device = cuda_kernels.device
    rates = learning_rates(WIDTHS, (1e-3, 2e-3, 3e-3, 4e-3, 2e-3), N).to(device)
    scale = (torch.rand(K, N) * (torch.rand(K, N) > 0.4)).to(device) if scaled else None
    live = torch.ones(K, P, dtype=torch.bool) if scale is None else expand_scale(scale, WIDTHS) != 0
    found = tuple(tensor.to(device) for tensor in (torch.randn(K, P), torch.zeros(K, P), torch.zeros(K, P)))
    start, expected = found[0].clone(), doubles(found)
    for step in range(1, 4):
        psi = torch.stack([coefficients()[:K].roll(step + b) for b in range(frames)]).to(device)
        gradient = torch.randn(frames, P).to(device)
        options = {"widths": WIDTHS, "skip_inactive": step % 2 == 0, "factor": 0.5}
        cuda_kernels.blend_adam_step(*found, psi, gradient, rates, step, scale=scale, **options)
        wide = None if scale is None else scale.double()
        DEFINITION.blend_adam_step(*expected, *doubles((psi, gradient, rates)), step, scale=wide, **options)
    for ours, definition in zip(found, expected, strict=True):
        torch.testing.assert_close(ours.double()[live], definition[live], rtol=1e-5, atol=1e-6)
    assert torch.equal(found[0][~live], start[~live])
    row = [tensor[0] for tensor in found]
    wide_row = doubles(tuple(row))
    cuda_kernels.adam_step(*row, gradient[0], rates, 4)
    DEFINITION.adam_step(*wide_row, *doubles((gradient[0], rates)), 4)
    torch.testing.assert_close(row[0].double()[live[0]], wide_row[0][live[0]], rtol=1e-5, atol=1e-6)


def test_skinning(cuda_kernels: Kernels) -> None:
    for n in (0, N):
        raw, weights, transforms = (part.to(cuda_kernels.device) for part in skinned(n))
        expected = DEFINITION.skin(raw, weights, transforms)
        narrow = (raw.to(torch.float32), weights.float(), transforms.float())
        upstream = expected.map(torch.randn_like)
        exact = DEFINITION.skin_gradient(raw, weights, transforms, upstream)
        pulled = cuda_kernels.skin_gradient(*narrow, upstream.to(torch.float32))
        for ours, definition in ((cuda_kernels.skin(*narrow), expected), (pulled, exact)):
            for name, value in vars(definition).items():
                torch.testing.assert_close(getattr(ours, name).double(), value, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (23, 17)])
def test_l1_dssim(cuda_kernels: Kernels, size: tuple[int, int]) -> None:
    image, target = torch.rand(2, *size, 3).to(cuda_kernels.device)
    loss, gradient = cuda_kernels.l1_dssim(image, target, 0.7, 0.4)
    expected, slope = DEFINITION.l1_dssim(image.double(), target.double(), 0.7, 0.4)
    assert loss.item() == pytest.approx(expected.item(), abs=1e-6)
    torch.testing.assert_close(gradient.double(), slope, rtol=0, atol=2e-6 * slope.abs().max().item())


def _signature(kernel: Any, constants: dict[str, Any]) -> dict[str, str]:
    """Types of a kernel's arguments as the launches give them."""
    integers, numbers = (
        {"starts", "slots", "stops"},
        {"width", "height", "tiles_x", "k", "p", "start", "count", "n"},
    )
    numbers |= {"per_gaussian", "length", "stride"}
    floats = {"alpha_min", "alpha_max", "transmittance_min", "factor", "eps", "first_gain", "second_gain"}
    types = {}
    for name in kernel.arg_names:
        known = {"constexpr": constants, "*i32": integers, "i32": numbers, "fp32": floats}
        types[name] = next((kind for kind, names in known.items() if name in names), "*fp32")
    return types


@pytest.mark.skipif(find_spec("triton") is None, reason="Triton is not installed")
@pytest.mark.skipif(os.environ.get(cuda.INTERPRET_VARIABLE) == "1", reason="the kernels are interpreted")
@pytest.mark.parametrize("capability", [80, 90])
def test_kernels_compile_without_a_gpu(capability: int) -> None:
    import triton
    from triton.backends.compiler import GPUTarget

    from toonifygb.render import cuda_kernels

    strip = {"FIELDS": cuda.FIELDS, "TILE": 16, "ROWS": 4, "PIXELS": 64}
    betas = {"BETA1": 0.9, "BETA2": 0.999, "BLOCK": 1024}
    jobs = [
        ("composite_forward", strip),
        ("composite_forward", strip | {"width": 1, "height": 1, "tiles_x": 1}),  # Triton makes ones constants
        ("composite_backward", strip | {"COLUMNS": cuda.COLUMNS}),
        ("composite_backward", strip | {"COLUMNS": cuda.COLUMNS, "width": 1, "height": 1, "tiles_x": 1}),
        ("sum_rows", {"COLUMNS": cuda.COLUMNS, "WIDE": 16, "BLOCK": cuda.SUM_ROWS}),
        ("blend", {"BLOCK": 1024}),
        ("blend", {"BLOCK": 1024, "k": 1, "p": 1}),
        ("adam", betas | {"SCALED": True, "SKIP": True, "per_gaussian": 1, "n": 1}),
        ("adam", betas | {"SCALED": False, "SKIP": False, "p": 1, "count": 1}),
        ("smooth", {"TAPS": 11, "BLOCK": 1024}),
        ("smooth", {"TAPS": 11, "BLOCK": 1024, "length": 1, "stride": 1}),
        ("skin_maps", {"JOINTS": 5, "BLOCK": 128}),
        ("skin_maps", {"JOINTS": 5, "BLOCK": 128, "n": 1}),
    ]
    for name, constants in jobs:
        kernel = getattr(cuda_kernels, name)
        source = triton.compiler.ASTSource(fn=kernel, signature=_signature(kernel, constants), constexprs=constants)
        warps = 1 if name.startswith(("composite", "sum")) else 4
        compiled = triton.compile(source, target=GPUTarget("cuda", capability, 32), options={"num_warps": warps})
        assert compiled.asm["cubin"], name


def test_unusable_tensors_are_named(cuda_kernels: Kernels) -> None:
    with pytest.raises(ValueError, match="psi is"):
        device = cuda_kernels.device
        cuda_kernels.blend(*(torch.zeros(shape, device=device) for shape in ((4,), (2, 4), (3,))))


@pytest.mark.parametrize("size", [(48, 40), (1, 1), (65, 33)])
@pytest.mark.parametrize("tile", [8, 16])
def test_tile_lists_are_those_of_the_reference(size: tuple[int, int], tile: int) -> None:
    """Asked of every Gaussian at every tile, in depth order, as ``reference.py`` composites them."""
    constants, view = RasterConstants(tile=tile), camera(*size, focal=float(max(size)))
    projected = reference.project(splats(120), view, 3, constants)
    lists = tile_lists(projected, view, tile)
    left, top, right, bottom = projected.rectangles.unbind(-1)
    assert (lists.columns, lists.rows) == (-(-size[0] // tile), -(-size[1] // tile))
    for number in range(lists.n_tiles):
        x, y = number % lists.columns, number // lists.columns
        members = ((left <= x) & (x < right) & (top <= y) & (y < bottom)).nonzero()[:, 0]
        found = slice(int(lists.starts[number]), int(lists.starts[number + 1]))
        assert lists.gaussians[found].tolist() == members.tolist()
        owners = torch.searchsorted(lists.slot_starts, lists.slots[found], right=True) - 1
        assert torch.equal(owners.int(), lists.gaussians[found])
    assert sorted(lists.slots.tolist()) == list(range(int(lists.starts[-1])))


def test_no_gaussians_no_lists() -> None:
    projected = reference.project(splats(0), camera(), 3, DEFAULT_CONSTANTS)
    lists = tile_lists(projected, camera(), 16)
    assert len(lists.gaussians) == 0 and lists.starts.abs().max() == 0


@pytest.mark.parametrize("name", ["cuda", "gsplat"])
def test_a_missing_device_is_one_clear_sentence(name: str) -> None:
    if not cuda.unavailable(name):
        pytest.skip(f"{name} is available")
    with pytest.raises(BackendError, match=f"the {name} backend is not available: .* hint: use auto"):
        render.get(name)


def test_auto_says_why_a_gpu_is_not_used(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "unavailable", lambda name="cuda": "Triton is not installed")
    render.resolve_backend.cache_clear()
    with caplog.at_level(logging.INFO, logger="toonifygb.render"):
        chosen = render.resolve_backend("auto")
    render.resolve_backend.cache_clear()
    assert chosen in ("native", "reference")
    assert caplog.messages[0] == "backend auto: the processor, because CUDA cannot be used: Triton is not installed"


def test_auto_takes_the_gpu(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a card")
    monkeypatch.setattr(cuda, "unavailable", lambda name="cuda": None)
    monkeypatch.setattr(cuda, "CudaRenderer", ReferenceRenderer)
    render.resolve_backend.cache_clear()
    with caplog.at_level(logging.INFO, logger="toonifygb.render"):
        assert render.resolve_backend("auto") == "cuda"
    render.resolve_backend.cache_clear()
    assert caplog.messages == ["backend auto: CUDA (a card)"]


class _Shifted(ReferenceRenderer):
    """A renderer that is wrong by a half-pixel's worth of everything."""

    def render(self, splats, camera, **settings):
        return super().render(replace(splats, means=splats.means + 1e-3), camera, **settings)


class _Broken(ReferenceRenderer):
    def render(self, splats, camera, **settings):
        raise ValueError("no such instruction")


@pytest.mark.parametrize(
    ("kind", "reason"),
    [(_Shifted, "its picture of a small scene is off by"), (_Broken, "it fails on a small picture")],
)
def test_auto_does_not_take_a_gpu_that_draws_something_else(
    kind: type, reason: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "unavailable", lambda name="cuda": None)
    monkeypatch.setattr(cuda, "CudaRenderer", kind)
    render.resolve_backend.cache_clear()
    with caplog.at_level(logging.INFO, logger="toonifygb.render"):
        assert render.resolve_backend("auto") in ("native", "reference")
    render.resolve_backend.cache_clear()
    assert reason in caplog.messages[0]


def test_native_engine_passes_the_same_proof() -> None:
    assert disagreement(render.get("native" if library.unavailable() is None else "reference", 1)) is None


def _gsplat_in_torch(
    means2d, conics, colors, opacities, width, height, tile_size, isect_offsets, flatten_ids, **options
):
    """gsplat's compositing as its documentation has it, pixel centres at half-integers."""
    assert options["packed"] is False
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    starts = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    columns = isect_offsets.shape[2]
    rows = []
    for row in range(height):
        for column in range(width):
            tile = (row // tile_size) * columns + column // tile_size
            members = flatten_ids[starts[tile] : starts[tile + 1]].long()
            color, left = torch.zeros(3), torch.ones(())
            for g in members.tolist():
                dx, dy = means2d[0, g, 0] - x[row, column], means2d[0, g, 1] - y[row, column]
                a, b, c = conics[0, g]
                alpha = (opacities[0, g] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp_max(
                    0.999
                )
                if alpha < 1 / 255:
                    continue
                if left * (1 - alpha) <= 1e-4:
                    break
                color, left = color + left * alpha * colors[0, g], left * (1 - alpha)
            rows.append(torch.cat([color + left * options["backgrounds"][0], left[None]]))
    image = torch.stack(rows).view(height, width, 4)
    return image[None, ..., :3], 1 - image[None, ..., 3:]


def test_gsplat_is_given_what_it_expects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Conventions only: pixel centres, order of conics, lists, background, statistic."""
    stand_in = types.ModuleType("gsplat")
    stand_in.rasterize_to_pixels = _gsplat_in_torch  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsplat", stand_in)
    monkeypatch.setattr(cuda, "unavailable", lambda name="cuda": None)
    monkeypatch.setattr(cuda, "device", lambda: torch.device("cpu"))
    compare("gsplat", splats(12, degree=1), camera(9, 7, focal=9.0), RasterConstants(tile=4))
    with pytest.raises(BackendError, match=r"alpha_min is 0\.02, gsplat is compiled for 0\.00392"):
        render.get("gsplat").render(
            splats(3).to(torch.float32), camera(), constants=RasterConstants(alpha_min=0.02)
        )
