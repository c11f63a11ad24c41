"""Finding faces of any size: BlazeFace on the whole image, then on ever smaller tiles.

A detector sees a square of the image at 128 or 192 px, so what it can find depends on the square. Squares come in
levels: the whole image; the image with a margin (a face that fills it) and large tiles; smaller tiles down to
``_SMALLEST_TILE``, in which a 40 px face is large enough; last, the image turned by a quarter or a half, for clips
whose rotation is not recorded. Detections are proposals: the landmark network has the last word.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from toonifygb.face.crop import Square, as_batch, cut
from toonifygb.face.networks import load_network
from toonifygb.structures import Detection

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from jaxtyping import Float

    from toonifygb.face.networks import Name
    from toonifygb.structures import Frame

_SMALLEST_TILE = 400
"""px; the far detector needs a face of about 1/12 of the tile."""
_OVERLAP = 0.3
"""Neighbouring tiles share this part, more than a small face's width, so none is cut in two by every tile."""
_SAME_FACE = 0.3
"""Boxes that overlap by more (intersection over union) are one face."""
_BATCH = 16


@dataclass(frozen=True)
class _Anchors:
    """Grid cells of a detector: (cells per side, anchors per cell), finest first."""

    network: Name
    layers: tuple[tuple[int, int], ...]

    def centres(self) -> Float[np.ndarray, "a 2"]:
        """Anchor centres in units of the input square."""
        parts = []
        for cells, repeats in self.layers:
            axis = (np.arange(cells) + 0.5) / cells
            grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
            parts.append(np.repeat(grid, repeats, axis=0))
        return np.concatenate(parts)


_NEAR = _Anchors("detector_near", ((16, 2), (8, 6)))
_FAR = _Anchors("detector_far", ((48, 1),))


class Detector:
    """One BlazeFace network."""

    def __init__(self, anchors: _Anchors, device: str = "cpu") -> None:
        self._network = load_network(anchors.network, device)
        self._centres = anchors.centres()
        self._device = device

    @classmethod
    def near(cls, device: str = "cpu") -> Detector:
        """For faces of a tenth of the square and more."""
        return cls(_NEAR, device)

    @classmethod
    def far(cls, device: str = "cpu") -> Detector:
        """For faces from a twelfth of the square."""
        return cls(_FAR, device)

    def detect(self, frame: Frame, squares: Sequence[Square], min_score: float = 0.5) -> list[Detection]:
        """Faces in each square, in image coordinates; the same face may come once per square."""
        found = []
        for start in range(0, len(squares), _BATCH):
            part = squares[start : start + _BATCH]
            size = self._network.width
            cuts = [cut(frame, square, size, border=cv2.BORDER_CONSTANT) for square in part]
            boxes, logits = self._network(as_batch(cuts, self._device) * 2 - 1)
            scores = torch.sigmoid(logits[..., 0].clamp(-100, 100)).cpu().numpy()
            raw = boxes.cpu().numpy().astype(np.float64) / size
            for square, box, score in zip(part, raw, scores, strict=True):
                found += self._decode(square, box, score, min_score)
        return found

    def _decode(
        self,
        square: Square,
        raw: Float[np.ndarray, "a 16"],
        scores: Float[np.ndarray, " a"],
        min_score: float,
    ) -> list[Detection]:
        """Detections from one square's output: centre, size and six keypoints relative to the anchors."""
        keep = np.flatnonzero(scores >= min_score)
        values = raw[keep].reshape(-1, 8, 2)
        points = values + self._centres[keep, None]
        points[:, 1] = values[:, 1]
        boxes = np.concatenate([points[:, 0] - points[:, 1] / 2, points[:, 0] + points[:, 1] / 2], 1)
        merged = weighted_suppression(boxes, points[:, 2:], scores[keep])
        return [_to_image(square, *one) for one in merged]


def weighted_suppression(
    boxes: Float[np.ndarray, "n 4"], keypoints: Float[np.ndarray, "n 6 2"], scores: Float[np.ndarray, " n"]
) -> list[tuple[Float[np.ndarray, " 4"], Float[np.ndarray, "6 2"], float]]:
    """Overlapping candidates merged into their mean weighted by score; the best score is kept."""
    result = []
    left = np.argsort(-scores, kind="stable")
    while left.size:
        same = overlap(boxes[left[:1]], boxes[left])[0] > _SAME_FACE
        same[0] = True
        group = left[same]
        weights = scores[group] / scores[group].sum()
        result.append((weights @ boxes[group], np.tensordot(weights, keypoints[group], 1), float(scores[left[0]])))
        left = left[~same]
    return result


