"""What the drawn styles know of the face: steadied landmarks, its size, and soft masks that ride on them.

Landmark numbers are MediaPipe's 478-point scheme; "left" and "right" are the subject's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.stylize.filters import blur

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from toonifygb.structures import Landmarks

    Points = Float[np.ndarray, "n 2"]
    Plane = Float[np.ndarray, "h w"]

N_POINTS = 478
OVAL = (10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377, 152, 148, 176, 149)
OVAL += (150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109)
LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
MOUTH = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191)
LIP_LINE = (78, 191, 80, 81, 82, 13, 312, 311, 310, 415, 308)
CHEEKS = (50, 280)
JAW_LINE = (132, 58, 172, 136, 150, 149, 176, 148, 152, 377, 400, 378, 379, 365, 397, 288, 361)
NOSE_BASE = (129, 98, 97, 2, 326, 327, 358)
"""Below the nostrils, from wing to wing."""


@dataclass(frozen=True)
class Eye:
    """Landmark numbers of one eye, lids from the outer to the inner corner."""

    upper: tuple[int, ...]
    lower: tuple[int, ...]
    iris: int
    rim: tuple[int, ...]
    brow: tuple[int, ...]


EYES = (
    Eye(
        upper=(33, 246, 161, 160, 159, 158, 157, 173, 133),
        lower=(33, 7, 163, 144, 145, 153, 154, 155, 133),
        iris=468,
        rim=(469, 470, 471, 472),
        brow=(70, 63, 105, 66, 107, 55, 65, 52, 53, 46),
    ),
    Eye(
        upper=(263, 466, 388, 387, 386, 385, 384, 398, 362),
        lower=(263, 249, 390, 373, 374, 380, 381, 382, 362),
        iris=473,
        rim=(474, 475, 476, 477),
        brow=(300, 293, 334, 296, 336, 285, 295, 282, 283, 276),
    ),
)
FADE_FRAMES = 6
"""Frames over which face-bound effects come and go beside a span in which the face was not found."""


@dataclass(frozen=True)
class Faces:
    """The followed face through (part of) a clip, as the styles see it."""

    points: Float[np.ndarray, "t 478 2"]
    """px; steadied in time and bridged over frames without a face, so always finite."""
    presence: Float[np.ndarray, " t"]
    """0..1: how far face-bound effects apply; 0 without a face, fading beside such spans."""

    def __len__(self) -> int:
        return len(self.presence)

    def __getitem__(self, frames: slice | list[int]) -> Faces:
        return Faces(self.points[frames], self.presence[frames])


def no_faces(n_frames: int) -> Faces:
    """``n_frames`` frames in which no face was found."""
    return Faces(np.zeros((n_frames, N_POINTS, 2), np.float32), np.zeros(n_frames, np.float32))


def follow(landmarks: Landmarks) -> Faces:
    """Landmarks of a whole clip made fit to anchor drawing: bridged, steadied, with presence."""
    points = landmarks.points.detach().cpu().numpy().astype(np.float64)
    valid = np.asarray(np.isfinite(points).all((1, 2)))
    if not valid.any():
        return no_faces(len(points))
    points = _steady(_bridge(points, valid))
    return Faces(points.astype(np.float32), _presence(valid))


def _bridge(points: Float[np.ndarray, "t n 2"], valid: Bool[np.ndarray, " t"]) -> Float[np.ndarray, "t n 2"]:
    """Missing frames filled by straight motion between the neighbours found."""
    found = np.flatnonzero(valid)
    frames = np.arange(len(points))
    after = found[np.minimum(np.searchsorted(found, frames), len(found) - 1)]
    before = found[np.maximum(np.searchsorted(found, frames, side="right") - 1, 0)]
    share = (frames - before) / np.maximum(after - before, 1)
    return points[before] + (points[after] - points[before]) * share[:, None, None]


def _steady(points: Float[np.ndarray, "t n 2"], window: int = 4, sigma_frames: float = 2.0) -> np.ndarray:
    """Jitter removed by a symmetric window that lets real motion pass.

    A bilateral mean over time: neighbours count less the further they are in time and the further the landmark has
    moved, with 1.2 % of the face width as the size of jitter. So still faces hold still and blinks stay quick.
    """
    reach = 0.012 * np.median(face_widths(points))
    total, weights = points.copy(), np.ones(points.shape[:2])
    for shift in range(1, min(window, len(points) - 1) + 1):
        near = float(np.exp(-0.5 * (shift / sigma_frames) ** 2))
        step = points[shift:] - points[:-shift]
        weight = near * np.exp(-0.5 * (step**2).sum(-1) / max(reach, 1e-6) ** 2)
        total[:-shift] += weight[..., None] * points[shift:]
        total[shift:] += weight[..., None] * points[:-shift]
        weights[:-shift] += weight
        weights[shift:] += weight
    return total / weights[..., None]


def _presence(valid: Bool[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    lost = np.flatnonzero(~valid)
    if len(lost) == 0:
        return np.ones(len(valid), np.float32)
    frames = np.arange(len(valid))
    place = np.searchsorted(lost, frames)
    after = np.abs(lost[np.minimum(place, len(lost) - 1)] - frames)
    before = np.abs(frames - lost[np.maximum(place - 1, 0)])
    distance = np.minimum(before, after)
    share = np.minimum(distance / FADE_FRAMES, 1.0)
    return (share * share * (3.0 - 2.0 * share)).astype(np.float32)


def face_widths(points: Float[np.ndarray, "t 478 2"]) -> Float[np.ndarray, " t"]:
    """Width in px the face would have seen from the front: from the area of its outline, which turning the head
    changes least.
    """
    outline = points[:, OVAL]
    following = np.roll(outline, -1, axis=1)
    cross = outline[..., 0] * following[..., 1] - outline[..., 1] * following[..., 0]
    area = 0.5 * np.abs(cross.sum(1))
    return np.sqrt(area * 0.9)


def box_around(points: Points, margin_px: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of the picture that hold ``points`` with a margin; empty when they lie outside."""
    low = np.floor(points.min(0) - margin_px).astype(int)
    high = np.ceil(points.max(0) + margin_px).astype(int)
    left, top = np.clip(low, 0, [shape[1], shape[0]])
    right, bottom = np.clip(high, 0, [shape[1], shape[0]])
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def is_empty(box: tuple[slice, slice]) -> bool:
    """Whether the box holds no pixel."""
    return box[0].start >= box[0].stop or box[1].start >= box[1].stop


