"""The head model's function: linearity, skinning, loose points, precision, and FLAME's reference arrays."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toonifygb import head
from toonifygb.errors import InputError
from toonifygb.structures import HeadMotion


@pytest.fixture(scope="module")
def open_head() -> head.HeadModel:
    return head.load("open").to(torch.float64)


def still(model: head.HeadModel, *batch: int) -> HeadMotion:
    zeros = model.template.new_zeros
    return HeadMotion(zeros(*batch, model.n_expression), zeros(*batch, 5, 3), zeros(*batch, 3), zeros(*batch, 2))


def lively(model: head.HeadModel, *batch: int) -> HeadMotion:
    random = torch.Generator().manual_seed(7)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*batch, *shape, generator=random, dtype=model.template.dtype)

    turns = 0.4 * (draw(5, 3) - 0.5)
    return HeadMotion(0.5 * draw(model.n_expression), turns, draw(3), draw(2))


def test_neutral_is_the_template(open_head: head.HeadModel) -> None:
    shape = torch.zeros(open_head.n_shape, dtype=torch.float64)
    vertices, transforms = open_head.forward(shape, still(open_head))
    # Skinning weights sum to 1 within float32's 6e-8, on coordinates of 0.14 m.
    assert (vertices - open_head.template).abs().max() < 1e-8
    assert (transforms - torch.eye(4, dtype=torch.float64)).abs().max() < 1e-12


def test_rest_is_linear_in_each_coefficient(open_head: head.HeadModel) -> None:
    shape = torch.randn(open_head.n_shape, dtype=torch.float64)
    motion = lively(open_head)
    whole = open_head.rest(shape, motion.expression, motion.eyelids)
    zero = torch.zeros_like
    parts = [
        open_head.rest(shape),
        open_head.rest(zero(shape), motion.expression),
        open_head.rest(zero(shape), zero(motion.expression), motion.eyelids),
    ]
    assert (whole - (sum(parts) - 2 * open_head.template)).abs().max() < 1e-12


def test_root_turns_about_its_rest_position_and_translation_comes_last(open_head: head.HeadModel) -> None:
    motion = still(open_head)
    motion.joints[0, 1] = torch.pi / 2
    motion.translation[:] = torch.tensor([0.1, 0.2, 0.3])
    shape = torch.randn(open_head.n_shape, dtype=torch.float64)
    vertices, _ = open_head.forward(shape, motion)
    pivot = open_head.joints(shape)[0]
    rest = open_head.rest(shape) - pivot
    turned = torch.stack([rest[:, 2], rest[:, 1], -rest[:, 0]], -1) + pivot + motion.translation
    assert (vertices - turned).abs().max() < 1e-7  # weights sum to 1 within float32's 6e-8


@pytest.mark.parametrize("batch", [(3,), (2, 3)])
def test_batches_equal_single_calls(open_head: head.HeadModel, batch: tuple[int, ...]) -> None:
    model = open_head.subset(torch.arange(0, open_head.n_vertices, 97))
    motion = lively(model, *batch)
    shape = torch.randn(model.n_shape, dtype=torch.float64)
    vertices, transforms = model.forward(shape, motion)
    assert vertices.shape == (*batch, model.n_vertices, 3)
    assert transforms.shape == (*batch, 5, 4, 4)
    last = (-1,) * len(batch)
    single, _ = model.forward(shape, motion.map(lambda field: field[last]))
    assert (vertices[last] - single).abs().max() < 1e-12
    per_frame, _ = model.forward(shape.expand(*batch, -1), motion)
    assert (vertices - per_frame).abs().max() < 1e-12


def test_single_precision_agrees(open_head: head.HeadModel) -> None:
    model = head.load("open")
    motion = lively(open_head)
    shape = torch.randn(model.n_shape)
    exact, _ = open_head.forward(shape.double(), motion)
    rounded, _ = model.forward(shape, motion.to(torch.float32))
    # Positions reach 1 m, float32 resolves 1e-7 of that; sums of 130 terms lose a little more.
    assert (exact - rounded).abs().max() < 2e-6


def test_to_moves_masks_and_keeps_whole_numbers(open_head: head.HeadModel) -> None:
    assert open_head.regions["lips"].dtype == torch.float64
    for name in ("faces", "part", "landmark_faces", "landmark_mirror", "pose_features"):
        assert getattr(open_head, name).dtype == torch.int64
    assert open_head.to("cpu").template.dtype == torch.float64


def test_subset_moves_like_the_whole(open_head: head.HeadModel) -> None:
    ids = torch.randperm(open_head.n_vertices)[:500]
    shape = torch.randn(open_head.n_shape, dtype=torch.float64)
    motion = lively(open_head, 2)
    part, _ = open_head.subset(ids).forward(shape, motion)
    whole, _ = open_head.forward(shape, motion)
    assert (part - whole[:, ids]).abs().max() < 1e-12


def test_subset_keeps_whole_faces_only(open_head: head.HeadModel) -> None:
    skin = (open_head.part == 0).nonzero()[:, 0]
    model = open_head.subset(skin)
    expected = (open_head.part[open_head.faces] == 0).all(-1)
    assert torch.equal(skin[model.faces], open_head.faces[expected])
    assert model.uv is not None
    assert model.uv.shape[0] == model.faces.shape[0]


def test_points_are_the_barycentric_mix(open_head: head.HeadModel) -> None:
    face_ids = torch.randint(open_head.faces.shape[0], (300,))
    bary = torch.distributions.Dirichlet(torch.ones(3, dtype=torch.float64)).sample((300,))
    points = open_head.at(face_ids, bary)
    shape = torch.randn(open_head.n_shape, dtype=torch.float64)
    motion = lively(open_head)

    def mix(vertices: torch.Tensor) -> torch.Tensor:
        return (vertices[open_head.faces[face_ids]] * bary[..., None]).sum(-2)

    at_rest = points.rest(shape, motion.expression, motion.eyelids)
    assert (at_rest - mix(open_head.rest(shape, motion.expression, motion.eyelids))).abs().max() < 1e-12
    # Posed, weights and positions vary within a face; the product of both differences stays below this.
    posed, _ = points.forward(shape, motion)
    assert (posed - mix(open_head.forward(shape, motion)[0])).norm(dim=-1).max() < 3e-4
    assert points.faces.shape == (0, 3)
    assert points.landmark_faces.shape == (0,)


def test_landmarks_are_the_embedded_points(open_head: head.HeadModel) -> None:
    corners = open_head.template[open_head.faces[open_head.landmark_faces]]
    expected = (corners * open_head.landmark_bary[..., None]).sum(-2) + open_head.landmark_offset
    assert (open_head.landmarks().template - expected).abs().max() < 1e-12


def test_gradients_reach_shape_and_motion(open_head: head.HeadModel) -> None:
    model = open_head.landmarks().subset(torch.arange(0, 478, 60))
    shape = torch.randn(model.n_shape, dtype=torch.float64, requires_grad=True)
    motion = lively(model).map(lambda field: field.requires_grad_())
    inputs = (shape, motion.expression, motion.joints, motion.translation, motion.eyelids)

    def vertices(shape: torch.Tensor, *fields: torch.Tensor) -> torch.Tensor:
        return model.forward(shape, HeadMotion(*fields))[0]

    assert torch.autograd.gradcheck(vertices, inputs, fast_mode=True)


def test_unknown_model_is_named() -> None:
    with pytest.raises(InputError, match="no head model 'flame2042', known are open, flame, flame2023"):
        head.load("flame2042")


@pytest.mark.golden
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 2e-6)])
def test_flame_rig_matches_reference(golden_dir, dtype: torch.dtype, tolerance: float) -> None:
    """Arrays of an independent implementation of FLAME's function, checked against 3DGB's."""
    paths = sorted((golden_dir / "gaussian_blendshapes").glob("*_flame.npz"))
    assert paths, f"no *_flame.npz below {golden_dir}"
    for path in paths:
        arrays = np.load(path)
        given = {key: torch.from_numpy(arrays[key]) for key in arrays.files}
        given = {key: value.to(dtype) if value.is_floating_point() else value for key, value in given.items()}
        lids = torch.stack([given["m_l_eyelid"], given["m_r_eyelid"]], -1)
        model = head.from_arrays(
            given["m_v_template"],
            given["faces"],
            given["m_shapedirs"],
            given["m_exprdirs"],
            given["m_posedirs"],
            given["m_J_regressor"],
            given["m_weights"],
            eyelid_basis=lids,
        )
        zeros = given["eyelids"].new_zeros
        motion = HeadMotion(given["expr"], given["axis_angle"], zeros(3), zeros(2))
        vertices, transforms = model.forward(given["shape"], motion)
        # The reference adds the lids after skinning, in posed space.
        vertices = vertices + lids @ given["eyelids"]
        expected = {
            "out_vertices": vertices,
            "out_A": transforms,
            "out_joints": model.joints(given["shape"], given["expr"]),
            "out_v_shaped": model.rest(given["shape"], given["expr"]),
        }
        for key, found in expected.items():
            assert (found - given[key]).abs().max() < tolerance, key
