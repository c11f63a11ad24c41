"""Who is where: person mattes from a network, refined head mattes, and colours without a halo."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from toonifygb.face.crop import Square, as_batch, cut
from toonifygb.face.guided import SMOOTH_RADIUS, GuidedFilter, box_mean, enlarged, foreground_color, reduced
from toonifygb.face.networks import load_network

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, UInt8

    from toonifygb.structures import Frame

_CROP_SCALE = 2.6
"""Side of the square given to the network, in face box sides."""
_FEATHER = 0.12
"""Width of the transition from the crop's matte to the whole frame's, in crop sides."""
_BATCH = 8
_EDGE_SHARE = 0.03
"""How far the network's edge may be off, in widths of the head."""
_EPSILON = 2e-4
"""Variance of colour within one material, of images 0..1: about (3.6 grey levels)²."""
_CONTRAST = ((0.3, 0.7), (0.25, 0.98))
"""After each round of the guided filter, its values that become 0 and 1. It leaves a veil on both sides of an edge
that the network drew in the wrong place; the first round's contrast corrects the place, so that the second has no
veil left. The last lower bound also takes half a pixel off the rim, where the background's colour is strongest."""
_ISLAND = 0.1
"""Matte below which two regions count as apart."""


class PersonSegmenter:
    """Person mattes of whole frames.

    Args:
        device: where the network runs.
    """

    def __init__(self, device: str = "cpu") -> None:
        self._network = load_network("person", device)
        self._device = device

    def segment(
        self, frames: UInt8[np.ndarray, "t h w 3"], boxes: Float[np.ndarray, "t 4"] | None = None
    ) -> Float[np.ndarray, "t h w"]:
        """Probability 0..1 that a pixel belongs to a person; each frame is judged on its own.

        Args:
            frames: any number of frames of one size.
            boxes: face boxes (left, top, right, bottom, px). With them, the surroundings of the face are looked
                at more closely (and mirrored, the two answers averaged); rows of NaN are treated as no box.
        """
        mattes = np.empty(frames.shape[:3], np.float32)
        for start in range(0, len(frames), _BATCH):
            part = slice(start, start + _BATCH)
            mattes[part] = self._whole(frames[part])
            if boxes is not None:
                self._refine_near_faces(frames[part], boxes[part], mattes[part])
        return mattes

    def _run(self, images: Sequence[UInt8[np.ndarray, "s s 3"]]) -> Float[np.ndarray, "n s s"]:
        (output,) = self._network(as_batch(images, self._device))
        return output[:, 0].cpu().numpy()

    def _whole(self, frames: UInt8[np.ndarray, "t h w 3"]) -> Float[np.ndarray, "t h w"]:
        size, (height, width) = self._network.width, frames.shape[1:3]
        small = [cv2.resize(frame, (size, size), interpolation=cv2.INTER_AREA) for frame in frames]
        mattes = [cv2.resize(m, (width, height), interpolation=cv2.INTER_LINEAR) for m in self._run(small)]
        return np.stack(mattes)

    def _refine_near_faces(
        self,
        frames: UInt8[np.ndarray, "t h w 3"],
        boxes: Float[np.ndarray, "t 4"],
        mattes: Float[np.ndarray, "t h w"],
    ) -> None:
        """Replaces the mattes around the faces, in place."""
        known = np.flatnonzero(np.isfinite(boxes).all(1))
        if not known.size:
            return
        size = self._network.width
        squares = [_surroundings(box) for box in boxes[known]]
        cuts = [cut(frames[i], square, size) for i, square in zip(known, squares, strict=True)]
        plain, mirrored = self._run(cuts), self._run([np.ascontiguousarray(image[:, ::-1]) for image in cuts])
        near = (plain + mirrored[:, :, ::-1]) / 2
        weight = _feather(size)
        for i, square, matte in zip(known, squares, near, strict=True):
            _paste(mattes[i], matte, weight, square)


