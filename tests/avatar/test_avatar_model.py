"""The avatar's laws: linear blending, identity skinning, the mesh it hangs on, and its first state."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from make import TINY, tiny_avatar, tiny_head, tiny_motion

from toonifygb.avatar import POSE_DRIVERS, MouthVolume, Poser, init_avatar
from toonifygb.avatar.fields import each
from toonifygb.avatar.init import nearest_squared
from toonifygb.avatar.skinning import activate, blend_parameters, concatenate, skin_splats
from toonifygb.avatar.transfer import consistency, mix_vertices
from toonifygb.structures import GaussianParams, HeadMotion

SHAPE = torch.tensor([0.5, -0.5, 0.2])


def flatten(params: GaussianParams) -> torch.Tensor:
    return torch.cat([tensor.flatten() for _, tensor in each(params)])


def still(n_expressions: int = 4) -> HeadMotion:
    return HeadMotion(torch.zeros(n_expressions), torch.zeros(5, 3), torch.zeros(3), torch.zeros(2))


def test_blending_is_linear_in_psi() -> None:
    avatar = tiny_avatar().to(torch.float64)
    a, b = torch.rand(2, len(avatar.blendshape_names), dtype=torch.float64)
    base = flatten(avatar.neutral)
    blended = [
        flatten(blend_parameters(avatar.neutral, avatar.deltas, psi)) - base for psi in (a, b, 2 * a - 3 * b)
    ]
    assert (2 * blended[0] - 3 * blended[1] - blended[2]).abs().max() < 1e-12
    assert torch.equal(flatten(blend_parameters(avatar.neutral, avatar.deltas, 0 * a)), base)


def test_resting_avatar_is_its_neutral() -> None:
    avatar = replace(tiny_avatar(), drivers=None)
    avatar = replace(
        avatar,
        blendshape_names=avatar.blendshape_names[:6],
        deltas=avatar.deltas.map(lambda delta: delta[:6]),
    )
    splats = avatar.pose(still())
    expected = concatenate([activate(p) for p in (avatar.neutral, avatar.mouth_upper, avatar.mouth_lower)])
    assert (splats.means - expected.means).abs().max() < 1e-6
    assert (splats.quats - expected.quats).abs().max() < 1e-6
    assert torch.equal(splats.opacities, expected.opacities)
    assert splats.sh_frames is not None
    assert (splats.sh_frames - torch.eye(3)).abs().max() < 1e-6


def test_identity_skinning_changes_nothing() -> None:
    splats = activate(tiny_avatar().neutral)
    same = skin_splats(splats, torch.eye(4).expand(len(splats.means), 4, 4))
    assert (same.means - splats.means).abs().max() < 1e-7
    assert (same.quats - splats.quats).abs().max() < 1e-6


def test_turned_sh_and_turned_frames_mean_the_same() -> None:
    from toonifygb.geometry.harmonics import color

    avatar = tiny_avatar(sh_degree=2).to(torch.float64)
    splats = activate(avatar.neutral)
    transforms = avatar.transforms(tiny_motion()[3].to(torch.float64))[2].expand(avatar.neutral.n, 4, 4)
    by_frames = skin_splats(splats, transforms)
    by_coefficients = skin_splats(splats, transforms, rotate_sh=True)
    directions = torch.nn.functional.normalize(torch.randn(avatar.neutral.n, 3, dtype=torch.float64), dim=-1)
    assert by_frames.sh_frames is not None
    turned = torch.einsum("nba,nb->na", by_frames.sh_frames, directions)
    difference = color(by_frames.sh, turned, 2) - color(by_coefficients.sh, directions, 2)
    assert difference.abs().max() < 1e-12


def test_untrained_gaussians_ride_on_the_mesh() -> None:
    """Every face Gaussian follows the point of the surface it was sampled on, through expression, lids and pose."""
    head = tiny_head()
    avatar = init_avatar(head, SHAPE, TINY)
    motion = tiny_motion()[5]
    vertices, _ = head.forward(SHAPE, motion)
    posed = avatar.pose(motion).means[: avatar.neutral.n]
    distance = torch.cdist(posed, _dense_surface(vertices, head.faces)).amin(1)
    assert distance.max() < 2e-3, "the densely sampled surface has points every 2 mm"
    still_head, _ = head.forward(SHAPE, still())
    unmoved = avatar.pose(still()).means[: avatar.neutral.n]
    assert torch.cdist(unmoved, _dense_surface(still_head, head.faces)).amin(1).max() < 2e-3


def _dense_surface(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    steps = [(i / 12, j / 12, (12 - i - j) / 12) for i in range(13) for j in range(13 - i)]
    return torch.einsum("fkc,sk->fsc", vertices[faces], torch.tensor(steps)).reshape(-1, 3)


def test_mouth_sets_are_bound_to_skull_and_jaw() -> None:
    avatar = tiny_avatar()
    motion = replace(still(), joints=torch.tensor([[0.0] * 3, [0.0] * 3, [0.4, 0, 0], [0.0] * 3, [0.0] * 3]))
    n, upper = avatar.neutral.n, avatar.mouth_upper.n
    posed = avatar.pose(motion).means
    assert (posed[n : n + upper] - avatar.mouth_upper.means).abs().max() < 1e-6
    assert (posed[n + upper :] - avatar.mouth_lower.means).norm(dim=-1).min() > 0.005


def test_first_state_follows_the_rules() -> None:
    avatar = init_avatar(tiny_head(), SHAPE, TINY, motion=tiny_motion())
    assert avatar.neutral.n == TINY.n_gaussians
    assert avatar.mouth_upper.n + avatar.mouth_lower.n == TINY.n_mouth_gaussians
    assert (avatar.neutral.opacity_logits.sigmoid() - 0.1).abs().max() < 1e-6
    assert avatar.blendshape_names == (
        "smile",
        "frown",
        "browUp",
        "pucker",
        "eyelid_left",
        "eyelid_right",
        *POSE_DRIVERS,
    )
    assert avatar.deltas.means.shape[0] == len(avatar.blendshape_names)
    moved = avatar.deltas.means.norm(dim=-1).amax(0) > 2.4e-5
    n_moved = avatar.meta["n_moved"]
    assert 0 < n_moved < avatar.neutral.n
    assert not moved[n_moved:].any(), "Gaussians that expressions move must come first"
    assert (avatar.skin_weights.sum(-1) - 1).abs().max() < 1e-6


def test_same_seed_same_avatar() -> None:
    first, second = (init_avatar(tiny_head(), SHAPE, TINY) for _ in range(2))
    assert torch.equal(flatten(first.neutral), flatten(second.neutral))
    other = init_avatar(tiny_head(), SHAPE, replace(TINY, seed=1))
    assert not torch.equal(first.neutral.means, other.neutral.means)


def test_fewer_bases_keep_the_first_expressions() -> None:
    avatar = init_avatar(tiny_head(), SHAPE, replace(TINY, n_bases=2))
    assert avatar.blendshape_names == ("smile", "frown", "eyelid_left", "eyelid_right")
    motion = tiny_motion()[2]
    assert avatar.coefficients(motion).tolist() == [*motion.expression[:2].tolist(), *motion.eyelids.tolist()]


class FullHat:
    """Views that see hair everywhere and paint everything red."""

    def matte_share(self, points: torch.Tensor, skin_weights: torch.Tensor) -> torch.Tensor:
        return torch.ones(len(points))

    def colors(self, points: torch.Tensor, normals: torch.Tensor, skin_weights: torch.Tensor) -> torch.Tensor:
        return torch.tensor([1.0, 0.0, 0.0]).expand(len(points), 3)


def test_hair_stands_off_the_scalp() -> None:
    head = tiny_head()
    bald, hairy = init_avatar(head, SHAPE, TINY), init_avatar(head, SHAPE, TINY, views=FullHat())
    surface = _dense_surface(head.rest(SHAPE), head.faces)
    distance = [torch.cdist(avatar.neutral.means, surface).amin(1) for avatar in (bald, hairy)]
    assert (distance[0] > 0.004).sum() == 0
    assert (distance[1] > 0.004).float().mean() > 0.15
    assert (hairy.neutral.sh[:, 0, 0] > 1).all() and (hairy.neutral.sh[:, 0, 1] < -1).all()


def test_pose_drivers_keep_their_range() -> None:
    avatar = tiny_avatar()
    assert avatar.drivers is not None
    seen = avatar.drivers.coefficients(tiny_motion())
    assert seen.mean(0).abs().max() < 1e-4
    far = tiny_motion()[0]
    far = replace(far, joints=far.joints + 1.0, translation=far.translation + 1.0)
    assert (avatar.drivers.coefficients(far) <= seen.amax(0) + 1e-5).all()


def test_cylinder_distance_and_penalty() -> None:
    volume = MouthVolume(torch.tensor([0.0, 1.0, 0.0]), radius=2.0, half_height=1.0)
    points = torch.tensor([[0.0, 1.0, 0.0], [3.0, 1.0, 0.0], [0.0, 4.0, 0.0], [5.0, 6.0, 0.0]])
    assert torch.allclose(volume.distance(points), torch.tensor([-1.0, 1.0, 2.0, 5.0]))
    assert torch.allclose(volume.penalty(points), torch.tensor([0.0, 1.0, 4.0, 25.0]))
    inside = torch.tensor([[0.0, 1.2, 0.0]], requires_grad=True)
    volume.penalty(inside).sum().backward()
    assert inside.grad is not None and (inside.grad == 0).all()
    around = MouthVolume.around(points)
    assert (around.distance(points) < 0).all()


def test_head_without_teeth_gets_arches() -> None:
    head = tiny_head()
    toothless = replace(head, part=torch.zeros_like(head.part))
    avatar = init_avatar(toothless, SHAPE, TINY)
    assert avatar.mouth_upper.means[:, 1].min() >= avatar.mouth_lower.means[:, 1].max() - 1e-6
    lips = head.rest(SHAPE)[head.regions["lips"] > 0.5]
    assert avatar.mouth_upper.means[:, 2].max() < lips[:, 2].max()


def test_nearest_squared_distance() -> None:
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0], [50.0, 0, 0]])
    assert nearest_squared(points)[0] == (1 + 4 + 9) / 3
    assert nearest_squared(points[:1]).tolist() == [0.0]


def test_corner_mixes_differ_from_barycentric_as_said() -> None:
    values = torch.tensor([[1.0], [2.0], [6.0]])
    faces, ids, weights = torch.tensor([[0, 1, 2]]), torch.tensor([0]), torch.tensor([[1.0, 0.0, 0.0]])
    assert mix_vertices(values, faces, ids, weights).item() == 1.0
    assert mix_vertices(values, faces, ids, weights, "corner_sum").item() == 9.0
    assert mix_vertices(values, faces, ids, weights, "corner_mean").item() == 3.0


def test_consistency_is_zero_where_the_surface_rests() -> None:
    moved = torch.tensor([[0.0, 0.0, 0.0], [2e-5, 0.0, 0.0], [0.0, 0.005703532602638, 0.0], [0.0, 0.0, 0.02]])
    scale = consistency(moved)
    assert scale[0] == 0
    assert scale[1] == 0
    assert abs(scale[2] - 1) < 1e-6
    assert scale[3] > 3


@pytest.mark.parametrize(("half", "tolerance"), [(False, 2e-6), (True, 5e-3)])
def test_poser_equals_the_definition(half: bool, tolerance: float) -> None:
    avatar = tiny_avatar()
    poser = Poser(avatar, half=half)
    for index in (0, 7):
        fast, slow = poser(tiny_motion()[index]), avatar.pose(tiny_motion()[index])
        for name in ("means", "scales", "opacities", "sh", "sh_frames"):
            # bfloat16 keeps 8 bits of the deltas, of which the largest here are SH of about 0.1.
            assert (getattr(fast, name) - getattr(slow, name)).abs().max() < tolerance, name
