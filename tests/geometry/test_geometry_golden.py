"""Agreement with the reference implementation's arrays: rig, initial deltas, SH rotation, rigid fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from toonifygb.geometry import align, harmonics, meshes, rotations, skinning
from toonifygb.geometry.cameras import project
from toonifygb.structures import Camera

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.golden
CASES = [(torch.float64, 1e-9), (torch.float32, 2e-6)]
"""Tolerances stated with the arrays."""
PARENTS = (-1, 0, 1, 1, 1)


def arrays(folder: Path, suffix: str, dtype: torch.dtype) -> list[dict[str, torch.Tensor]]:
    files = sorted((folder / "gaussian_blendshapes").glob(f"*_{suffix}.npz"))
    if not files:
        pytest.skip(f"no *_{suffix}.npz in {folder / 'gaussian_blendshapes'}")
    found = []
    for file in files:
        tensors = {key: torch.from_numpy(np.asarray(value)) for key, value in np.load(file).items()}
        found.append({key: t.to(dtype) if t.is_floating_point() else t.long() for key, t in tensors.items()})
    return found


@pytest.mark.parametrize(("dtype", "atol"), CASES)
def test_rig(golden_dir: Path, dtype: torch.dtype, atol: float):
    for g in arrays(golden_dir, "flame", dtype):
        matrices = rotations.axis_angle_to_matrix(g["axis_angle"])
        torch.testing.assert_close(matrices, g["rot_mats"], atol=atol, rtol=0)
        torch.testing.assert_close(rotations.rotation_6d_to_matrix(g["rot6d"]), g["rot_mats"], atol=atol, rtol=0)
        feature = skinning.pose_feature(matrices)
        torch.testing.assert_close(feature, g["pose_feature"], atol=atol, rtol=0)

        joints = g["m_J_regressor"] @ g["out_v_shaped"]
        transforms = skinning.joint_transforms(matrices, joints, PARENTS)
        torch.testing.assert_close(transforms, g["out_A"], atol=atol, rtol=0)
        rest = g["out_v_shaped"] + torch.einsum("f,fvc->vc", feature, g["m_posedirs"])
        vertices = skinning.skin(rest, g["m_weights"], transforms)
        lids = g["eyelids"][0] * g["m_l_eyelid"] + g["eyelids"][1] * g["m_r_eyelid"]
        torch.testing.assert_close(vertices + lids, g["out_vertices"], atol=atol, rtol=0)


@pytest.mark.parametrize(("dtype", "atol"), CASES)
def test_initial_deltas(golden_dir: Path, dtype: torch.dtype, atol: float):
    for g in arrays(golden_dir, "init", dtype):
        displacement = g["v_expr"] - g["v_neutral"]
        means = meshes.barycentric(displacement, g["faces"], g["face_id"], g["bary"])
        torch.testing.assert_close(means.permute(1, 2, 0), g["out_init_xyz"], atol=atol, rtol=0)

        gradient = meshes.deformation_gradient(g["v_neutral"], g["v_expr"], g["faces"])
        turn = rotations.matrix_to_quat(rotations.polar_factor(gradient))[:, g["face_id"]]
        one = turn.new_tensor([1.0, 0, 0, 0])
        quats = rotations.quat_multiply(turn - one, g["q0"].expand_as(turn))
        torch.testing.assert_close(quats.permute(1, 2, 0), g["out_init_rot"], atol=atol, rtol=0)


@pytest.mark.parametrize(("dtype", "atol"), CASES)
def test_skinning_of_gaussians(golden_dir: Path, dtype: torch.dtype, atol: float):
    for g in arrays(golden_dir, "skin", dtype):
        matrices = harmonics.rotation_matrices(g["sh_rot_example_R"], 3)
        torch.testing.assert_close(matrices, g["sh_rot_example_D"], atol=atol, rtol=0)

        rest = g["blend_xyz"] + torch.einsum("f,fpc->pc", g["pose_feature"], g["posedirs_g"])
        posed = skinning.skin(rest, g["weights"], g["A"]) + g["eyelid_g"] @ g["eyelids"]
        torch.testing.assert_close(posed, g["out_xyz"], atol=atol, rtol=0)
        linear = skinning.blend_transforms(g["weights"], g["A"])[:, :3, :3]
        turn = rotations.polar_factor(linear)
        torch.testing.assert_close(turn, g["out_R"], atol=atol, rtol=0)
        quats = rotations.quat_multiply(rotations.matrix_to_quat(turn), g["blend_rot"])
        torch.testing.assert_close(quats, g["out_rot"], atol=atol, rtol=0)
        torch.testing.assert_close(harmonics.rotate(g["blend_sh"], turn), g["out_sh"], atol=2 * atol, rtol=0)

        rotation, shift = align.kabsch(g["back_neutral"], g["back_posed"])
        torch.testing.assert_close(skinning.affine(rotation, shift), g["M_up"], atol=2 * atol, rtol=0)


@pytest.mark.parametrize(("dtype", "atol"), CASES)
def test_projection_and_colour(golden_dir: Path, dtype: torch.dtype, atol: float):
    for g in arrays(golden_dir, "render", dtype):
        zero, one = torch.zeros((), dtype=dtype), torch.ones((), dtype=dtype)
        matrix = torch.stack((g["cam_fx"], zero, g["cam_cx"], zero, g["cam_fy"], g["cam_cy"], zero, zero, one))
        pose = skinning.affine(g["cam_R"], g["cam_t"])
        camera = Camera(matrix.reshape(3, 3), pose, int(g["cam_W"]), int(g["cam_H"]))
        pixels, depth = project(camera, g["in_xyz"])
        seen = g["p_valid"].bool()
        # The arrays count pixels from the first one's centre, the house from its corner.
        torch.testing.assert_close(pixels[seen] - 0.5, g["p_mean2d"][seen], atol=200 * atol, rtol=0)
        torch.testing.assert_close(depth, g["p_depth"], atol=atol, rtol=0)

        ray = g["in_xyz"] + g["cam_R"].T @ g["cam_t"]
        colour = harmonics.color(g["in_sh"], ray / ray.norm(dim=-1, keepdim=True), 3)
        torch.testing.assert_close(colour[seen], g["p_color"][seen], atol=2 * atol, rtol=0)
