"""MediaPipe's attention mesh: 478 face landmarks in a square around a face."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb.face.crop import Square, as_batch, cut
from toonifygb.face.networks import load_network

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float

    from toonifygb.structures import Frame

N_LANDMARKS = 478
_N_MESH = 468
_EYE_CORNERS = (33, 263)
"""Outer corners of the subject's right and left eye."""


class FaceMesh:
    """The landmark network.

    Each output is 478 points: the mesh, of which lips and eye regions are replaced by the refined ones, and five
    points for each iris.
    """

    def __init__(self, device: str = "cpu") -> None:
        self._network = load_network("landmarks", device)
        self._device = device
        refined = [op["points"] for op in self._network.operators if op["op"] == "box_matrix"]
        irises = [list(range(_N_MESH, _N_MESH + 5)), list(range(_N_MESH + 5, N_LANDMARKS))]
        self._places = [*refined, *irises]

    def run(
        self, frames: Sequence[Frame], squares: Sequence[Square]
    ) -> tuple[Float[np.ndarray, "n 478 2"], Float[np.ndarray, " n"]]:
        """Landmarks (px of the frame) and face presence (0..1) in a square of each frame."""
        size = self._network.width
        cuts = [cut(frame, square, size) for frame, square in zip(frames, squares, strict=True)]
        mesh, *parts, flag = self._network(as_batch(cuts, self._device))
        points = np.empty((len(cuts), N_LANDMARKS, 2))
        points[:, :_N_MESH] = mesh.reshape(-1, _N_MESH, 3)[..., :2].cpu().numpy()
        for place, part in zip(self._places, parts, strict=True):
            points[:, place] = part.reshape(len(cuts), -1, 2).cpu().numpy()
        points = np.stack([square.to_image(p / size) for square, p in zip(squares, points, strict=True)])
        return points, torch.sigmoid(flag).reshape(-1).cpu().numpy()


def next_square(points: Float[np.ndarray, "478 2"]) -> Square:
    """Where to look in the next frame: 1.5 × the landmarks' box, turned so that the eye corners are level."""
    low, high = points.min(0), points.max(0)
    along = points[_EYE_CORNERS[1]] - points[_EYE_CORNERS[0]]
    x, y = (low + high) / 2
    return Square(float(x), float(y), 1.5 * float((high - low).max()), float(np.arctan2(along[1], along[0])))


def face_box(points: Float[np.ndarray, "478 2"]) -> Float[np.ndarray, " 4"]:
    """Left, top, right, bottom of the landmarks, px."""
    return np.concatenate([points.min(0), points.max(0)])
