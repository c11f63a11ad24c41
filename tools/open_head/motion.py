"""How the head moves: skinning weights, jaw pivot, expression units, lids and pose correctives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, sparse

from open_head.makehuman import MakeHuman
from open_head.surface import Surface

NECK_SHARE = {"neck03": 0.8, "neck02": 0.5, "neck01": 0.2}
"""Share of our one neck joint in the weights of the rig's three; the root takes the rest."""
JAW, NECK = 2, 1
JAW_PITCH = 9 * 1 + 3 * 2 + 1
"""Pose feature R_jaw[2, 1] = sin(pitch), growing as the jaw opens."""
GAZE_PITCH_DEG, GAZE_YAW_DEG = 25.0, 30.0
"""Gaze that the units eyeLookDown/Up and In/Out stand for."""
SMOOTHING = 0.5
"""Share of the neighbours' mean in one pass of ``unfold``."""


@dataclass(frozen=True)
class Motion:
    """Everything but identity; lengths in metres."""

    skin_weights: np.ndarray
    jaw: np.ndarray
    """Pivot of the jaw in the template (3,)."""
    jaw_open_angle: float
    """Pitch that equals the unit jawOpen, rad."""
    expression_names: list[str]
    expression_basis: np.ndarray
    eyelid_basis: np.ndarray
    pose_features: list[int]
    pose_basis: np.ndarray


def make_motion(source: MakeHuman, surface: Surface, lid_pairs: tuple[np.ndarray, np.ndarray]) -> Motion:
    """All motion of the head.

    Args:
        source: the MakeHuman data.
        surface: the open head's topology.
        lid_pairs: per eye, weights (pairs, 2, v) of points of the upper and lower lid that meet in a blink.
    """
    dropped = ("jawOpen", "jawLeft", "jawRight", "eyeBlink", "eyeLook")
    names = [name for name in source.unit_names() if not name.startswith(dropped)]
    still = surface.is_part("eye_left", "eye_right")

    def unit(name: str) -> np.ndarray:
        moved = surface.delta(source.unit(name))
        moved[still] = 0.0
        return moved

    jaw_open = surface.delta(source.unit("jawOpen"))
    jaw, angle = _jaw_hinge(surface, jaw_open)
    turned = _pitched(surface.template, jaw, angle) - surface.template
    weights = _skin_weights(source, surface, jaw_open, turned)
    rest_of_opening = jaw_open - weights[:, JAW, None] * turned
    rest_of_opening[still] = 0.0
    features, basis = [JAW_PITCH], [rest_of_opening / np.sin(angle)]
    for joint, side, outwards in ((3, "Left", 1), (4, "Right", -1)):
        down, up, inward, outward = (unit(f"eyeLook{way}{side}") for way in ("Down", "Up", "In", "Out"))
        features += [9 * (joint - 1) + 3 * 2 + 1, 9 * (joint - 1) + 3 * 0 + 2]
        basis.append((down - up) / 2 / np.sin(np.radians(GAZE_PITCH_DEG)))
        basis.append(outwards * (outward - inward) / 2 / np.sin(np.radians(GAZE_YAW_DEG)))
    expression = np.stack([unit(name) for name in names], -1)
    lids = [unit(f"eyeBlink{side}") for side in ("Left", "Right")]
    return Motion(
        skin_weights=weights,
        jaw=jaw,
        jaw_open_angle=angle,
        expression_names=names,
        expression_basis=unfold(surface, expression, names),
        eyelid_basis=np.stack([_just_meet(surface, *pair) for pair in zip(lids, lid_pairs, strict=True)], -1),
        pose_features=features,
        pose_basis=np.stack(basis),
    )


def _pitched(points: np.ndarray, pivot: np.ndarray, angle: float) -> np.ndarray:
    """Points turned about the x axis through a pivot."""
    c, s = np.cos(angle), np.sin(angle)
    return (points - pivot) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T + pivot


def _jaw_hinge(surface: Surface, jaw_open: np.ndarray) -> tuple[np.ndarray, float]:
    """Pivot and angle that turn the lower teeth as the artist's jawOpen moves them, least squares."""
    teeth = surface.is_part("teeth_lower")
    closed, opened = surface.template[teeth], surface.template[teeth] + jaw_open[teeth]

    def misfit(guess: np.ndarray) -> np.ndarray:
        return (_pitched(closed, np.array([0, guess[0], guess[1]]), guess[2]) - opened).ravel() * 1e3

    found = optimize.least_squares(misfit, [0.0, 0.012, 0.35], x_scale=[0.01, 0.01, 0.1])
    return np.array([0, found.x[0], found.x[1]]), float(found.x[2])


