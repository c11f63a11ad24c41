"""What every renderer must do; the reference in float64 is the oracle."""

from __future__ import annotations

import pytest
import torch
from render_scenes import camera, gradients, join, one, relative_errors, splats, variables

from toonifygb.geometry import harmonics
from toonifygb.render import RasterConstants, Renderer, RenderInfo
from toonifygb.render.reference import ReferenceRenderer
from toonifygb.structures import Splats

ORACLE = ReferenceRenderer()
BACKGROUND = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)


def largest_difference(renderer: Renderer, scene: Splats, view, **options) -> float:
    """Largest difference of colour or alpha from the oracle, over all but one pixel in a thousand.

    The rest is where float32 and float64 fall on different sides of a threshold (alpha of 1/255, transmittance of
    1e-4), which changes a pixel by up to 1/255.
    """
    expected = ORACLE.render(scene, view, **options)
    found = renderer.render(scene.to(torch.float32), view, **options)
    assert found.color.shape == (view.height, view.width, 3) and found.alpha.shape == (view.height, view.width)
    errors = torch.cat([found.color - expected.color, (found.alpha - expected.alpha)[..., None]], -1).abs().amax(-1)
    assert errors.max() < 2 / 255
    return torch.quantile(errors.flatten(), 0.999).item()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("frames", [False, True])
def test_image_agrees_for_every_degree(renderer: Renderer, degree: int, frames: bool) -> None:
    scene = splats(degree=degree, frames=frames)
    assert largest_difference(renderer, scene, camera(), background=BACKGROUND) < 1e-5


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), (31, 5), (100, 3), (65, 64)])
def test_image_agrees_for_every_size(renderer: Renderer, size: tuple[int, int]) -> None:
    width, height = size
    view = camera(width, height, focal=float(max(size)))
    assert largest_difference(renderer, splats(), view, background=BACKGROUND) < 1e-5


def test_active_degree_below_the_stored_one_ignores_the_rest(renderer: Renderer) -> None:
    scene = splats(degree=3).to(torch.float32)
    truncated = Splats(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh[:, :4].contiguous())
    found = renderer.render(scene, camera(), sh_degree=1).color
    torch.testing.assert_close(found, renderer.render(truncated, camera()).color, rtol=0, atol=1e-6)


def test_sh_frames_equal_rotated_coefficients(renderer: Renderer) -> None:
    scene = splats(frames=True)
    assert scene.sh_frames is not None
    rotated = Splats(
        scene.means, scene.quats, scene.scales, scene.opacities, harmonics.rotate(scene.sh, scene.sh_frames)
    )
    found = renderer.render(scene.to(torch.float32), camera()).color
    expected = renderer.render(rotated.to(torch.float32), camera()).color
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-5)


def test_other_constants_are_obeyed(renderer: Renderer) -> None:
    constants = RasterConstants(
        near=1.8, alpha_max=0.999, alpha_min=0.02, low_pass=1.5, transmittance_min=1e-2,
        frustum_margin=1.05, radius_sigmas=1.5, tile=8,
    )  # fmt: skip
    default = ORACLE.render(splats(), camera()).color
    changed = ORACLE.render(splats(), camera(), constants=constants).color
    assert (default - changed).abs().max() > 0.05
    assert largest_difference(renderer, splats(), camera(), constants=constants) < 1e-5


