"""Identity: random people from MakeHuman's sliders, and the linear basis that explains them.

The basis comes in two blocks. The first is the principal components of the *face*, where landmarks are; everything
else follows by its regression on them, so that ears and skull take their most probable shape for the face at hand.
The second holds what the face does not tell about ears, skull and neck. A fit to landmarks leaves it at zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from open_head.makehuman import MakeHuman
    from open_head.surface import Surface

N_PEOPLE = 3000
N_HELD_OUT = 200
FACE_MODES = 72
OTHER_MODES = 20
SLIDERS = {
    "cheek": 0.28,
    "chin": 0.26,
    "ears": 0.16,
    "eyebrows": 0.25,
    "eyes": 0.22,
    "forehead": 0.24,
    "head": 0.16,
    "mouth": 0.22,
    "neck": 0.16,
    "nose": 0.24,
}
"""Standard deviation of the sliders of each group; a slider's range is -1..1."""
SIDE_NOISE = 0.15
"""Independent share of a slider's left and right; a person's two sides are nearly alike."""
SHIFTS = ("trans-in-out", "septum")
SHIFT_FACTOR = 0.35
"""Sliders that move a whole feature off the midline are rarer."""
HEAD_SHAPES = ("diamond", "invertedtriangular", "oval", "rectangular", "round", "square", "triangular")
ASYMMETRY = 0.12
"""Mean weight of the asymmetry targets."""


@dataclass(frozen=True)
class Identity:
    """Bases in metres per standard deviation, and how well they do."""

    shape_basis: np.ndarray
    joint_basis: np.ndarray
    held_out_mm: dict[str, float]


@dataclass(frozen=True)
class _Slider:
    group: str
    label: str
    sided: bool
    negative: np.ndarray
    positive: np.ndarray

    @property
    def shifts(self) -> bool:
        return not self.sided and any(word in self.label for word in SHIFTS)


class People:
    """Draws random people, reproducibly."""

    def __init__(self, source: MakeHuman, seed: int = 0) -> None:
        self._source = source
        self._random = np.random.default_rng(seed)
        self._sliders = list(_read_sliders(source))
        self._heads = [source.target(f"head/head-{name}") for name in HEAD_SHAPES]
        self._crooked = list(_read_asymmetries(source).values())

    def draw(self) -> np.ndarray:
        """Base mesh of one person, m."""
        random = self._random
        age = 1 + random.beta(1, 1.5) if random.random() < 0.85 else random.uniform(0.6, 1)
        base = self._source.person(
            gender=random.beta(0.7, 0.7),
            age=age,
            muscle=random.beta(2, 2),
            weight=float(np.clip(random.normal(0.5, 0.25), 0, 1)),
            race=tuple(random.dirichlet((0.6, 0.6, 0.6))),
        )
        common: dict[str, float] = {}
        for slider in self._sliders:
            spread = SLIDERS[slider.group]
            value = random.normal(0, spread)
            if slider.sided:
                value = 0.95 * common.setdefault(slider.label, value) + SIDE_NOISE * random.normal(0, spread)
            value = float(np.clip(value * (SHIFT_FACTOR if slider.shifts else 1), -1, 1))
            base += value * slider.positive if value > 0 else -value * slider.negative
        base += random.uniform(0, 0.4) * self._heads[random.integers(len(self._heads))]
        for family in self._crooked:
            base += random.exponential(ASYMMETRY) * family[random.integers(len(family))]
        return base


def make_identity(source: MakeHuman, surface: Surface, jaw: np.ndarray, regions: dict[str, np.ndarray]) -> Identity:
    """Basis of identity.

    Args:
        source: the MakeHuman data.
        surface: the open head's topology.
        jaw: pivot of the jaw in the template, m.
        regions: masks by name.
    """
    people = People(source)
    face, other = _importance(surface, regions)
    rest_joints = surface.joints(source.neutral)
    jaw_offset = jaw - rest_joints[2]
    n_vertices = len(surface.part)
    bodies = np.empty((N_PEOPLE, n_vertices + 5, 3), np.float32)
    for index in range(N_PEOPLE):
        base = people.draw()
        body = np.concatenate([surface.lift(base), surface.joints(base)])
        # The artist's jaw pivot is off; ours keeps the same distance from it in every head.
        body[n_vertices + 2] += jaw_offset
        bodies[index] = _aligned(body, surface.template, face + 0.1 * other)
    known, unseen = bodies[:-N_HELD_OUT], bodies[-N_HELD_OUT:]
    mean = known.mean(0)
    centred = (known - mean).reshape(len(known), -1)
    weights = [np.repeat(np.r_[weight, np.zeros(5)], 3).astype(np.float32) for weight in (face, other)]
    basis, scores = _modes(centred, weights[0], FACE_MODES)
    # What the face modes explain, anywhere, is taken out before the second block is formed.
    basis_other, _ = _modes(centred - scores @ basis, weights[1], OTHER_MODES)
    basis = np.concatenate([basis, basis_other]).reshape(-1, n_vertices + 5, 3)
    held_out = _held_out(unseen - mean, basis, {"face": face, "elsewhere": other})
    return Identity(
        shape_basis=np.moveaxis(basis[:, :n_vertices], 0, -1),
        joint_basis=np.moveaxis(basis[:, n_vertices:], 0, -1),
        held_out_mm=held_out,
    )


