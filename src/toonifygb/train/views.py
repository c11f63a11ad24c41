"""A few training images through which new Gaussians look at the clip: inside the head's matte? what colour?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.cameras import camera_centre, project
from toonifygb.geometry.skinning import blend_transforms

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.head import HeadModel
    from toonifygb.structures import Camera, TrackedSequence
    from toonifygb.train.data import Dataset

N_VIEWS = 12
_FACING = 0.2
"""Least cosine between a normal and the direction to the camera for a colour to be taken."""
_POINTS_AT_ONCE = 256
_SOLID = 0.9
"""Least matte value for a colour to be taken: edges are mixed with the background."""


@dataclass(frozen=True)
class _View:
    color: Float[Tensor, "s s 3"]
    matte: Float[Tensor, "s s"]
    camera: Camera
    transforms: Float[Tensor, "5 4 4"]


class TrainingViews:
    """Views spread evenly over the training frames; ``toonifygb.avatar.Views`` is the protocol."""

    def __init__(
        self, dataset: Dataset, sequence: TrackedSequence, head: HeadModel, n_views: int = N_VIEWS
    ) -> None:
        train = dataset.split.train
        steps = torch.linspace(0, len(train) - 1, min(n_views, len(train))).round().long().tolist()
        self._views = [_look(dataset, sequence, head, train[step]) for step in steps]

    def matte_share(self, points: Float[Tensor, "n 3"], skin_weights: Float[Tensor, "n 5"]) -> Float[Tensor, " n"]:
        """Share of the views in which each rest-pose point falls inside the matte; pixels outside tell nothing."""
        inside, seen = torch.zeros(len(points)), torch.zeros(len(points))
        for view in self._views:
            pixels, visible = _pixels(view, points, skin_weights)
            value = _sample(view.matte[..., None], pixels)[:, 0]
            inside += (value > 0.5) & visible
            seen += visible
        return torch.where(seen > 0, inside / seen.clamp_min(1), 0.0)

    def colors(
        self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], skin_weights: Float[Tensor, "n 5"]
    ) -> Float[Tensor, "n 3"]:
        """Mean colour where a point faces the camera, weighted by how squarely; elsewhere that of the nearest such
        point of this or, mirrored, the other side of the head; grey where no point faces any camera.
        """
        total, weight = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
        for view in self._views:
            pixels, visible = _pixels(view, points, skin_weights)
            blended = blend_transforms(skin_weights, view.transforms)
            posed = torch.einsum("nab,nb->na", blended[:, :3, :3], points) + blended[:, :3, 3]
            turned = torch.einsum("nab,nb->na", blended[:, :3, :3], normals)
            towards = torch.nn.functional.normalize(camera_centre(view.camera) - posed, dim=-1)
            facing = (turned * towards).sum(-1)
            solid = _sample(view.matte[..., None], pixels)[:, 0] > _SOLID
            share = torch.where(visible & solid & (facing > _FACING), facing.square(), 0.0)[:, None]
            total += share * _sample(view.color, pixels)
            weight += share
        seen = weight[:, 0] > 0
        colors = torch.where(seen[:, None], total / weight.clamp_min(1e-6), 0.5)
        if bool(seen.any()):
            colors[~seen] = _nearest_colors(points[~seen], points[seen], colors[seen])
        return colors


def _nearest_colors(
    points: Float[Tensor, "n 3"], known: Float[Tensor, "k 3"], colors: Float[Tensor, "k 3"]
) -> Float[Tensor, "n 3"]:
    """Colour of the nearest known point; the known ones count on both sides of the head's plane of symmetry."""
    mirrored = known * known.new_tensor([-1.0, 1.0, 1.0])
    both = torch.cat([known, mirrored])
    nearest = [torch.cdist(part, both).argmin(1) for part in points.split(_POINTS_AT_ONCE)]
    return colors.repeat(2, 1)[torch.cat(nearest)] if nearest else points


def _look(dataset: Dataset, sequence: TrackedSequence, head: HeadModel, index: int) -> _View:
    motion = sequence.motion[index]
    _, transforms = head.forward(sequence.shape, motion)
    transforms = transforms.clone()
    transforms[:, :3, 3] += motion.translation
    color, matte = dataset.target(index)
    return _View(color, matte, dataset.camera(index), transforms)


def _pixels(view: _View, points: Tensor, skin_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Where rest-pose points appear, px, and whether that is inside the image."""
    blended = blend_transforms(skin_weights, view.transforms)
    posed = torch.einsum("nab,nb->na", blended[:, :3, :3], points) + blended[:, :3, 3]
    pixels, depth = project(view.camera, posed)
    size = view.matte.shape[0]
    return pixels, (pixels >= 0).all(-1) & (pixels < size).all(-1) & (depth > 0)


def _sample(image: Float[Tensor, "s s c"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Bilinear values at continuous pixel positions; the border's outside."""
    grid = (2 * pixels / image.shape[0] - 1)[None, :, None]
    found = torch.nn.functional.grid_sample(
        image.movedim(-1, 0)[None], grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return found[0, :, :, 0].T
