"""FFHQ face alignment: the square, upright, 256 px picture of a face that the style codes are read from.

Implements the alignment of Karras et al. 2019 with the numbers StyleGANEX uses (256 px, padding on). Those numbers
come from Pillow and SciPy; both are replaced by a few lines of numpy and OpenCV here. Shrinking and the final
quadrilateral sampling agree with Pillow bit for bit; the blur of the padded border is a float32 instead of a
float64 sum, so a padded picture may differ from the original procedure by one level where a value is rounded.

Positions inside this module are *array indices* (the centre of the first pixel is 0), as the 68-point detectors
of the original give them; ``FaceMarks.from_mediapipe`` converts from the house's continuous pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

    Image = UInt8[np.ndarray, "h w 3"]
    Point = Float[np.ndarray, " 2"]
    Quad = Float[np.ndarray, "4 2"]

ALIGNED_SIZE = 256
"""Side of an aligned picture, px."""
EYE_POINTS = ((33, 160, 158, 133, 153, 144), (362, 385, 387, 263, 373, 380))
"""MediaPipe's counterparts of iBUG points 36-41 and 42-47: the eye on the picture's left, then on its right."""
MOUTH_CORNERS = (61, 291)
"""MediaPipe's counterparts of iBUG points 48 and 54."""
_LANCZOS_LOBES = 3
_FIXED_POINT = 1 << 22
"""Pillow's resampling weights are integers of this unit."""


@dataclass(frozen=True)
class FaceMarks:
    """The four places of a face that decide crop and alignment, as array indices (x, y)."""

    eye_left: Point
    """Mean of the eye on the picture's left."""
    eye_right: Point
    mouth_left: Point
    mouth_right: Point

    @classmethod
    def from_ibug68(cls, points: Float[np.ndarray, "68 2"]) -> FaceMarks:
        """From the 68-point scheme, in array indices."""
        points = np.asarray(points, np.float64)
        return cls(points[36:42].mean(0), points[42:48].mean(0), points[48], points[54])

    @classmethod
    def from_mediapipe(cls, points: Float[np.ndarray, "478 2"]) -> FaceMarks:
        """From the 478-point scheme, in continuous px (centre of the first pixel at 0.5)."""
        points = np.asarray(points, np.float64) - 0.5
        left, right = (points[list(eye)].mean(0) for eye in EYE_POINTS)
        return cls(left, right, points[MOUTH_CORNERS[0]], points[MOUTH_CORNERS[1]])

    def scaled(self, scale: float, corner: tuple[int, int] = (0, 0)) -> FaceMarks:
        """The same places in a picture that was scaled and then cut, with its corner (x, y) at ``corner``."""
        places = (self.eye_left, self.eye_right, self.mouth_left, self.mouth_right)
        return FaceMarks(*((place + 0.5) * scale - 0.5 - np.array(corner) for place in places))

    @property
    def eye_middle(self) -> Point:
        """Midway between the eyes."""
        return (self.eye_left + self.eye_right) * 0.5

    @property
    def eye_distance(self) -> float:
        """Distance of the eyes, px."""
        return float(np.linalg.norm(self.eye_right - self.eye_left))


@dataclass(frozen=True)
class Aligned:
    """An aligned face and where it was."""

    image: UInt8[np.ndarray, "s s 3"]
    quad: Quad
    """Corners of ``image`` in the frame, continuous px (x, y): top left, bottom left, bottom right, top right."""


def face_quad(marks: FaceMarks) -> Quad:
    """The square around a face that becomes its aligned picture; corners as of ``Aligned``, in array indices."""
    eye_to_eye = marks.eye_right - marks.eye_left
    eye_to_mouth = (marks.mouth_left + marks.mouth_right) * 0.5 - marks.eye_middle
    x = eye_to_eye - _turned(eye_to_mouth)
    x /= np.hypot(*x)
    x *= max(np.hypot(*eye_to_eye) * 2.0, np.hypot(*eye_to_mouth) * 1.8)
    y = _turned(x)
    middle = marks.eye_middle + 0.1 * eye_to_mouth
    return np.stack([middle - x - y, middle - x + y, middle + x + y, middle + x - y])


def align_face(image: Image, marks: FaceMarks, aligned_px: int = ALIGNED_SIZE) -> Aligned:
    """The aligned picture of a face.

    Args:
        image: the frame.
        marks: where the face is in it; the square around it may reach beyond the frame, which is then continued
            by its blurred mirror image.
        aligned_px: side of the result.
    """
    quad = face_quad(marks)
    size = float(np.hypot(*(quad[2] - quad[1])))
    factor = max(1, int(np.floor(size / aligned_px * 0.5)))
    # the original divides array indices as it shrinks the picture, which moves it by a part of a pixel
    place = quad + 0.5 * factor
    if factor > 1:
        height, width = image.shape[:2]
        image = shrink(image, int(np.rint(width / factor)), int(np.rint(height / factor)))
        quad, size = quad / factor, size / factor
    border = max(int(np.rint(size * 0.1)), 3)
    image, quad = _cropped(image, quad, border)
    image, quad = _padded(image, quad, border, size)
    return Aligned(sample_quad(image, quad + 0.5, aligned_px), place)


def shrink(image: Image, width: int, height: int) -> Image:
    """The picture at a smaller size by Pillow's ``LANCZOS`` resampling: across, rounded to bytes, then down."""
    across = _resampled_rows(image.transpose(1, 0, 2), width)
    return np.ascontiguousarray(_resampled_rows(across.transpose(1, 0, 2), height))


