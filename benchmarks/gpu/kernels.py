"""Every kernel against its definition in float64, and its time beside the bandwidth floor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from benchmarks import scenes
from benchmarks.gpu import machine
from benchmarks.harness import Figure
from toonifygb import render
from toonifygb.render.fused import ReferenceKernels
from toonifygb.structures import GaussianParams, Splats

if TYPE_CHECKING:
    from collections.abc import Iterable

    from torch import Tensor

    from benchmarks.gpu.machine import Bench

K, WIDTHS = 50, (3, 4, 3, 1, 12)
ADAM_BYTES, BLEND_BYTES = 24, 4
"""Memory traffic per delta: read and write it and its two moments; read it once."""


def run(bench: Bench) -> list[Figure]:
    """Largest errors relative to the largest value, and milliseconds."""
    torch.manual_seed(0)
    return [*_fused(bench), *_raster(bench)]


def _worst(found: Iterable[Tensor], expected: Iterable[Tensor]) -> float:
    """Largest error, relative to the largest value of each tensor."""
    pairs = zip(found, expected, strict=True)
    return max(float((a.double() - b).abs().max() / b.abs().max().clamp_min(1e-30)) for a, b in pairs)


def _fused(bench: Bench) -> list[Figure]:
    kernels, plain = render.kernels(bench.backend), ReferenceKernels()
    n = bench.pick(64_000, 500)
    p, device = n * sum(WIDTHS), bench.device
    base, gradient, rates = (
        torch.randn(p, device=device),
        torch.randn(p, device=device),
        torch.rand(p, device=device),
    )
    psi = torch.randn(K, device=device) * (torch.arange(K, device=device) % 4 != 1)
    state = [torch.randn(K, p, device=device), torch.zeros(K, p, device=device), torch.zeros(K, p, device=device)]
    wide = [tensor.double() for tensor in state]
    figures = [
        _figure("blend", [kernels.blend(base, state[0], psi)], [plain.blend(base.double(), wide[0], psi.double())])
    ]
    for step in (1, 2):
        kernels.blend_adam_step(*state, psi[None], gradient[None], rates, step)  # type: ignore[call-arg]
        plain.blend_adam_step(*wide, psi[None].double(), gradient[None].double(), rates.double(), step)  # type: ignore[call-arg]
    figures.append(_figure("Adam, blendshapes", state, wide))
    del wide
    raw, weights, transforms = _rest(n, device)
    posed, exact = (k.skin(raw.to(d), weights.to(d), transforms.to(d)) for k, d in _both(kernels, plain))
    figures.append(_figure("skin", _fields(posed), _fields(exact)))
    pull = posed.map(torch.randn_like)
    pulled, exact = (
        k.skin_gradient(raw.to(d), weights.to(d), transforms.to(d), pull.to(d)) for k, d in _both(kernels, plain)
    )
    figures.append(_figure("skin gradient", vars(pulled).values(), vars(exact).values()))
    size = bench.pick(512, 48)
    image, target = torch.rand(2, size, size, 3, device=device)
    loss, slope = kernels.l1_dssim(image, target)
    loss64, slope64 = plain.l1_dssim(image.double(), target.double())
    figures.append(_figure("L1 + D-SSIM with gradient", [loss, slope], [loss64, slope64]))

    traffic = bench.device.type == "cuda"
    blend_floor = 1e3 * BLEND_BYTES * (K + 2) * p / machine.bandwidth(bench) if traffic else None
    adam_floor = 1e3 * ADAM_BYTES * K * p / machine.bandwidth(bench) if traffic else None
    ones = torch.ones_like(psi)

    def adam() -> None:
        kernels.blend_adam_step(*state, ones[None], gradient[None], rates, 9)  # type: ignore[call-arg]

    jobs = (
        ("blend", lambda: kernels.blend(base, state[0], ones), blend_floor),
        ("Adam, blendshapes", adam, adam_floor),
        ("skin", lambda: kernels.skin(raw, weights, transforms), None),
        ("skin gradient", lambda: kernels.skin_gradient(raw, weights, transforms, posed), None),
        ("L1 + D-SSIM with gradient", lambda: kernels.l1_dssim(image, target), None),
    )
    name = f"{n // 1000}k x {K}"
    return figures + [
        Figure(f"{what}, {name}", 1e3 * bench.seconds(job), "ms", floor=floor) for what, job, floor in jobs
    ]


def _both(kernels: object, plain: object) -> list[tuple]:
    return [(kernels, torch.float32), (plain, torch.float64)]


def _fields(splats: Splats) -> list[Tensor]:
    return [tensor for tensor in vars(splats).values() if tensor is not None]


def _figure(what: str, found: Iterable[Tensor], expected: Iterable[Tensor]) -> Figure:
    return Figure(f"{what}: error against float64", _worst(found, expected), "1")


def _rest(n: int, device: torch.device) -> tuple[GaussianParams, Tensor, Tensor]:
    """Raw Gaussians, weights and five gentle joint maps."""
    parts = [torch.randn(n, *shape, device=device) for shape in ((3,), (4,), (3,), (), (4, 3))]
    transforms = torch.eye(4, device=device).repeat(5, 1, 1)
    transforms[:, :3, :3] = torch.linalg.qr(torch.eye(3) + 0.2 * torch.randn(5, 3, 3))[0].to(device)
    transforms[:, :3, :3] *= transforms[:, :3, :3].det().sign()[:, None, None]
    transforms[:, :3, :3] = transforms[:1, :3, :3]  # joints that turn oppositely have no mean rotation
    return GaussianParams(*parts), torch.softmax(torch.randn(n, 5, device=device), -1), transforms


def _raster(bench: Bench) -> list[Figure]:
    """A head of 15k Gaussians against the reference in float64; a few pixels may fall on a threshold."""
    size, n = bench.pick(256, 32), bench.pick(12_000, 150)
    splats, camera = scenes.head(n, n // 4, 3), scenes.camera(size)
    upstream = [torch.randn(size, size, 3), torch.randn(size, size)]
    images, pulls = [], []
    for name, dtype in ((bench.backend, torch.float32), ("reference", torch.float64)):
        leaves = splats.map(lambda field, to=dtype: field.to(bench.device, to).requires_grad_())
        inputs = [leaves.means, leaves.quats, leaves.scales, leaves.opacities, leaves.sh]
        shown = render.get(name).render(leaves, camera)
        seeds = [seed.to(bench.device, dtype) for seed in upstream]
        pulls.append(torch.autograd.grad([shown.color, shown.alpha], inputs, seeds))
        images.append(shown.color.detach().double())
    errors = (images[0] - images[1]).abs().flatten()
    figures = [
        Figure(
            "image: error against float64, 999 of 1000 pixels",
            float(errors.kthvalue(int(0.999 * len(errors)))[0]),
            "1",
        )
    ]
    for name, ours, exact in zip(("means", "quats", "scales", "opacities", "sh"), *pulls, strict=True):
        apart = float((ours.double() - exact).norm() / exact.norm())
        figures.append(Figure(f"gradient of {name}: relative error", apart, "1"))
    return figures
