"""Where the tracked head is in the image: boxes around head and face, and the region a head matte may fill.

The region is made from the head itself: its surface, blown up where hair grows, is projected, and a pixel belongs
to the region if it lies inside every one of the half-planes that touch the projection. So it turns, tilts and
scales with the head, holds the hair above and beside it and the neck below it, and ends above the shoulders.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from toonifygb.geometry import cameras
from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.structures import TensorRecord
from toonifygb.track.model import ROOT

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from toonifygb.head import HeadModel
    from toonifygb.structures import TrackedSequence

CHIN, BROW = 152, 9
"""Landmarks at the tip of the chin and between the eyebrows."""
HAIR_UP, HAIR_OUT, FACE_OUT = 0.35, 0.30, 0.06
"""How far hair may reach beyond the bare head, as shares of its radius: at the crown, at back and sides, and in
front of the face (beards, glasses, noses the fit missed)."""
NECK_OUT = 0.10
"""Widening of the neck about its axis, as a share."""
NECK_LENGTH = 0.04
"""How much neck below the tip of the chin belongs to the head, m: about what a shirt leaves free."""
NECK_BAND = 0.01
"""Half height of the ring of vertices that stands for the cut, m."""
EVERY = 3
"""Of so many vertices one is used: they bound the same region to a fraction of a pixel."""
NECK_SOFTNESS = 0.06
"""Length over which the region fades out at the neck's lower end, as a share of the head's height."""
EDGE_SOFTNESS = 0.03
"""The same for all other edges."""
N_DIRECTIONS = 48
"""Half-planes that bound the region."""
GRID = 256
"""Longer side of the grid the region is computed on, px: it is smooth, so it is interpolated from there."""
BATCH = 32
"""Frames whose surfaces are held at once."""


@dataclass(frozen=True)
class Boxes(TensorRecord):
    """Boxes of each frame as left, top, right, bottom, px of the full image; they may reach over its border."""

    head: Float[Tensor, "t 4"]
    """The bare head down to the chin, without hair and neck."""
    face: Float[Tensor, "t 4"]
    """The landmarks as the fit explains them."""


def head_boxes(sequence: TrackedSequence, head: HeadModel) -> Boxes:
    """Projected boxes of head and face in every frame, bridged ones included.

    Args:
        sequence: the tracked clip.
        head: the model it was tracked with.
    """
    skull = head.subset(_above_chin(head).nonzero()[:, 0])
    face = head.landmarks()
    return Boxes(_boxes(sequence, skull), _boxes(sequence, face))


def head_region(sequence: TrackedSequence, index: int, head: HeadModel) -> Float[Tensor, "h w"]:
    """Soft mask 0..1 of where one frame's head, hair and neck may be; for many frames keep a ``HeadRegion``.

    Args:
        sequence: the tracked clip.
        index: frame number.
        head: the model it was tracked with.
    """
    return HeadRegion(sequence, head)(index)


class HeadRegion:
    """The head's region in any frame of a clip.

    Args:
        sequence: the tracked clip.
        head: the model it was tracked with.
    """

    def __init__(self, sequence: TrackedSequence, head: HeadModel) -> None:
        self._sequence = sequence
        self._outline, self._cut = _surroundings(head)
        angles = torch.arange(N_DIRECTIONS, dtype=torch.float32) * (2 * torch.pi / N_DIRECTIONS)
        self._normals = torch.stack([angles.cos(), angles.sin()], -1)

    def __call__(self, index: int) -> Float[Tensor, "h w"]:
        """Soft mask 0..1 of frame ``index``."""
        sequence = self._sequence
        motion = sequence.motion[index]
        world, _ = self._outline.forward(sequence.shape, motion)
        pixels, _ = cameras.project(sequence.camera, world)
        ring = world[self._cut].mean(0)
        body = axis_angle_to_matrix(motion.joints[ROOT])
        neck, below = cameras.project(sequence.camera, torch.stack([ring, ring - NECK_LENGTH * body[:, 1]]))[0]
        height = 2 * (pixels.mean(0) - neck).norm()
        reach = (pixels @ self._normals.T).amax(0)
        # The last half-plane cuts through the neck, square to the body: a nod bends the neck, not the collar.
        down = torch.nn.functional.normalize(below - neck, dim=0)
        normals = torch.cat([self._normals, down[None]])
        reach = torch.cat([reach, (neck @ down)[None]])
        softness = height * torch.tensor([EDGE_SOFTNESS] * N_DIRECTIONS + [NECK_SOFTNESS])
        return _inside(normals, reach, softness, sequence.camera.height, sequence.camera.width)


def _inside(
    normals: Float[Tensor, "k 2"],
    reach: Float[Tensor, " k"],
    softness: Float[Tensor, " k"],
    height: int,
    width: int,
) -> Float[Tensor, "h w"]:
    """1 inside all half-planes n·x ≤ reach, falling to 0 over each one's softness outside it."""
    scale = max(1.0, max(height, width) / GRID)
    rows, columns = max(round(height / scale), 1), max(round(width / scale), 1)
    y = (torch.arange(rows) + 0.5) * (height / rows)
    x = (torch.arange(columns) + 0.5) * (width / columns)
    beyond = torch.zeros(rows, columns)
    for normal, limit, soft in zip(normals, reach, softness, strict=True):
        plane = (x * normal[0])[None] + (y * normal[1] - limit)[:, None]
        torch.maximum(beyond, plane.div_(soft), out=beyond)
    beyond.clamp_(max=1)
    mask = 1 - beyond.square() * (3 - 2 * beyond)
    shape = (height, width)
    return torch.nn.functional.interpolate(mask[None, None], shape, mode="bilinear", align_corners=False)[0, 0]


