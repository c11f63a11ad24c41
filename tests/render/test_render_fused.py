"""The fused training kernels: their definition against torch, and the native ones against the definition."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from toonifygb import metrics, render
from toonifygb.geometry import rotations
from toonifygb.render.fused import Kernels, ReferenceKernels, expand_scale, learning_rates
from toonifygb.structures import GaussianParams

WIDTHS, N, K = (3, 4, 3, 1, 12), 1003, 7  # 1003: neither vectors nor chunks come out even
P = N * sum(WIDTHS)
DEFINITION = ReferenceKernels()


@pytest.fixture(params=["reference", "native"])
def kernels(request: pytest.FixtureRequest) -> Kernels:
    """Each set of kernels in turn."""
    if request.param == "native":
        return request.getfixturevalue("native_kernels")
    return render.kernels("reference")


@pytest.fixture
def rates() -> Tensor:
    """Learning rates that differ between groups, and within the last."""
    return learning_rates(WIDTHS, (1e-3, 2e-3, 3e-3, 4e-3, [2e-3] * 3 + [1e-4] * 9), N)


def coefficients() -> Tensor:
    """Expression coefficients, some of them 0."""
    return torch.randn(K) * (torch.arange(K) % 3 != 1)


def doubles(tensors: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Copies in float64."""
    return tuple(tensor.detach().to(torch.float64, copy=True) for tensor in tensors)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("p", [1, 15, P])
def test_blend_is_the_weighted_sum(kernels: Kernels, dtype: torch.dtype, p: int) -> None:
    base, deltas, psi = torch.randn(p), torch.randn(K, p).to(dtype), coefficients()
    expected = base.double() + (psi.double()[:, None] * deltas.double()).sum(0)
    torch.testing.assert_close(kernels.blend(base, deltas, psi).double(), expected, rtol=0, atol=5e-6)
    assert torch.equal(kernels.blend(base, deltas, torch.zeros(K)), base)
    blended = kernels.blend(base, deltas, psi)
    assert kernels.blend(base, deltas, psi, out=base) is base
    assert torch.equal(base, blended)


def test_blend_does_not_read_inactive_rows(kernels: Kernels) -> None:
    deltas, psi = torch.full((K, 50), torch.nan), torch.zeros(K)
    deltas[3], psi[3] = 1.0, 0.5
    assert torch.equal(kernels.blend(torch.zeros(50), deltas, psi), torch.full((50,), 0.5))


@pytest.mark.parametrize("frames", [1, 3])
def test_blends_of_several_frames_add_up(kernels: Kernels, frames: int) -> None:
    deltas, psi = torch.randn(K, P), torch.stack([coefficients().roll(b) for b in range(frames)])
    start = torch.randn(frames, P + 7)
    out = start.clone()
    kernels.add_blends(out, deltas, psi)
    expected = start[:, :P].double() + psi.double() @ deltas.double()
    torch.testing.assert_close(out[:, :P].double(), expected, rtol=0, atol=5e-6)
    assert torch.equal(out[:, P:], start[:, P:])
    for b in range(frames):  # no frame depends on which others it is computed with
        alone = start[b : b + 1].clone()
        kernels.add_blends(alone, deltas, psi[b : b + 1])
        assert kernels.name == "reference" or torch.equal(alone[0], out[b])


@pytest.mark.parametrize("size", [(2, 2), (6, 10), (50, 34)])
@pytest.mark.parametrize("factor", [1, 2])
def test_a_picture_on_a_background(kernels: Kernels, size: tuple[int, int], factor: int) -> None:
    frame = torch.randint(0, 256, (*size, 3), dtype=torch.uint8)
    matte, background = torch.rand(size), torch.tensor([0.1, 0.5, 0.9])
    color, small = kernels.place(frame, matte, background, factor)
    shares = matte.double()[..., None]
    wanted = frame.double() / 255 * shares + background.double() * (1 - shares)
    pooled = torch.nn.functional.avg_pool2d(torch.cat([wanted, shares], -1).movedim(-1, 0), factor).movedim(0, -1)
    torch.testing.assert_close(color.double(), pooled[..., :3], rtol=0, atol=1e-6)
    torch.testing.assert_close(small.double(), pooled[..., 3], rtol=0, atol=1e-6)


def test_adam_step_is_torch_adam(kernels: Kernels) -> None:
    dtype = torch.float64 if kernels.name == "reference" else torch.float32
    ours = torch.randn(999, dtype=dtype)
    theirs = ours.to(torch.float64, copy=True).requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=5e-3, betas=(0.9, 0.999), eps=1e-15)
    state = (ours, torch.zeros_like(ours), torch.zeros_like(ours))
    for step in range(1, 8):
        gradient = torch.randn(999, dtype=dtype) * torch.logspace(-6, 3, 999, dtype=dtype)
        theirs.grad = gradient.double()
        optimizer.step()
        kernels.adam_step(*state, gradient, torch.full((999,), 1e-2, dtype=dtype), step, factor=0.5)
    torch.testing.assert_close(
        ours.double(), theirs.detach(), rtol=0, atol=1e-12 if dtype == torch.float64 else 2e-6
    )