def in_box(points: Points, box: tuple[slice, slice]) -> Points:
    """Positions counted from the corner of the box."""
    return points - np.array([box[1].start, box[0].start], points.dtype)


def mask(shape: tuple[int, int], shapes: list[Points], feather_px: float, line_px: float = 0.0) -> Plane:
    """Soft mask of polygons, or of open lines, given in px.

    Args:
        shape: height and width.
        shapes: corners of each; drawn with sub-pixel precision.
        feather_px: standard deviation of the blur that softens them.
        line_px: width of the lines; 0 fills the shapes as polygons.
    """
    plane = np.zeros(shape, np.float32)
    # beyond three standard deviations and half a line the mask is 0; blurring the box alone saves most of the work
    box = box_around(np.concatenate(shapes), 3.0 * feather_px + line_px + 2.0, shape)
    if is_empty(box):
        return plane
    drawn = np.zeros((box[0].stop - box[0].start, box[1].stop - box[1].start), np.uint8)
    for corners in shapes:
        draw(drawn, in_box(corners, box), line_px)
    plane[box] = blur(drawn.astype(np.float32) * np.float32(1 / 255), feather_px)
    return plane


def draw(plane: np.ndarray, corners: Points, line_px: float = 0.0, shift: int = 4) -> None:
    """Draws an anti-aliased polygon, or an open line of some width, given in px into a uint8 plane."""
    fixed = np.rint((corners - 0.5) * (1 << shift)).astype(np.int32)  # cv2 counts from pixel centres
    if line_px > 0:
        cv2.polylines(plane, [fixed], False, 255, max(1, round(line_px)), cv2.LINE_AA, shift)
    else:
        cv2.fillPoly(plane, [fixed], 255, cv2.LINE_AA, shift)


