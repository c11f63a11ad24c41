"""Pinhole cameras: projection, crops, and viewpoints turned about the head.

Pixels are continuous (the centre of the first pixel is at 0.5, 0.5), the camera frame is OpenCV's (x right, y
down, z forward), lengths are metres.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.geometry.skinning import affine
from toonifygb.structures import Camera

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor


def project(camera: Camera, points: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, " *b"]]:
    """Where world points appear, px, and how far in front of the camera they are, m.

    Points at or behind the camera (depth ≤ 0) get meaningless pixels; the caller decides by the depth.
    """
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    in_camera = points @ rotation.T + translation
    homogeneous = in_camera @ camera.K.T
    depth = in_camera[..., 2]
    return homogeneous[..., :2] / homogeneous[..., 2:], depth


def camera_centre(camera: Camera) -> Float[Tensor, " 3"]:
    """World position of the camera, m."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return -rotation.T @ translation


def tracked_camera(focal_px: float | Float[Tensor, ""], width: int, height: int) -> Camera:
    """Camera of a tracked clip: square pixels, principal point at the image's centre, OpenGL world axes.

    Args:
        focal_px: focal length, px; a tensor keeps its dtype, device and gradient.
        width: image width, px.
        height: image height, px.
    """
    focal = torch.as_tensor(focal_px, dtype=None if isinstance(focal_px, torch.Tensor) else torch.float32)
    zero, one = torch.zeros_like(focal), torch.ones_like(focal)
    entries = (focal, zero, one * (width / 2), zero, focal, one * (height / 2), zero, zero, one)
    axes = torch.diag(focal.new_tensor([1.0, -1.0, -1.0, 1.0]))
    return Camera(torch.stack(entries).reshape(3, 3), axes, width, height)


def crop_camera(
    camera: Camera, box: tuple[float, float, float, float] | Float[Tensor, " 4"], size: int | tuple[int, int]
) -> Camera:
    """Camera of the image cut to a box and resized.

    Args:
        camera: camera of the full image.
        box: left, top, right, bottom in px of the full image; may reach over its border.
        size: side of the square result, or its (width, height), px.
    """
    width, height = (size, size) if isinstance(size, int) else size
    left, top, right, bottom = (float(edge) for edge in box)
    scale_x, scale_y = width / (right - left), height / (bottom - top)
    to_crop = camera.K.new_tensor([[scale_x, 0, -left * scale_x], [0, scale_y, -top * scale_y], [0, 0, 1]])
    return replace(camera, K=to_crop @ camera.K, width=width, height=height)


def orbit(
    camera: Camera,
    pivot: Float[Tensor, " 3"],
    yaw: float | Float[Tensor, ""] = 0.0,
    pitch: float | Float[Tensor, ""] = 0.0,
) -> Camera:
    """Camera carried around a pivot, looking at it from elsewhere at the same distance.

    Args:
        camera: where to start.
        pivot: world point that keeps its place in the image, m.
        yaw: rad about the world's y axis; positive moves the viewpoint towards +x as seen from +z.
        pitch: rad about the camera's own horizontal axis, applied first; positive moves the viewpoint up.
    """
    frame = camera.world_to_camera
    yaw, pitch = (torch.as_tensor(angle).to(frame) for angle in (yaw, pitch))
    right, up = frame[0, :3], frame.new_tensor([0.0, 1.0, 0.0])
    carry = axis_angle_to_matrix(up * yaw) @ axis_angle_to_matrix(-right * pitch)
    pivot = pivot.to(frame)
    # World to camera undoes the carrying: x ↦ Rᵀ (x - pivot) + pivot, then the old camera.
    undo = affine(carry.T, pivot - carry.T @ pivot)
    return replace(camera, world_to_camera=frame @ undo)
