"""Where the solvers start: a head pose from one affine fit, and the frames an identity is learned from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.track.energy import N_FACE, Observation
from toonifygb.track.model import POSITION, LandmarkModel, PoseState

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor


def initial_poses(model: LandmarkModel, observation: Observation, log_focal: Float[Tensor, ""]) -> PoseState:
    """Neutral heads whose weak-perspective projection fits the landmarks in the least-squares sense."""
    points = model.template[:N_FACE] - model.pivot
    middle = points.mean(0)
    flipped = points.new_tensor([1.0, -1.0])  # image y points down, world y up
    pixels = (observation.points[:, :N_FACE] - observation.centre) * flipped
    pixel_middle = pixels.mean(1, keepdim=True)
    n = pixels.shape[0]
    affine = torch.linalg.lstsq((points - middle).expand(n, -1, -1), pixels - pixel_middle).solution.mT
    # The nearest scaled pair of orthonormal rows to the 2x3 affine map.
    left, singular, right = torch.linalg.svd(affine, full_matrices=False)
    rows = left @ right
    rotation = torch.cat([rows, torch.linalg.cross(rows[:, 0], rows[:, 1])[:, None]], 1)
    distance = log_focal.exp() / singular.mean(-1)
    across = pixel_middle[:, 0] * (distance / log_focal.exp())[:, None]
    place = torch.cat([across, -distance[:, None]], -1) - middle @ rotation.mT
    values = model.template.new_zeros((n, model.n_values))
    values[:, POSITION] = place
    return PoseState(rotation, values)


def diverse_frames(points: Float[Tensor, "t l 2"], count: int) -> Int[Tensor, " k"]:
    """Numbers of up to ``count`` frames that differ most in head turn and expression, ascending.

    Farthest-point sampling on landmarks freed of position, size and roll, from the most ordinary frame on.
    """
    n = points.shape[0]
    if n <= count:
        return torch.arange(n, device=points.device)
    # Long clips are thinned first: neighbours in time hardly differ, and the search is quadratic.
    candidates = torch.linspace(0, n - 1, min(n, 16 * count), device=points.device).round().long().unique()
    shapes = upright(points[candidates]).flatten(1)
    chosen = [int((shapes - shapes.median(0).values).square().sum(-1).argmin())]
    nearest = (shapes - shapes[chosen[0]]).square().sum(-1)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (shapes - shapes[chosen[-1]]).square().sum(-1))
    return candidates[torch.tensor(chosen, device=points.device).sort().values]


RIGHT_EYE, LEFT_EYE = 33, 263
"""Outer corners of the subject's eyes."""


def face_size(points: Float[Tensor, "t l 2"]) -> Float[Tensor, " t"]:
    """Longer side of the landmarks' box, px."""
    return (points.amax(1) - points.amin(1)).amax(-1)


def upright(points: Float[Tensor, "t l 2"]) -> Float[Tensor, "t l 2"]:
    """Landmarks about their centre, in units of the face's size, with the eyes level."""
    centred = (points - points.mean(1, keepdim=True)) / face_size(points)[:, None, None]
    axis = torch.nn.functional.normalize(centred[:, LEFT_EYE] - centred[:, RIGHT_EYE], dim=-1)
    level = torch.stack([axis, torch.stack([-axis[:, 1], axis[:, 0]], -1)], 1)
    return centred @ level.mT