def outline_of_eye(points: Points, eye: Eye) -> Points:
    """Closed outline of the eye opening."""
    return np.concatenate([points[list(eye.upper)], points[list(eye.lower[-2:0:-1])]])


def spot(shape: tuple[int, int], centre: Points, radius_px: float) -> Plane:
    """A round bump, 1 at the centre and gone at about twice the radius."""
    y = np.exp(-0.5 * ((np.arange(shape[0], dtype=np.float32) + 0.5 - centre[1]) / radius_px) ** 2)
    x = np.exp(-0.5 * ((np.arange(shape[1], dtype=np.float32) + 0.5 - centre[0]) / radius_px) ** 2)
    return (y[:, None] * x[None]).astype(np.float32)


def face_mask(shape: tuple[int, int], points: Points, feather_px: float) -> Plane:
    """Soft mask of the face outline, from hair line to chin."""
    return mask(shape, [points[list(OVAL)]], feather_px)


NO_FACE_UNIT = 0.35
"""Assumed face width in a clip without faces, in shorter sides of the picture."""


def face_unit(samples: np.ndarray, faces: Faces) -> float:
    """Face width in px that radii and line widths of the clip follow; one number, so lines never breathe."""
    seen = faces.presence > 0
    if not seen.any():
        return NO_FACE_UNIT * min(samples.shape[1:3])
    return max(float(np.median(face_widths(faces.points[seen]))), 4.0)


def skin_pixels(labs: list[np.ndarray], faces: Faces) -> Float[np.ndarray, "n 3"]:
    """Lab colours of the face without eyes and mouth, every third pixel; empty when no face was sampled."""
    found = [np.zeros((0, 3), np.float32)]
    for lab, points, presence in zip(labs, faces.points, faces.presence, strict=True):
        if presence == 0:
            continue
        shape = lab.shape[:2]
        holes = [outline_of_eye(points, eye) for eye in EYES] + [points[list(LIPS)]]
        holes += [points[list(eye.brow)] for eye in EYES]
        inside = mask(shape, [points[list(OVAL)]], 0.0) * (1.0 - mask(shape, holes, 0.0))
        found.append(lab[inside > 0.5][::3])
    return np.concatenate(found)


def feature_mask(shape: tuple[int, int], points: Points, unit: float) -> Plane:
    """Soft mask of eyes, brows and mouth, which must stay readable under any simplification."""
    parts = [outline_of_eye(points, eye) for eye in EYES] + [points[list(eye.brow)] for eye in EYES]
    parts.append(points[list(LIPS)])
    return np.minimum(2.0 * mask(shape, parts, 0.02 * unit), 1.0)


def frontal(faces: Faces) -> Float[np.ndarray, "478 2"]:
    """Landmarks of the sample whose face is seen most from the front; zeros when there is none."""
    if not (faces.presence > 0).any():
        return np.zeros((N_POINTS, 2), np.float32)
    left, right, nose = faces.points[:, 454], faces.points[:, 234], faces.points[:, 1]
    near = np.linalg.norm(nose - left, axis=1)
    far = np.linalg.norm(nose - right, axis=1)
    turned = np.abs(near - far) / np.maximum(near + far, 1e-6)
    return faces.points[int(np.argmin(np.where(faces.presence > 0, turned, np.inf)))].copy()


def anatomy(shape: tuple[int, int], points: Points, unit: float) -> Plane:
    """Where a draughtsman looks for lines even if the picture shows them faintly: jaw, nose, between the lips."""
    lines = [points[list(JAW_LINE)], points[list(NOSE_BASE)], points[list(LIP_LINE)]]
    return np.float32(1.8) * mask(shape, lines, 0.02 * unit, 0.05 * unit)