def overlap(a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "n m"]:
    """Intersection over union of boxes (left, top, right, bottom)."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.clip(high - low, 0, None).prod(-1)
    area_a, area_b = (np.clip(x[:, 2:] - x[:, :2], 0, None).prod(-1) for x in (a, b))
    return shared / np.maximum(area_a[:, None] + area_b[None] - shared, 1e-12)


def face_square(detection: Detection) -> Square:
    """Where to look for landmarks: 1.5 × the box's long side, turned so that the eyes are level."""
    left, top, right, bottom = detection.box.tolist()
    (right_x, right_y), (left_x, left_y) = detection.keypoints[:2].tolist()
    angle = float(np.arctan2(left_y - right_y, left_x - right_x))
    return Square((left + right) / 2, (top + bottom) / 2, 1.5 * max(right - left, bottom - top), angle)


class FaceFinder:
    """All faces of an image, level by level until one level finds some."""

    def __init__(self, device: str = "cpu") -> None:
        self._near = Detector.near(device)
        self._far = Detector.far(device)

    def levels(self, frame: Frame, *, thorough: bool, min_score: float = 0.5) -> Iterator[list[Detection]]:
        """Distinct detections of each level, coarse to fine.

        Args:
            frame: the image.
            thorough: also search tiles and turned images; otherwise only the first level is given.
            min_score: least detector score 0..1.
        """
        height, width = frame.shape[:2]
        whole = Square(width / 2, height / 2, max(width, height))
        near = self._near.detect(frame, [whole], min_score)
        yield distinct(near + self._far.detect(frame, [whole], min_score))
        if not thorough:
            return
        margin = Square(whole.x, whole.y, 1.6 * whole.side)
        for number, tiles in enumerate(tile_levels(width, height)):
            near = self._near.detect(frame, [margin], min_score) if number == 0 else []
            yield distinct(near + self._far.detect(frame, tiles, min_score))
        turned = [Square(whole.x, whole.y, whole.side, angle) for angle in (np.pi / 2, -np.pi / 2, np.pi)]
        yield distinct(self._near.detect(frame, turned, min_score) + self._far.detect(frame, turned, min_score))


def tile_levels(width: int, height: int) -> Iterator[list[Square]]:
    """Grids of overlapping squares, each level half as large as the one before."""
    side = min(0.75 * max(width, height), width, height)
    while True:
        centres = []
        for length in (width, height):
            count = max(1, int(np.ceil((length - side * _OVERLAP) / (side * (1 - _OVERLAP)))))
            centres.append(np.linspace(side / 2, length - side / 2, count) if count > 1 else np.array([length / 2]))
        yield [Square(float(x), float(y), side) for y in centres[1] for x in centres[0]]
        if side <= _SMALLEST_TILE:
            return
        side = max(side / 2, _SMALLEST_TILE)


def distinct(detections: list[Detection]) -> list[Detection]:
    """One detection per face, the best scored."""
    kept: list[Detection] = []
    for one in sorted(detections, key=lambda d: -d.score):
        box = one.box.numpy()[None]
        if not any(overlap(box, other.box.numpy()[None])[0, 0] > _SAME_FACE for other in kept):
            kept.append(one)
    return kept


def _to_image(
    square: Square, box: Float[np.ndarray, " 4"], keypoints: Float[np.ndarray, "6 2"], score: float
) -> Detection:
    """Detection in image coordinates; of a turned square's box, the upright square box of equal side."""
    points = square.to_image(keypoints)
    if square.angle:
        centre = square.to_image((box[:2] + box[2:]) / 2)
        half = (box[2:] - box[:2]).max() * square.side / 2
        bounds = np.concatenate([centre - half, centre + half])
    else:
        bounds = square.to_image(box.reshape(2, 2)).reshape(4)
    return Detection(torch.from_numpy(bounds).to(torch.float32), torch.from_numpy(points).to(torch.float32), score)