def head_matte(
    frame: Frame,
    person_matte: Float[np.ndarray, "h w"],
    keep_mask: Float[np.ndarray, "h w"],
    solid_mask: Float[np.ndarray, "h w"] | None = None,
    *,
    head_width_px: float | None = None,
) -> Float[np.ndarray, "h w"]:
    """Soft matte of the head at full resolution.

    The person's edge is drawn to the image's edges (guided filter, twice), cut by ``keep_mask``, and what is not
    connected with the largest part is removed. Nothing is decided by a threshold that a pixel's small change
    could flip, so the matte is as steady as its inputs.

    Args:
        frame: the image.
        person_matte: the person, from ``PersonSegmenter``.
        keep_mask: soft mask 0..1, generous around hair and ears, falling to 0 across the neck.
        solid_mask: soft mask 0..1 of what surely is head (the tracked face without its rim); fills holes.
        head_width_px: scale of the refinement; the width of ``keep_mask`` when not given.
    """
    result = np.zeros(frame.shape[:2], np.float32)
    window = _bounds(keep_mask > 0.0)
    if window is None:
        return result
    width = head_width_px or float(window[1].stop - window[1].start)
    radius = max(2, round(_EDGE_SHARE * width))
    rows, columns = (slice(max(0, s.start - 2 * radius), s.stop + 2 * radius) for s in window)
    guide = frame[rows, columns].astype(np.float32) / 255
    person = person_matte[rows, columns].astype(np.float32)
    matte, (least, greatest) = person, _limits(person, radius)
    refine = GuidedFilter(guide, radius, _EPSILON, step=max(1, radius // 4))
    for black, white in _CONTRAST:
        matte = np.clip(refine(matte), least, greatest)
        matte = np.clip((matte - black) / (white - black), 0, 1).astype(np.float32)
    if solid_mask is not None:
        matte = np.maximum(matte, solid_mask[rows, columns])
    result[rows, columns] = _without_islands(matte * keep_mask[rows, columns])
    return result


def foreground(frame: Frame, matte: Float[np.ndarray, "h w"]) -> Frame:
    """The frame with the background's colour removed from its soft edges.

    ``foreground * matte`` is the person on black without a halo. Where the matte is 1 the frame is unchanged; where
    it is 0 the colours are those of the nearest foreground.
    """
    window = _bounds(matte > 0.0)
    if window is None:
        return frame.copy()
    radius = max(8, round(0.1 * (window[1].stop - window[1].start)))
    rows, columns = (slice(max(0, s.start - radius), s.stop + radius) for s in window)
    image = frame[rows, columns].astype(np.float32) / 255
    result = frame.copy()
    color = foreground_color(image, matte[rows, columns], radius)
    result[rows, columns] = np.rint(color * 255).astype(np.uint8)
    return result


def _limits(
    person: Float[np.ndarray, "h w"], radius: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Least and greatest matte: what is far inside the person is solid, what is far outside is empty.

    Without them, background of the hair's colour shines through and a glint inside the face becomes a hole. They
    are wide and soft, so they are found on a reduced matte: a disc over every pixel would be half of the work.
    """
    step = max(1, radius // SMOOTH_RADIUS)
    small = reduced(person, step)
    reach = max(1, round(radius / step))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    soften = max(1, reach // 2)
    low = enlarged(box_mean(cv2.erode(small, disc), soften), person.shape)
    high = enlarged(box_mean(cv2.dilate(small, disc), soften), person.shape)
    return low, np.maximum(high, low)


def _surroundings(box: Float[np.ndarray, " 4"]) -> Square:
    """The square around a face that shows head, hair and shoulders."""
    left, top, right, bottom = (float(x) for x in box)
    return Square((left + right) / 2, (top + bottom) / 2, _CROP_SCALE * max(right - left, bottom - top))


def _feather(size: int) -> Float[np.ndarray, "s s"]:
    """1 inside, falling smoothly to 0 at the border."""
    distance = (np.minimum(np.arange(size), np.arange(size)[::-1]) + 0.5) / size
    ramp = np.clip(distance / _FEATHER, 0, 1)
    smooth = (ramp * ramp * (3 - 2 * ramp)).astype(np.float32)
    return np.outer(smooth, smooth)


def _paste(
    matte: Float[np.ndarray, "h w"],
    near: Float[np.ndarray, "s s"],
    weight: Float[np.ndarray, "s s"],
    square: Square,
) -> None:
    """Blends the square's matte into the frame's, in place."""
    height, width = matte.shape
    low = np.clip(np.floor([square.x - square.side / 2, square.y - square.side / 2]), 0, [width, height]).astype(
        int
    )
    high = np.clip(np.ceil([square.x + square.side / 2, square.y + square.side / 2]), 0, [width, height]).astype(
        int
    )
    if (high <= low).any():
        return
    matrix = square.matrix(len(near))
    matrix[:, 2] -= low
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    share = cv2.warpAffine(weight, matrix, size, flags=cv2.INTER_LINEAR)
    values = cv2.warpAffine(near, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    part = matte[low[1] : high[1], low[0] : high[0]]
    part += share * (values - part)


def _bounds(mask: Float[np.ndarray, "h w"]) -> tuple[slice, slice] | None:
    """Rows and columns of the true values; ``None`` when there is none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not rows.size:
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _without_islands(matte: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The matte's largest connected part; the others are set to 0."""
    n_labels, labels = cv2.connectedComponents((matte > _ISLAND).astype(np.uint8), connectivity=4)
    if n_labels <= 2:
        return matte
    mass = np.bincount(labels.ravel(), weights=matte.ravel(), minlength=n_labels)
    mass[0] = 0
    others = (labels > 0) & (labels != mass.argmax())
    return np.where(others, 0, matte)
