"""Where the tracked head is in the image: boxes around head and face, and the region a head matte may fill.

The region is made from the head itself: its surface, blown up where hair grows, is projected, and a pixel belongs
to the region if it lies inside every one of the half-planes that touch the projection. So it turns, tilts and
scales with the head, and holds the hair above and beside it and the neck below it. Where the neck ends is kept
apart, because it must move with the body exactly as the avatar's does, whose track may be refined later.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from toonifygb.geometry import cameras
from toonifygb.geometry.rotations import axis_angle_to_matrix
from toonifygb.head import ROOT
from toonifygb.structures import TensorRecord

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
NECK_ROOM = 0.03
"""How far the region reaches below the cut, m, so that a refined track may move it."""
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


@dataclass(frozen=True)
class NeckCuts(TensorRecord):
    """Where the neck ends in every frame: beyond n·x = reach, softly; px of the full image."""

    normal: Float[Tensor, "t 2"]
    """Unit, downwards along the body."""
    reach: Float[Tensor, " t"]
    softness: Float[Tensor, " t"]
    """Length over which the neck fades out."""

    def rows(self, index: int, height: int, width: int) -> tuple[int, Float[Tensor, "r w"]]:
        """First row of an image that a cut touches, and the soft mask 0..1 of that and all further rows."""
        normal, reach, softness = self.normal[index], self.reach[index], self.softness[index]
        corners = torch.tensor([[0.0, 0.0], [width, 0.0]]) @ normal
        first = ((reach - corners) / normal[1]).min() if normal[1] > 0 else reach.new_zeros(())
        first = int(first.floor().clamp(0, height))
        y, x = torch.arange(first, height) + 0.5, torch.arange(width) + 0.5
        beyond = ((x * normal[0])[None] + (y * normal[1] - reach)[:, None]).div_(softness).clamp_(0, 1)
        return first, 1 - beyond.square() * (3 - 2 * beyond)

    def within(self, boxes: Float[Tensor, "t 4"], size: int) -> NeckCuts:
        """The same cuts in square crops (left, top, right, bottom, px) resized to ``size`` px."""
        scale = size / (boxes[:, 2] - boxes[:, 0])
        reach = self.reach - (self.normal * boxes[:, :2]).sum(-1)
        return NeckCuts(self.normal, scale * reach, scale * self.softness)


def neck_cuts(sequence: TrackedSequence, head: HeadModel) -> NeckCuts:
    """Where the neck ends: a little below the chin of the straight head, square to the body.

    A nod bends the neck and does not move the collar.

    Args:
        sequence: the tracked clip.
        head: the model it was tracked with.
    """
    outline, ring = _surroundings(head)
    parts = []
    for start in range(0, sequence.n_frames, BATCH):
        motion = sequence.motion[start : start + BATCH]
        world, _ = outline.forward(sequence.shape, motion)
        end = world[:, ring].mean(1)
        body = axis_angle_to_matrix(motion.joints[:, ROOT])
        points = torch.stack([world.mean(1), end, end - NECK_LENGTH * body[..., 1]], 1)
        middle, neck, below = cameras.project(sequence.camera, points)[0].unbind(1)
        normal = torch.nn.functional.normalize(below - neck, dim=-1)
        softness = NECK_SOFTNESS * 2 * (middle - neck).norm(dim=-1)
        parts.append(torch.cat([normal, (normal * neck).sum(-1, keepdim=True), softness[:, None]], -1))
    found = torch.cat(parts)
    return NeckCuts(found[:, :2].contiguous(), found[:, 2].contiguous(), found[:, 3].contiguous())


class HeadRegion:
    """Where head, hair and neck may be in any frame of a clip, with some room below the neck's end (``NeckCuts``).

    Args:
        sequence: the tracked clip.
        head: the model it was tracked with.
    """

    def __init__(self, sequence: TrackedSequence, head: HeadModel) -> None:
        self._sequence = sequence
        self._outline, _ = _surroundings(head)
        angles = torch.arange(N_DIRECTIONS, dtype=torch.float32) * (2 * torch.pi / N_DIRECTIONS)
        self._normals = torch.stack([angles.cos(), angles.sin()], -1)

    def __call__(self, index: int) -> Float[Tensor, "h w"]:
        """Soft mask 0..1 of frame ``index``."""
        sequence = self._sequence
        world, _ = self._outline.forward(sequence.shape, sequence.motion[index])
        pixels, _ = cameras.project(sequence.camera, world)
        reach = pixels @ self._normals.T
        softness = EDGE_SOFTNESS * (pixels.amax(0) - pixels.amin(0)).max()
        return _inside(self._normals, reach.amax(0), softness, sequence.camera.height, sequence.camera.width)


def _inside(
    normals: Float[Tensor, "k 2"],
    reach: Float[Tensor, " k"],
    softness: Float[Tensor, ""],
    height: int,
    width: int,
) -> Float[Tensor, "h w"]:
    """1 inside all half-planes n·x ≤ reach, falling to 0 over the softness outside them."""
    scale = max(1.0, max(height, width) / GRID)
    rows, columns = max(round(height / scale), 1), max(round(width / scale), 1)
    y = (torch.arange(rows) + 0.5) * (height / rows)
    x = (torch.arange(columns) + 0.5) * (width / columns)
    beyond = torch.zeros(rows, columns)
    for normal, limit in zip(normals, reach, strict=True):
        torch.maximum(beyond, (x * normal[0])[None] + (y * normal[1] - limit)[:, None], out=beyond)
    beyond.div_(softness).clamp_(max=1)
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
    """Skin with room for hair, down to below the neck's end, as points that move like the head; the end's ring."""
    skin = head.subset((head.part == 0).nonzero()[:, 0])
    chin, brow = _landmark(head, CHIN), _landmark(head, BROW)
    points = skin.template
    cut = torch.maximum(chin[1] - NECK_LENGTH, points[:, 1].amin())
    kept = (points[:, 1] > cut - NECK_ROOM).nonzero()[:, 0][::EVERY]
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
    return replace(skin, template=template), (points[:, 1] - cut).abs() < NECK_BAND
