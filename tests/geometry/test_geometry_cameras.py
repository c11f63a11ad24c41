"""Cameras: where points appear, in crops and from other viewpoints."""

from __future__ import annotations

import math

import pytest
import torch

from toonifygb.geometry.cameras import camera_centre, crop_camera, orbit, project, tracked_camera
from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.geometry.skinning import affine
from toonifygb.structures import Camera


def random_camera() -> Camera:
    matrix = torch.tensor([[500.0, 2.0, 310.0], [0.0, 510.0, 260.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    rotation = axis_angle_to_matrix(torch.tensor([2.9, 0.2, -0.3], dtype=torch.float64))
    return Camera(matrix, affine(rotation, torch.tensor([0.1, -0.05, 1.2], dtype=torch.float64)), 640, 480)


def test_tracked_camera_looks_down_minus_z():
    camera = tracked_camera(600.0, 640, 480)
    points = torch.tensor([[0.0, 0.0, -0.5], [0.1, 0.0, -0.5], [0.0, 0.1, -0.5], [0.0, 0.0, 0.5]])
    pixels, depth = project(camera, points)
    torch.testing.assert_close(depth, torch.tensor([0.5, 0.5, 0.5, -0.5]))
    # World x is right, world y is up, pixel y is down; the middle of 640x480 is a corner of four pixels.
    torch.testing.assert_close(pixels[:3], torch.tensor([[320.0, 240.0], [440.0, 240.0], [320.0, 120.0]]))
    assert (camera_centre(camera) == 0).all()


def test_tracked_camera_keeps_the_focal_length_differentiable():
    focal = torch.tensor(500.0, dtype=torch.float64, requires_grad=True)
    camera = tracked_camera(focal, 100, 100)
    assert camera.K.dtype == camera.world_to_camera.dtype == torch.float64
    project(camera, torch.tensor([0.2, 0.0, -1.0], dtype=torch.float64))[0][0].backward()
    torch.testing.assert_close(focal.grad, torch.tensor(0.2, dtype=torch.float64))


def test_project_agrees_with_the_formula_one_point_at_a_time():
    camera, points = random_camera(), torch.randn(2, 7, 3, dtype=torch.float64) * 0.1
    pixels, depth = project(camera, points)
    assert pixels.shape == (2, 7, 2) and depth.shape == (2, 7)
    for i in range(2):
        for j in range(7):
            x, y, z = (camera.world_to_camera[:3] @ torch.cat((points[i, j], points.new_ones(1)))).tolist()
            assert depth[i, j] == pytest.approx(z)
            assert pixels[i, j].tolist() == pytest.approx([(500 * x + 2 * y) / z + 310, 510 * y / z + 260])


def test_camera_centre_is_where_depth_starts():
    camera = random_camera()
    place = torch.cat((camera_centre(camera), torch.ones(1, dtype=torch.float64)))
    torch.testing.assert_close((camera.world_to_camera @ place)[:3], torch.zeros(3, dtype=torch.float64))


@pytest.mark.parametrize(
    ("box", "size"), [((100.0, 50.0, 356.0, 306.0), 128), ((-20.5, 10.0, 619.5, 490.0), (320, 240))]
)
def test_crop_moves_and_scales_pixels(box: tuple[float, float, float, float], size: int | tuple[int, int]):
    camera, points = random_camera(), torch.randn(20, 3, dtype=torch.float64) * 0.1
    crop = crop_camera(camera, box, size)
    width, height = (size, size) if isinstance(size, int) else size
    assert (crop.width, crop.height) == (width, height)
    full, depth = project(camera, points)
    cut, cut_depth = project(crop, points)
    expected_x = (full[:, 0] - box[0]) * width / (box[2] - box[0])
    expected_y = (full[:, 1] - box[1]) * height / (box[3] - box[1])
    torch.testing.assert_close(cut, torch.stack((expected_x, expected_y), -1))
    torch.testing.assert_close(cut_depth, depth)


def test_crop_of_everything_is_the_camera_itself():
    camera = random_camera()
    crop = crop_camera(camera, torch.tensor([0.0, 0.0, 640.0, 480.0]), (640, 480))
    torch.testing.assert_close(crop.K, camera.K)


def test_orbit_keeps_the_pivot_in_place_and_distance():
    camera, pivot = random_camera(), torch.tensor([0.05, 0.02, -0.1], dtype=torch.float64)
    before, depth = project(camera, pivot)
    for yaw, pitch in ((0.4, 0.0), (0.0, 0.3), (-0.6, 0.25)):
        turned = orbit(camera, pivot, yaw, pitch)
        after, new_depth = project(turned, pivot)
        torch.testing.assert_close(after, before)
        torch.testing.assert_close(new_depth, depth)
        torch.testing.assert_close((camera_centre(turned) - pivot).norm(), (camera_centre(camera) - pivot).norm())


def test_orbit_directions():
    camera, pivot = tracked_camera(500.0, 100, 100), torch.tensor([0.0, 0.0, -1.0])
    assert orbit(camera, pivot).world_to_camera.equal(camera.world_to_camera)
    right = camera_centre(orbit(camera, pivot, yaw=math.pi / 2))
    torch.testing.assert_close(right, torch.tensor([1.0, 0.0, -1.0]), atol=1e-6, rtol=0)
    above = camera_centre(orbit(camera, pivot, pitch=math.pi / 4))
    torch.testing.assert_close(above, torch.tensor([0.0, 0.70710678, -0.29289322]), atol=1e-6, rtol=0)
    both = camera_centre(orbit(camera, pivot, math.pi / 2, math.pi / 4))
    torch.testing.assert_close(both, torch.tensor([0.70710678, 0.70710678, -1.0]), atol=1e-6, rtol=0)