def test_adam_step_leaves_parameters_without_gradient(kernels: Kernels) -> None:
    parameters = torch.randn(40)
    before = parameters.clone()
    kernels.adam_step(parameters, torch.zeros(40), torch.zeros(40), torch.zeros(40), torch.ones(40), 1)
    assert torch.equal(parameters, before)


def test_consistency_scale_is_adam_on_the_unscaled_deltas(rates: Tensor) -> None:
    """Steps on applied deltas scale·Δ̂ equal Adam's steps on the trained tensor Δ̂ (3DGB's intermediate variable)."""
    scale = torch.rand(K, N, dtype=torch.float64) + 0.1
    factor = expand_scale(scale, WIDTHS)
    hidden = torch.zeros(K, P, dtype=torch.float64, requires_grad=True)
    applied = [torch.zeros(K, P, dtype=torch.float64) for _ in range(3)]
    optimizer = torch.optim.Adam([hidden], lr=1.0, eps=1e-15)
    for step in range(1, 4):
        psi, gradient = coefficients().double() + 0.1, torch.randn(P, dtype=torch.float64)
        hidden.grad = factor * psi[:, None] * gradient
        optimizer.step()
        DEFINITION.blend_adam_step(
            *applied,
            psi[None],
            gradient[None],
            torch.ones(P, dtype=torch.float64),
            step,
            scale=scale,
            widths=WIDTHS,
        )
    torch.testing.assert_close(applied[0], factor * hidden.detach(), rtol=1e-9, atol=1e-9)


def test_a_step_over_several_frames_takes_the_sum_of_their_gradients(kernels: Kernels, rates: Tensor) -> None:
    psi, gradient = torch.stack([coefficients().roll(i) for i in range(3)]), torch.randn(3, P)
    found, expected = ((torch.zeros(K, P), torch.zeros(K, P), torch.zeros(K, P)) for _ in range(2))
    kernels.blend_adam_step(*found, psi, gradient, rates, 1)
    for k in range(K):
        DEFINITION.adam_step(*(part[k] for part in expected), psi[:, k] @ gradient, rates, 1)
    # Adam's first step is the sign of the gradient: moments show more
    torch.testing.assert_close(found[1], expected[1], rtol=0, atol=1e-6)
    torch.testing.assert_close(found[2], expected[2], rtol=0, atol=1e-6)
    assert (psi.abs() > 0).sum(0).max() > 1


@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("skip_inactive", [False, True])
def test_native_blend_adam_agrees(
    native_kernels: Kernels, rates: Tensor, scaled: bool, skip_inactive: bool, frames: int
) -> None:
    scale = torch.rand(K, N) * (torch.rand(K, N) > 0.4) if scaled else None
    live = torch.ones(K, P, dtype=torch.bool) if scale is None else expand_scale(scale, WIDTHS) != 0
    found = (torch.randn(K, P), torch.zeros(K, P), torch.zeros(K, P))
    start = found[0].clone()
    expected = doubles(found)
    for step in range(1, 6):
        psi = torch.stack([coefficients().roll(step + b) for b in range(frames)])
        gradient = torch.randn(frames, P)
        options = {"widths": WIDTHS, "skip_inactive": skip_inactive, "factor": 0.5 + 0.1 * step}
        native_kernels.blend_adam_step(*found, psi, gradient, rates, step, scale=scale, **options)
        wide_scale = None if scale is None else scale.double()
        DEFINITION.blend_adam_step(*expected, *doubles((psi, gradient, rates)), step, scale=wide_scale, **options)
    for ours, definition in zip(found, expected, strict=True):
        torch.testing.assert_close(ours.double()[live], definition[live], rtol=1e-5, atol=1e-6)
    assert torch.equal(found[0][~live], start[~live])
    assert (found[0] - start)[live].abs().max() > 1e-3


def test_inactive_rows_coast_unless_skipped(kernels: Kernels, rates: Tensor) -> None:
    moved = {}
    for skip_inactive in (False, True):
        state = (torch.zeros(K, P), torch.zeros(K, P), torch.zeros(K, P))
        gradient, psi = torch.randn(2, P), torch.ones(2, K)
        kernels.blend_adam_step(*state, psi, gradient, rates, 1, skip_inactive=skip_inactive)
        before, psi[:, 2] = state[0].clone(), 0
        kernels.blend_adam_step(*state, psi, gradient, rates, 2, skip_inactive=skip_inactive)
        moved[skip_inactive] = (state[0] - before)[2].abs().max().item()
    assert moved[True] == 0 < moved[False]


