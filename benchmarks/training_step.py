"""The parts of a training step in the draft setting: 15k Gaussians, 20 blendshapes, 256 px, SH degree 1."""

from __future__ import annotations

import torch

from benchmarks import limits, scenes
from benchmarks.harness import Figure, cpu_seconds
from toonifygb import render
from toonifygb.render.fused import ReferenceKernels
from toonifygb.structures import GaussianParams

K, WIDTHS = 20, (3, 4, 3, 1, 12)
ADAM_BYTES, BLEND_BYTES = 24, 4
"""Memory traffic per delta: read and write it and its two moments; read it once."""


def run() -> list[Figure]:
    """Processor time of each part and of all of them together, one thread."""
    torch.set_num_threads(1)
    splats, camera = scenes.head(12_000, 3_000, degree=1), scenes.camera(256)
    n = splats.means.shape[0]
    p = n * sum(WIDTHS)
    renderer, native, plain = render.get("native", 1), render.kernels("native", 1), ReferenceKernels()
    deltas, first, second = (torch.rand(K, p) for _ in range(3))
    base, gradient, psi = torch.rand(p), torch.randn(p), torch.rand(K)
    moments, rates = (torch.rand(p), torch.rand(p)), torch.full((p,), 1e-4)
    image, target = torch.rand(2, 256, 256, 3)
    raw = GaussianParams(splats.means, splats.quats, splats.scales.log(), splats.opacities.logit(), splats.sh)
    weights, transforms = torch.softmax(torch.randn(n, 5), -1), torch.eye(4).repeat(5, 1, 1)
    leaves = splats.map(lambda tensor: tensor.clone().requires_grad_())
    inputs = [leaves.means, leaves.quats, leaves.scales, leaves.opacities, leaves.sh]
    parameter = torch.nn.Parameter(deltas.clone())
    torch_adam = torch.optim.Adam([parameter], lr=1e-4, eps=1e-15, fused=True)

    def rendering() -> None:
        rendered = renderer.render(leaves, camera)
        torch.autograd.grad([rendered.color, rendered.alpha], inputs, [image, image[..., 0]])

    def plain_blend_adam() -> None:
        parameter.grad = torch.outer(psi, gradient)
        torch_adam.step()

    jobs = {
        "blend": (lambda: native.blend(base, deltas, psi, out=base), lambda: torch.addmv(base, deltas.T, psi)),
        "render forward + backward": (rendering, None),
        "skin": (lambda: native.skin(raw, weights, transforms), lambda: plain.skin(raw, weights, transforms)),
        "skin gradient": (
            lambda: native.skin_gradient(raw, weights, transforms, splats),
            lambda: plain.skin_gradient(raw, weights, transforms, splats),
        ),
        "L1 + D-SSIM, value and gradient": (
            lambda: native.l1_dssim(image, target),
            lambda: plain.l1_dssim(image, target),
        ),
        "Adam, blendshapes": (
            lambda: native.blend_adam_step(deltas, first, second, psi, gradient, rates, 10),
            plain_blend_adam,
        ),
        "Adam, neutral": (
            lambda: native.adam_step(base, *moments, gradient, rates, 10),
            lambda: plain.adam_step(base, *moments, gradient, rates, 10),
        ),
    }
    floors = {
        "blend": 1e3 * BLEND_BYTES * K * p / limits.bandwidth(),
        "Adam, blendshapes": 1e3 * ADAM_BYTES * K * p / limits.bandwidth(),
    }
    figures, total = [], 0.0
    for name, (job, baseline) in jobs.items():
        seconds = cpu_seconds(job)
        total += seconds
        slow = None if baseline is None else 1e3 * cpu_seconds(baseline, repeats=5)
        figures.append(Figure(name, 1e3 * seconds, "ms", slow, floors.get(name)))
    figures.append(Figure("all of them: steps, one thread", 1 / total, "1/s"))
    return figures