def _skin_weights(source: MakeHuman, surface: Surface, jaw_open: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Weights (v, 5): neck and root from the rig, the jaw's share from what jawOpen does."""
    base = np.zeros((len(source.neutral), 3))
    rig = source.json("rigs/standard/rig.default.json")
    for bone, entries in source.json("rigs/standard/weights.default.json")["weights"].items():
        neck = _neck_share(rig, bone)
        for vertex, weight in entries:
            base[int(vertex), NECK] += neck * weight
            base[int(vertex), 0] += (1 - neck) * weight
    base /= np.maximum(base.sum(1, keepdims=True), 1e-9)
    weights = np.zeros((len(surface.part), 5))
    weights[:, :3] = surface.extend(base)
    # The rig's own jaw weights miss the artist's jawOpen by 3.3 mm rms; its projection on the turn misses by 1.3.
    share = (jaw_open * turned).sum(1) / np.maximum((turned**2).sum(1), 1e-6)
    weights[:, JAW] = np.minimum(np.clip(share, 0, 1), weights[:, NECK])
    weights[:, NECK] -= weights[:, JAW]
    for joint, parts in ((NECK, ("upper",)), (JAW, ("lower",)), (3, ("eye_left",)), (4, ("eye_right",))):
        names = [f"{tissue}_{parts[0]}" for tissue in ("teeth", "gums")] if joint < 3 else list(parts)
        weights[surface.is_part(*names)] = np.eye(5)[joint]
    return weights / weights.sum(1, keepdims=True)


def _neck_share(rig: dict, bone: str) -> float:
    """How much of a bone's weight belongs to our neck joint, which carries the skull."""
    if bone in NECK_SHARE:
        return NECK_SHARE[bone]
    ancestor = bone
    while ancestor:
        if ancestor == "head":
            return 1.0
        ancestor = rig[ancestor]["parent"]
    return 0.0


def _just_meet(surface: Surface, blink: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Blink scaled so that at 1 the lids just meet; the artist's overshoots by a third."""
    gap = np.mean([(upper - lower) @ surface.template[:, 1] for upper, lower in pairs])
    closing = np.mean([(upper - lower) @ blink[:, 1] for upper, lower in pairs])
    return blink * (-gap / closing)


def unfold(surface: Surface, basis: np.ndarray, names: list[str]) -> np.ndarray:
    """Units smoothed where the skin of both sides at full weight would fold over.

    A fold is a face whose normal turns by more than a right angle against a smoothed version of itself; its
    neighbourhood's displacements are replaced by their local mean until none is left. Lips and lids roll on
    purpose and are left alone.
    """
    skin = surface.is_part("skin")
    adjacency = surface.adjacency(skin)
    mean = sparse.diags(1 / np.maximum(np.asarray(adjacency.sum(1)).ravel(), 1)) @ adjacency
    smoothed = basis.copy()
    for index, name in enumerate(names):
        if not name.startswith("brow"):
            continue
        partner = _mirror_index(names, name)
        for _ in range(60):
            both = smoothed[..., index] + (smoothed[..., partner] if partner != index else 0)
            folded = _folded(surface, both)
            if not folded.any():
                break
            around = (adjacency @ folded.astype(float) > 0) | folded
            around = (adjacency @ around.astype(float) > 0) | around
            for unit in {index, partner}:
                field = smoothed[..., unit]
                field[around] += SMOOTHING * ((mean @ field) - field)[around]
    return smoothed


def _mirror_index(names: list[str], name: str) -> int:
    swapped = name.replace("Left", "#").replace("Right", "Left").replace("#", "Right")
    return names.index(swapped)


def _folded(surface: Surface, displacement: np.ndarray) -> np.ndarray:
    """Vertices of skin faces that the displacement turns or tilts by more than 60 degrees."""
    faces = surface.faces[surface.is_part("skin")[surface.faces].all(1)]
    before = _normals(surface.template, faces)
    after = _normals(surface.template + displacement, faces)
    bent = (before * after).sum(1) < 0.5
    mask = np.zeros(len(surface.part), dtype=bool)
    mask[faces[bent]] = True
    return mask


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