def sample_quad(image: Image, quad: Quad, size: int) -> Image:
    """A quadrilateral of the picture as a square, by Pillow's ``QUAD`` transform with bilinear look-up.

    Args:
        image: the picture; outside it the result is black.
        quad: corners in continuous px, ordered as of ``Aligned``.
        size: side of the result, px.
    """
    height, width = image.shape[:2]
    top_left, bottom_left, bottom_right, top_right = quad
    steps = (np.arange(size) + 0.5) / size
    right, down = steps[None, :, None], steps[:, None, None]
    twist = bottom_right - bottom_left - top_right + top_left
    where = top_left + (top_right - top_left) * right + (bottom_left - top_left) * down + twist * right * down
    inside = ((where >= 0) & (where < [width, height])).all(-1, keepdims=True)
    corner = np.floor(where - 0.5)
    across, below = np.moveaxis(where - 0.5 - corner, -1, 0)[..., None]
    x, y = np.moveaxis(corner.astype(int), -1, 0)
    x0, x1 = np.clip(x, 0, width - 1), np.clip(x + 1, 0, width - 1)
    y0, y1 = np.clip(y, 0, height - 1), np.clip(y + 1, 0, height - 1)
    pixels = image.astype(np.float64)
    above = pixels[y0, x0] + (pixels[y0, x1] - pixels[y0, x0]) * across
    under = pixels[y1, x0] + (pixels[y1, x1] - pixels[y1, x0]) * across
    # Pillow cuts fractions off here
    return np.where(inside, above + (under - above) * below, 0.0).astype(np.uint8)


def _turned(vector: Point) -> Point:
    """The vector turned by 90 degrees, from right to down."""
    return np.array([-vector[1], vector[0]])


def _lanczos(x: np.ndarray) -> np.ndarray:
    return np.where(np.abs(x) < _LANCZOS_LOBES, np.sinc(x) * np.sinc(x / _LANCZOS_LOBES), 0.0)


def _resampled_rows(image: Image, count: int) -> Image:
    """``count`` rows in place of the picture's, each a fixed-point Lanczos sum of those it covers."""
    given = image.shape[0]
    scale = given / count
    reach = _LANCZOS_LOBES * scale
    out = np.empty((count, *image.shape[1:]), np.uint8)
    for row in range(count):
        middle = (row + 0.5) * scale
        first, last = max(int(middle - reach + 0.5), 0), min(int(middle + reach + 0.5), given)
        weights = _lanczos((np.arange(first, last) - middle + 0.5) / scale)
        fixed = np.trunc(weights / weights.sum() * _FIXED_POINT + np.copysign(0.5, weights)).astype(np.int64)
        total = np.tensordot(fixed, image[first:last].astype(np.int64), 1)
        out[row] = np.clip((total + _FIXED_POINT // 2) >> 22, 0, 255)
    return out


def _bounds(quad: Quad) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the whole pixels a quadrilateral touches."""
    low, high = np.floor(quad.min(0)).astype(int), np.ceil(quad.max(0)).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _cropped(image: Image, quad: Quad, border: int) -> tuple[Image, Quad]:
    """The part of the picture that is needed, and the quadrilateral in it."""
    height, width = image.shape[:2]
    left, top, right, bottom = _bounds(quad)
    left, top = max(left - border, 0), max(top - border, 0)
    return image[top : min(bottom + border, height), left : min(right + border, width)], quad - [left, top]


def _padded(image: Image, quad: Quad, border: int, size: float) -> tuple[Image, Quad]:
    """The picture continued where the quadrilateral leaves it: mirrored, blurred, and fading to its median."""
    height, width = image.shape[:2]
    left, top, right, bottom = _bounds(quad)
    missing = [max(side + border, 0) for side in (-left, -top, right - width, bottom - height)]
    if max(missing) <= border - 4:
        return image, quad
    left, top, right, bottom = (max(side, int(np.rint(size * 0.3))) for side in missing)
    wide = np.pad(image.astype(np.float32), ((top, bottom), (left, right), (0, 0)), "reflect")
    y, x = (np.arange(length, dtype=np.float64) for length in wide.shape[:2])
    across = 1.0 - np.minimum(x / left, x[::-1] / right)
    down = 1.0 - np.minimum(y / top, y[::-1] / bottom)
    outside = np.maximum(across[None, :], down[:, None])[..., None]
    wide += (_blurred(wide, size * 0.02) - wide) * np.clip(outside * 3.0 + 1.0, 0.0, 1.0)
    wide += (np.median(wide, axis=(0, 1)) - wide) * np.clip(outside, 0.0, 1.0)
    return np.clip(np.rint(wide), 0, 255).astype(np.uint8), quad + np.array([left, top])


def _blurred(image: Float[np.ndarray, "h w 3"], sigma_px: float) -> Float[np.ndarray, "h w 3"]:
    """Gaussian blur as SciPy's ``gaussian_filter``: cut off at four standard deviations, edge pixels repeated."""
    steps = np.arange(-int(4.0 * sigma_px + 0.5), int(4.0 * sigma_px + 0.5) + 1)
    kernel = np.exp(-0.5 * (steps / sigma_px) ** 2)
    kernel /= kernel.sum()
    return cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REFLECT)
