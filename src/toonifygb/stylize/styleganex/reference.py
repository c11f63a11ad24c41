"""Which frame of a clip the style codes are read from: frontal, sharp, with open eyes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.errors import FaceError
from toonifygb.stylize.anchors import EYES, OVAL, box_around, is_empty
from toonifygb.stylize.filters import resize

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

    from toonifygb.stylize.anchors import Faces

_CHEEK_LEFT, _CHEEK_RIGHT, _NOSE_TIP = 454, 234, 1
_SHARPNESS_SIDE = 128
"""Side at which faces are compared for sharpness, px; finer detail is mostly noise."""


def first_frame(faces: Faces) -> int:
    """The first sample that shows a face.

    Raises:
        FaceError: none does.
    """
    seen = np.flatnonzero(faces.presence > 0)
    if len(seen) == 0:
        raise FaceError(
            "no face was found in the frames sampled from the clip; this style needs one to take its measure from",
            "use a clip that shows a face, or a drawn style: toon, paint or ink",
        )
    return int(seen[0])


def best_frame(samples: UInt8[np.ndarray, "s h w 3"], faces: Faces) -> int:
    """The sample whose face suits best.

    Raises:
        FaceError: no sample shows a face.
    """
    first_frame(faces)
    return int(np.argmax(suitability(samples, faces)))


def suitability(samples: UInt8[np.ndarray, "s h w 3"], faces: Faces) -> Float[np.ndarray, " s"]:
    """How well each sample suits, 0..1: the product of how frontal, how open-eyed and how sharp it is.

    Openness and sharpness are relative to the clip, so narrow eyes and soft lenses are no fault.
    """
    openness, sharpness = _openness(faces.points), _sharpness(samples, faces)
    usual_openness = max(float(np.quantile(openness, 0.75)), 1e-6)
    best_sharpness = max(float(sharpness.max()), 1e-6)
    score = _frontality(faces.points) * np.minimum(openness / usual_openness, 1.0)
    return score * np.sqrt(sharpness / best_sharpness) * faces.presence


def _frontality(points: Float[np.ndarray, "s 478 2"]) -> Float[np.ndarray, " s"]:
    """1 with the nose midway between the cheeks, 0 with it on one of them."""
    left = np.linalg.norm(points[:, _NOSE_TIP] - points[:, _CHEEK_LEFT], axis=1)
    right = np.linalg.norm(points[:, _NOSE_TIP] - points[:, _CHEEK_RIGHT], axis=1)
    return 1.0 - np.abs(left - right) / np.maximum(left + right, 1e-6)


def _openness(points: Float[np.ndarray, "s 478 2"]) -> Float[np.ndarray, " s"]:
    """Gap of the lids relative to the width of the eye, of the eye less open."""
    gaps = []
    for eye in EYES:
        upper, lower = points[:, eye.upper[4]], points[:, eye.lower[4]]
        width = np.linalg.norm(points[:, eye.upper[0]] - points[:, eye.upper[-1]], axis=1)
        gaps.append(np.linalg.norm(upper - lower, axis=1) / np.maximum(width, 1e-6))
    return np.minimum(*gaps)


def _sharpness(samples: UInt8[np.ndarray, "s h w 3"], faces: Faces) -> Float[np.ndarray, " s"]:
    """Variance of the Laplacian in the face's box, all faces brought to one size."""
    values = np.zeros(len(samples))
    for index, (frame, points) in enumerate(zip(samples, faces.points, strict=True)):
        box = box_around(points[list(OVAL)], 0.0, frame.shape)
        if faces.presence[index] > 0 and not is_empty(box):
            face = resize(cv2.cvtColor(frame[box], cv2.COLOR_RGB2GRAY), _SHARPNESS_SIDE, _SHARPNESS_SIDE)
            values[index] = cv2.Laplacian(face, cv2.CV_64F).var()
    return values