def test_the_tile_rectangle_cuts_an_opaque_gaussian(renderer: Renderer) -> None:
    """At 3 sigma an opaque Gaussian still has alpha 0.011; beyond its 16-px tiles it must have none."""
    view = camera(64, 64, focal=60.0)
    alpha = renderer.render(one(0.99, 0.12).to(torch.float32), view).alpha
    expected = ORACLE.render(one(0.99, 0.12), view).alpha
    cut = ((expected[:, :-1] - expected[:, 1:]).abs() > 1 / 255) & (
        (expected[:, :-1] == 0) | (expected[:, 1:] == 0)
    )
    assert cut.any(), "the scene has no edge cut by the rectangle"
    torch.testing.assert_close(alpha.double(), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("frames", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_agree(renderer: Renderer, degree: int, frames: bool) -> None:
    scene, view = splats(degree=degree, frames=frames), camera()
    expected_scene, expected_leaves = variables(scene)
    expected = gradients(ORACLE.render(expected_scene, view, background=BACKGROUND), expected_leaves)
    found_scene, leaves = variables(scene.to(torch.float32))
    found = gradients(renderer.render(found_scene, view, background=BACKGROUND), leaves)
    for ours, oracle in zip(found, expected, strict=True):
        assert ours.isfinite().all()
        if oracle.abs().max() == 0:  # sh_frames at degree 0
            assert ours.abs().max() == 0
            continue
        errors = relative_errors(ours, oracle)
        # single Gaussians may lie on a threshold in some pixel
        assert errors.median() < 2e-5 and torch.quantile(errors, 0.95) < 1e-3


def test_gradients_of_background_and_inactive_coefficients(renderer: Renderer) -> None:
    scene, leaves = variables(splats(degree=2).to(torch.float32))
    background = BACKGROUND.float().requires_grad_()
    rendering = renderer.render(scene, camera(), background=background, sh_degree=1)
    v_background, v_sh = torch.autograd.grad(rendering.color.sum(), [background, leaves[4]])
    torch.testing.assert_close(v_background, (1 - rendering.alpha).sum().expand(3), rtol=1e-4, atol=1e-3)
    assert v_sh[:, 4:].abs().max() == 0 and v_sh[:, :4].abs().max() > 0


def test_directional_derivatives_match_finite_differences(renderer: Renderer) -> None:
    """On a scene without thresholds: wide, faint Gaussians that cover every pixel of a small image."""
    scene = splats(12, degree=2, size=0.7, frames=True)
    scene = Splats(
        0.3 * scene.means, scene.quats, scene.scales.clamp(0.5, 1.5), 0.1 + 0.5 * scene.opacities,
        scene.sh, scene.sh_frames,
    )  # fmt: skip
    view = camera(12, 9, focal=30.0)
    dtype = torch.float64 if renderer.name == "reference" else torch.float32
    step, tolerance = (1e-6, 1e-6) if dtype == torch.float64 else (4e-3, 5e-3)

    def value(moved: Splats) -> torch.Tensor:
        rendering = renderer.render(moved, view)
        return (rendering.color.double().square()).sum() + rendering.alpha.double().cos().sum()

    moving, leaves = variables(scene.to(dtype))
    slopes = torch.autograd.grad(value(moving), leaves)
    for index, (leaf, slope) in enumerate(zip(leaves, slopes, strict=True)):
        direction = torch.randn(leaf.shape, generator=torch.Generator().manual_seed(index), dtype=torch.float64)
        direction = (direction * (leaf.abs().double() + 0.1)).to(dtype)
        ends = []
        for sign in (1, -1):
            values = [other.detach() for other in leaves]
            values[index] = values[index] + sign * step * direction
            ends.append(value(Splats(*values)))
        numeric, analytic = (ends[0] - ends[1]) / (2 * step), (slope * direction).double().sum()
        assert abs(numeric - analytic) < tolerance * max(1.0, abs(numeric)), f"field {index}"


def test_info_reports_radii_and_statistic(renderer: Renderer) -> None:
    scene = join(splats(80, degree=0), one(mean=(0, 0, -3)), one(mean=(9, 0, 0)), one(opacity=1e-3))
    view, reports = camera(), []
    for backend, dtype in ((ORACLE, torch.float64), (renderer, torch.float32)):
        info = RenderInfo()
        leaf_scene, leaves = variables(scene.to(dtype))
        gradients(backend.render(leaf_scene, view, background=BACKGROUND, info=info), leaves)
        reports.append(info)
    expected, found = reports
    assert found.radii is not None and expected.radii is not None
    assert torch.equal(found.radii, expected.radii)
    assert found.visible[-3:].tolist() == [False, False, True], "behind, off screen, faint but in view"
    assert found.mean2d_gradient is not None and expected.mean2d_gradient is not None
    errors = relative_errors(found.mean2d_gradient, expected.mean2d_gradient)
    assert errors.median() < 2e-5 and torch.quantile(errors, 0.95) < 1e-3


def test_statistic_leaves_the_alpha_loss_out(renderer: Renderer) -> None:
    statistics = []
    for alpha_weight in (0.0, 5.0):
        info = RenderInfo()
        scene, _ = variables(splats(60, degree=0).to(torch.float32))
        rendering = renderer.render(scene, camera(), background=BACKGROUND, info=info)
        (rendering.color.square().sum() + alpha_weight * rendering.alpha.square().sum()).backward()
        statistics.append(info.mean2d_gradient)
    torch.testing.assert_close(statistics[0], statistics[1], rtol=1e-4, atol=1e-4)


def test_info_before_rendering_says_so() -> None:
    with pytest.raises(ValueError, match="not been through"):
        _ = RenderInfo().visible


@pytest.mark.parametrize("case", ["none", "behind", "off screen", "transparent"])
def test_nothing_visible_shows_the_background(renderer: Renderer, case: str) -> None:
    scene = {
        "none": splats(0),
        "behind": join(*(one(mean=(0, 0, -z)) for z in (1.9, 2.0, 5.0))),
        "off screen": join(one(mean=(50, 0, 0)), one(mean=(0, -50, 0))),
        "transparent": one(opacity=1 / 256),
    }[case].to(torch.float32)
    leaf_scene, leaves = variables(scene)
    rendering = renderer.render(leaf_scene, camera(), background=BACKGROUND)
    assert torch.equal(rendering.color, BACKGROUND.float().expand(40, 48, 3))
    assert rendering.alpha.abs().max() == 0
    if rendering.color.requires_grad:
        for gradient in gradients(rendering, leaves):
            assert gradient.numel() == 0 or gradient.abs().max() == 0


def test_opacity_one_is_clamped_but_keeps_its_gradient(renderer: Renderer) -> None:
    scene, leaves = variables(one(opacity=1.0, size=0.3).to(torch.float32))
    rendering = renderer.render(scene, camera())
    assert rendering.alpha.max().item() == pytest.approx(0.99, abs=1e-6)
    (v_opacity,) = torch.autograd.grad(rendering.alpha.sum(), [leaves[3]])
    expected_scene, expected_leaves = variables(one(opacity=1.0, size=0.3))
    (expected,) = torch.autograd.grad(ORACLE.render(expected_scene, camera()).alpha.sum(), [expected_leaves[3]])
    torch.testing.assert_close(v_opacity.double(), expected, rtol=1e-5, atol=0)


def test_a_gaussian_larger_than_the_image_covers_it(renderer: Renderer) -> None:
    scene = join(one(0.9, 30.0), splats(degree=0))
    assert largest_difference(renderer, scene, camera(), background=BACKGROUND) < 1e-5


def test_a_needle_is_drawn_without_cancellation(renderer: Renderer) -> None:
    needle = one(0.9)
    needle = Splats(
        needle.means, torch.tensor([[0.9, 0.1, 0.2, 0.35]], dtype=torch.float64),
        torch.tensor([[2.0, 1e-4, 1e-4]], dtype=torch.float64), needle.opacities, needle.sh,
    )  # fmt: skip
    # 3e-4: float32 textbook conics lose four digits on a splat 1000 times longer than wide
    assert largest_difference(renderer, needle, camera(), background=BACKGROUND) < 3e-4


def test_equal_depths_are_drawn_in_input_order(renderer: Renderer) -> None:
    first, second = one(0.9), one(0.9)
    second = Splats(second.means, second.quats, second.scales, second.opacities, second.sh * 0)
    front = renderer.render(join(first, second).to(torch.float32), camera()).color.max()
    back = renderer.render(join(second, first).to(torch.float32), camera()).color.max()
    assert front > 0.9 and back < 0.65


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_gaussians_that_are_not_finite_are_not_drawn(renderer: Renderer, field: str, value: float) -> None:
    scene = splats(40, degree=1).to(torch.float32)
    clean = renderer.render(scene.map(lambda tensor: tensor[1:]), camera()).color
    broken = scene.map(torch.clone)
    getattr(broken, field)[0] = value
    leaf_scene, leaves = variables(broken)
    rendering = renderer.render(leaf_scene, camera())
    torch.testing.assert_close(rendering.color.detach(), clean, rtol=0, atol=0)
    for gradient in gradients(rendering, leaves):
        assert gradient.isfinite().all() and gradient[0].abs().max() == 0


def test_wrong_shapes_are_named(renderer: Renderer) -> None:
    scene = splats(5).to(torch.float32)
    with pytest.raises(ValueError, match=r"splats.opacities has shape \(4,\), expected \(5,\)"):
        renderer.render(Splats(scene.means, scene.quats, scene.scales, scene.opacities[1:], scene.sh), camera())
    with pytest.raises(ValueError, match="sh_degree is 4, expected 0 to 3"):
        renderer.render(scene, camera(), sh_degree=4)
    with pytest.raises(ValueError, match="7 coefficients"):
        renderer.render(Splats(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh[:, :7]), camera())


def test_without_gradients_the_image_is_the_same(renderer: Renderer) -> None:
    scene = splats().to(torch.float32)
    plain = renderer.render(scene, camera())
    tracked = renderer.render(variables(scene)[0], camera())
    assert not plain.color.requires_grad and tracked.color.requires_grad
    assert torch.equal(plain.color, tracked.color.detach()) and torch.equal(plain.alpha, tracked.alpha.detach())
