"""MediaPipe's 478 landmarks on the open head's surface.

``landmarks.csv`` names, for each of the 468 points of the face mesh, three vertices of MakeHuman's base mesh and
their weights, as measured by ``tools/fit_landmark_embedding.py``. The ten iris points follow from the eyeballs.

The committed table comes from 200 renders of this head before its lips were sealed, seen by MediaPipe 0.10.21's own
runtime of the same network. Twelve renders of the present head through the tool agree with it to 1.0 mm (median;
lips and eyes 0.5 to 0.6 mm), which is what so few renders can tell.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from open_head.surface import Surface

TABLE = Path(__file__).parent / "landmarks.csv"
OFFSETS = Path(__file__).parent / "landmark_offsets.csv"
"""How far beside their surface points the landmarks are detected, by ``tools/fit_landmark_offsets.py``."""
IRIS = ((468, "eye_right"), (473, "eye_left"))
"""Number of each pupil; the next four are the rim of its iris at +x, +y, -x, -y."""
IRIS_SIGMA_MM = 0.8
"""Median wander of the iris points, measured with the others."""
IRIS_MIRROR = {468: 473, 469: 476, 470: 475, 471: 474, 472: 477}
LID_PAIRS = (((386, 374), (385, 380), (387, 373)), ((159, 145), (158, 153), (160, 144)))
"""Landmarks of the upper and lower lid that meet in a blink, left and right eye."""
BROWS = ((276, 283, 282, 295, 285, 300, 293, 334, 296, 336), (46, 53, 52, 65, 55, 70, 63, 105, 66, 107))
"""Landmarks of the left and right brow: the lower edge from outside in, then the upper edge."""


def load_offsets() -> np.ndarray:
    """Constant offset of each landmark from its surface point, head axes, m (478, 3); irises have none."""
    offsets = np.zeros((478, 3))
    with OFFSETS.open(newline="") as file:
        for row in csv.DictReader(file):
            offsets[int(row["landmark"])] = [float(row[f"{axis}_mm"]) / 1000 for axis in "xyz"]
    return offsets


@dataclass(frozen=True)
class Embedding:
    """Face, barycentric coordinates, wander (m) and mirror of each landmark."""

    faces: np.ndarray
    bary: np.ndarray
    sigma: np.ndarray
    mirror: np.ndarray

    def weights(self, surface: Surface, landmark: int) -> np.ndarray:
        """One landmark as weights of all vertices (v,)."""
        row = np.zeros(len(surface.part))
        row[surface.faces[self.faces[landmark]]] = self.bary[landmark]
        return row

    def positions(self, surface: Surface, vertices: np.ndarray) -> np.ndarray:
        """Landmarks on given vertices, m (478, 3)."""
        return np.einsum("lk,lkc->lc", self.bary, vertices[surface.faces[self.faces]])


def load_embedding(surface: Surface) -> Embedding:
    """The committed table on this surface's faces."""
    face_of = {tuple(sorted(face)): number for number, face in enumerate(surface.faces.tolist())}
    faces, bary, sigma, mirror = np.zeros(478, int), np.zeros((478, 3)), np.zeros(478), np.zeros(478, int)
    with TABLE.open(newline="") as file:
        for row in csv.DictReader(file):
            landmark = int(row["landmark"])
            weight = {int(surface.number[int(row[f"vertex_{k}"])]): float(row[f"weight_{k}"]) for k in "abc"}
            faces[landmark] = face_of[tuple(sorted(weight))]
            bary[landmark] = [weight[vertex] for vertex in surface.faces[faces[landmark]].tolist()]
            sigma[landmark] = float(row["sigma_mm"]) / 1000
            mirror[landmark] = int(row["mirror"])
    for pupil, part in IRIS:
        _place_iris(surface, pupil, part, faces, bary)
    sigma[468:] = IRIS_SIGMA_MM / 1000
    for right, left in IRIS_MIRROR.items():
        mirror[right], mirror[left] = left, right
    return Embedding(faces, bary / bary.sum(1, keepdims=True), sigma, mirror)


def lid_pairs(surface: Surface, embedding: Embedding) -> tuple[np.ndarray, np.ndarray]:
    """Points of the lids that meet in a blink, as weights of vertices (pairs, 2, v), left and right eye."""
    left, right = (
        np.array([[embedding.weights(surface, landmark) for landmark in pair] for pair in pairs])
        for pairs in LID_PAIRS
    )
    return left, right


def _place_iris(surface: Surface, pupil: int, part: str, faces: np.ndarray, bary: np.ndarray) -> None:
    """Pupil at the front pole, the other four where the limbus is extreme."""
    ids = np.flatnonzero(surface.is_part(part))
    rim = ids[surface.ball.ring == surface.ball.limbus]
    x, y = surface.template[rim, 0], surface.template[rim, 1]
    chosen = [ids[surface.ball.ring == 0][0], rim[x.argmax()], rim[y.argmax()], rim[x.argmin()], rim[y.argmin()]]
    for step, vertex in enumerate(chosen):
        face = int(np.flatnonzero((surface.faces == vertex).any(1))[0])
        faces[pupil + step] = face
        bary[pupil + step] = surface.faces[face] == vertex