def _importance(surface: Surface, regions: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the vertices in the two blocks."""
    seen = np.maximum(regions["face"], np.maximum(regions["lips"], regions["eyelids"]))
    seen = seen * (1 - regions["inside_mouth"]) * (1 - regions["eye_cavity"])
    other = 0.5 * regions["ears"] + regions["scalp"] + 0.5 * regions["neck"]
    return seen, other * (1 - seen)


def _aligned(body: np.ndarray, reference: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Body moved, turned and scaled onto the template, weighted least squares over the vertices."""
    share = weight / weight.sum()
    points = body[: len(reference)]
    from_centre, to_centre = share @ points, share @ reference
    covariance = (reference - to_centre).T @ (share[:, None] * (points - from_centre))
    u, s, vt = np.linalg.svd(covariance)
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    turn = (u * sign) @ vt
    scale = (s * sign).sum() / (share @ ((points - from_centre) ** 2).sum(1))
    return scale * (body - from_centre) @ turn.T + to_centre


def _modes(centred: np.ndarray, weight: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Modes (count, values) with unit-variance scores (people, count), principal in the weighted norm.

    A mode is the covariance of every value with its score: outside the weighted region that is the regression.
    """
    people = len(centred)
    scaled = centred * np.sqrt(weight)
    variance, vectors = np.linalg.eigh((scaled @ scaled.T).astype(np.float64))
    del variance
    scores = vectors[:, ::-1][:, :count] * np.sqrt(people)
    modes = scores.T.astype(np.float32) @ centred / people
    # An eigenvector's sign is arbitrary; make the largest entry of each mode positive.
    flip = np.sign(np.take_along_axis(modes, np.abs(modes).argmax(1)[:, None], 1))
    return modes * flip, (scores * flip[:, 0]).astype(np.float32)


def _held_out(unseen: np.ndarray, basis: np.ndarray, weights: dict[str, np.ndarray]) -> dict[str, float]:
    """Mean vertex error of people who were not in the fit, mm: all coefficients, and landmarks' face alone."""
    errors = {}
    face, other = weights["face"] > 0.5, weights["elsewhere"] > 0.5
    for name, used in (("from the face", face), ("from the whole head", face | other)):
        system = basis[:, : len(used)][:, used].reshape(len(basis), -1).T
        ridge = np.concatenate([system, 0.5e-3 * np.sqrt(used.sum() / 478) * np.eye(len(basis))])
        wanted = unseen[:, : len(used)][:, used].reshape(len(unseen), -1).T
        found = np.linalg.lstsq(ridge, np.concatenate([wanted, np.zeros((len(basis), len(unseen)))]), rcond=None)[0]
        error = np.linalg.norm(np.einsum("kvc,kp->pvc", basis, found) - unseen, axis=-1) * 1000
        errors[f"face {name}"] = float(error[:, : len(used)][:, face].mean())
        errors[f"ears and skull {name}"] = float(error[:, : len(used)][:, other].mean())
    return errors


def _read_sliders(source: MakeHuman) -> Iterator[_Slider]:
    described = source.json("targets/target.json")
    for group in SLIDERS:
        for category in described[group]["categories"]:
            opposites = category.get("opposites")
            if not opposites:
                continue
            for side in ("left", "right", "unsided"):
                negative, positive = opposites[f"negative-{side}"], opposites[f"positive-{side}"]
                if negative and positive:
                    targets = (source.target(f"{group}/{name}") for name in (negative, positive))
                    yield _Slider(group, category["label"], side != "unsided", *targets)


def _read_asymmetries(source: MakeHuman) -> dict[str, list[np.ndarray]]:
    families: dict[str, list[np.ndarray]] = {}
    for path in sorted((source.data / "mpfb2" / "targets" / "asym").glob("asym-*.target.gz")):
        name = path.name.removesuffix(".target.gz")
        families.setdefault(name.rsplit("-", 1)[0], []).append(source.target(f"asym/{name}"))
    return families