def _boxes(sequence: TrackedSequence, points: HeadModel) -> Float[Tensor, "t 4"]:
    boxes = []
    for start in range(0, sequence.n_frames, BATCH):
        world, _ = points.forward(sequence.shape, sequence.motion[start : start + BATCH])
        pixels, _ = cameras.project(sequence.camera, world)
        boxes.append(torch.cat([pixels.amin(1), pixels.amax(1)], -1))
    return torch.cat(boxes)


def _landmark(head: HeadModel, number: int) -> Float[Tensor, " 3"]:
    """Rest position of a landmark, m."""
    corners = head.faces[head.landmark_faces[number]]
    return head.landmark_bary[number] @ head.template[corners]


def _above_chin(head: HeadModel) -> Tensor:
    """Vertices of the skin above the lower edge of the chin."""
    return (head.part == 0) & (head.template[:, 1] > _landmark(head, CHIN)[1])


def _surroundings(head: HeadModel) -> tuple[HeadModel, Bool[Tensor, " v"]]:
    """Skin down to the cut, with room for hair, as points that move like the head; and which lie at the cut."""
    skin = head.subset((head.part == 0).nonzero()[:, 0])
    chin, brow = _landmark(head, CHIN), _landmark(head, BROW)
    points = skin.template
    cut = torch.maximum(chin[1] - NECK_LENGTH, points[:, 1].amin())
    kept = (points[:, 1] > cut - NECK_BAND).nonzero()[:, 0][::EVERY]
    skin = skin.subset(kept)
    points = skin.template
    above_chin = points[:, 1] > chin[1]
    centre = points[above_chin].mean(0)
    top, back, front = points[:, 1].amax(), points[:, 2].amin(), brow[2]
    up = ((points[:, 1] - brow[1]) / (top - brow[1])).clamp(0, 1)
    backward = ((front - points[:, 2]) / (front - back)).mul(2).clamp(0, 1)
    growth = torch.maximum(FACE_OUT + (HAIR_OUT - FACE_OUT) * backward, HAIR_UP * up)
    hair = points + growth[:, None] * (points - centre)
    axis = points[~above_chin].mean(0)
    level = points.new_tensor([1.0, 0.0, 1.0])  # the neck widens but does not lengthen
    neck = points + NECK_OUT * (points - axis) * level
    template = torch.where(above_chin[:, None], hair, neck)
    return replace(skin, template=template), points[:, 1] < cut + NECK_BAND