def skinned(n: int) -> tuple[GaussianParams, Tensor, Tensor]:
    """Raw Gaussians, weights (some rigid) and five joint maps that turn by up to two radians; float64."""
    raw = GaussianParams(
        torch.randn(n, 3).double(),
        torch.randn(n, 4).double(),
        torch.randn(n, 3).double() - 6,
        2 * torch.randn(n).double(),
        torch.randn(n, 4, 3).double(),
    )
    weights = torch.softmax(2 * torch.randn(n, 5), -1).double()
    weights[::3] = torch.eye(5, dtype=torch.float64)[torch.arange(0, n, 3) % 5]
    # the maps of one Gaussian differ by less than 90 degrees: a sum of opposite turns has no rotation factor
    angles = torch.tensor([2.0, 0.3, 0.0]) + 0.3 * torch.randn(5, 3)
    transforms = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    transforms[:, :3, :3] = rotations.axis_angle_to_matrix(angles.double())
    transforms[:, :3, 3] = torch.randn(5, 3).double()
    return raw, weights, transforms


def test_native_skinning_agrees(native_kernels: Kernels) -> None:
    for n in (0, 1, 1003):
        raw, weights, transforms = skinned(n)
        expected = DEFINITION.skin(raw, weights, transforms)
        narrow = (raw.to(torch.float32), weights.float(), transforms.float())
        found = native_kernels.skin(*narrow)
        upstream = expected.map(torch.randn_like)
        expected_gradient = DEFINITION.skin_gradient(raw, weights, transforms, upstream)
        gradient = native_kernels.skin_gradient(*narrow, upstream.to(torch.float32))
        for ours, definition in ((found, expected), (gradient, expected_gradient)):
            for name, value in vars(definition).items():
                mine = getattr(ours, name).double()
                assert mine.shape == value.shape
                # 1e-5: float32 through three polar steps and a division by the quaternion's length
                worst = ((mine - value).abs() / value.abs().clamp_min(1)).flatten().tolist()
                assert max(worst, default=0) < 1e-5, name


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (11, 11), (33, 17), (64, 96)])
def test_l1_dssim_agrees_with_its_definition(kernels: Kernels, size: tuple[int, int]) -> None:
    image, target = torch.rand(*size, 3), torch.rand(*size, 3)
    target[: size[0] // 2] = image[: size[0] // 2]  # no difference: the subgradient of |x| is 0
    loss, gradient = kernels.l1_dssim(image, target, 0.7, 0.4)
    variable = image.double().requires_grad_()
    expected = 0.7 * (variable - target).abs().mean() + 0.4 * (1 - metrics.ssim(variable, target.double()))
    (slope,) = torch.autograd.grad(expected, variable)
    assert loss.item() == pytest.approx(expected.item(), abs=1e-6)
    # 2e-6: variances are differences of squares in float32
    torch.testing.assert_close(gradient.double(), slope, rtol=0, atol=2e-6 * slope.abs().max().item())


def test_threads_do_not_change_a_bit(native_kernels: Kernels, rates: Tensor) -> None:
    many = render.kernels("native", threads=3)
    results = []
    for kernels in (native_kernels, many):
        random = torch.Generator().manual_seed(3)
        state = tuple(torch.rand(K, P, generator=random) for _ in range(3))
        base, psi = torch.randn(P, generator=random), torch.randn(K, generator=random)
        image, target = torch.rand(2, 70, 45, 3, generator=random)
        blended = kernels.blend(base, state[0], psi)
        kernels.blend_adam_step(
            *state, psi[None], base[None], rates, 4, scale=torch.rand(K, N, generator=random), widths=WIDTHS
        )
        kernels.adam_step(*(row[0] for row in state), base, rates, 4)
        torch.manual_seed(5)
        raw, weights, transforms = skinned(3000)
        splats = kernels.skin(raw.to(torch.float32), weights.float(), transforms.float())
        results.append([blended, *state, *kernels.l1_dssim(image, target), splats.means, splats.quats])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_unusable_tensors_are_named(native_kernels: Kernels) -> None:
    with pytest.raises(ValueError, match=r"base is torch.float64 \(4,\) on cpu, expected contiguous torch.float32"):
        native_kernels.blend(torch.zeros(4, dtype=torch.float64), torch.zeros(2, 4), torch.zeros(2))
    with pytest.raises(ValueError, match="psi is"):
        native_kernels.blend(torch.zeros(4), torch.zeros(2, 4), torch.zeros(3))


def test_scale_must_fit(kernels: Kernels) -> None:
    state = tuple(torch.zeros(2, 8) for _ in range(3))
    with pytest.raises(ValueError, match=r"expected \(2, n\) with n"):
        kernels.blend_adam_step(
            *state, torch.ones(1, 2), torch.ones(1, 8), torch.ones(8), 1, scale=torch.ones(2, 3), widths=(1, 3)
        )
