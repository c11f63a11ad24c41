"""A training step: its parts in the draft setting, and all of it, as training takes it, in the paper's.

Draft: 15k Gaussians, 20 blendshapes, 256 px, SH degree 1. Paper: 64k Gaussians, all blendshapes of the open head,
512 px; the floor beside it is the memory traffic of blending and of Adam over the pairs (Gaussian, blendshape) that
move, shared by the frames of one step of them; compositing comes on top (``benchmarks.rasterizer`` has its floor).
"""

from __future__ import annotations

import dataclasses

import torch

from benchmarks import limits, scenes
from benchmarks.gpu import scene
from benchmarks.harness import Figure, cpu_seconds, wall_seconds
from toonifygb import head, render
from toonifygb.avatar.fields import each
from toonifygb.config import PAPER
from toonifygb.render.fused import ReferenceKernels
from toonifygb.render.native import available_threads
from toonifygb.structures import GaussianParams
from toonifygb.threads import one_torch_thread
from toonifygb.train.state import TrainState
from toonifygb.train.step import Stepper

K, WIDTHS = 20, (3, 4, 3, 1, 12)
ADAM_BYTES, BLEND_BYTES = 24, 4
"""Memory traffic per delta: read and write it and its two moments; read it once."""


FRAMES = 16
PAPER_MINUTES = 44
PAPER_STEP_MS = 1e3 * PAPER_MINUTES * 60 / 40_000
"""The paper's 40 000 steps on an RTX 4090, everything included."""


def run() -> list[Figure]:
    """Processor time of each part in the draft setting, and whole steps in the paper's."""
    return parts() + [figure for degree in (1, 3) for figure in whole_steps(degree)]


def whole_steps(degree: int) -> list[Figure]:
    """Wall time of the paper's steps on all cores, at half and at full resolution, and of all of them together."""
    config = dataclasses.replace(PAPER, sh_degree=degree)
    avatar = scene.avatar(config.n_gaussians, config.n_mouth_gaussians, degree, config.resolution)
    threads, taken = available_threads(), config.delta_frames
    name = f"{avatar.n // 1000}k, K={len(avatar.blendshape_names)}, SH {degree}"
    figures, total = [], 0.0
    with one_torch_thread():
        state = TrainState.start(avatar, 0)
        stepper = Stepper(
            state,
            avatar,
            scene.noise_dataset(FRAMES, config.resolution),
            scene.sequence(head.load("open"), FRAMES, config.resolution),
            config,
            render.get("native", threads),
            render.kernels("native", threads),
        )
        coarse = config.coarse_share
        for side, first, share in ((2, 0.5 * coarse, coarse), (1, 0.5 + 0.5 * coarse, 1 - coarse)):
            state.step = int(first * config.steps)  # every SH degree is active
            seconds = wall_seconds(lambda: [stepper.step() for _ in range(taken)], budget=15.0) / taken
            total += share * config.steps * seconds
            what = f"{name}, {config.resolution // side} px: whole step, {threads} threads, wall"
            floor = step_bytes(state) / taken / limits.bandwidth()
            figures.append(Figure(what, 1e3 * seconds, "ms", PAPER_STEP_MS, 1e3 * floor))
    figures.append(Figure(f"{name}: {config.steps} steps of such", total / 60, "min", PAPER_MINUTES))
    return figures


def step_bytes(state: TrainState) -> float:
    """Least memory traffic of blending and of a step of the deltas: read once, then read and written thrice."""
    per_gaussian = sum(tensor[0].numel() for _, tensor in each(state.neutral.values))
    pairs = int((state.scale != 0).sum()) + len(state.driver.values.means) * state.counts.face
    return (ADAM_BYTES + BLEND_BYTES) * per_gaussian * pairs


def parts() -> list[Figure]:
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
            lambda: native.blend_adam_step(deltas, first, second, psi[None], gradient[None], rates, 10),
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
