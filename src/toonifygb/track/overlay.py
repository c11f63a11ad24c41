"""Drawing a track on its frames, so that a person sees whether the head model sits on the face.

Three layers: the head's surface, softly lit and half transparent; a fine net between the landmarks; the contours
a viewer checks first (jaw line, brows, lids, irises, nose, lips). Everything is drawn at twice the size around
the head and averaged down, which smooths lines and polygon edges alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from toonifygb.geometry import cameras
from toonifygb.geometry.rotations import axis_angle_to_matrix

if TYPE_CHECKING:
    from jaxtyping import Float, Int, UInt8
    from torch import Tensor

    from toonifygb.head import HeadModel
    from toonifygb.structures import TrackedSequence

OVERSAMPLING = 2
SHIFT = 4
"""Fractional bits of OpenCV's fixed-point coordinates."""
SURFACE_OPACITY = 0.34
NET_OPACITY = 0.30
SHADE_RANGE = (0.25, 1.25)
"""Least and greatest brightness of the surface."""
LIGHT = (0.35, 0.55, 0.76)
"""Direction towards the light, world axes, unit length to 1 %."""

SKIN = (150, 205, 225)
NET = (214, 244, 255)
LOST = (255, 176, 64)
AXES = ((255, 92, 92), (120, 230, 120), (96, 150, 255))
"""x towards the subject's left, y up, z out of the face."""

JAW_LINE = (
    10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377, 152,
    148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109,
)  # fmt: skip
LIPS_OUTER = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
LIPS_INNER = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191)
EYE_RIGHT = (33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246)
EYE_LEFT = (263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466)
BROW_RIGHT = (46, 53, 52, 65, 55, 107, 66, 105, 63, 70)
BROW_LEFT = (276, 283, 282, 295, 285, 336, 296, 334, 293, 300)
IRISES = ((474, 475, 476, 477), (469, 470, 471, 472))
"""Four points around each iris, a quarter turn apart; the subject's left eye first, as in ``eyelids``."""
IRIS_COLOR = (110, 240, 200)
LID_HIDES_IRIS = 0.6
"""Closure from which an iris is not drawn."""
NOSE_RIDGE = (168, 6, 197, 195, 5, 4)
NOSE_WING = (98, 97, 2, 326, 327)
HOLES = (LIPS_INNER, EYE_RIGHT, EYE_LEFT)

CONTOURS: tuple[tuple[tuple[int, ...], bool, tuple[int, int, int], float], ...] = (
    (JAW_LINE, True, (120, 220, 255), 1.0),
    (BROW_RIGHT, True, (255, 214, 130), 0.9),
    (BROW_LEFT, True, (255, 214, 130), 0.9),
    (NOSE_RIDGE, False, (196, 240, 205), 0.9),
    (NOSE_WING, False, (196, 240, 205), 0.9),
    (EYE_RIGHT, True, (255, 255, 255), 1.0),
    (EYE_LEFT, True, (255, 255, 255), 1.0),
    (LIPS_OUTER, True, (255, 120, 140), 1.1),
    (LIPS_INNER, True, (255, 120, 140), 0.9),
)
"""Landmarks, whether they close, colour, and relative width; OpenCV draws them in this order."""


def draw(
    frame: UInt8[np.ndarray, "h w 3"], sequence: TrackedSequence, index: int, head: HeadModel
) -> UInt8[np.ndarray, "h w 3"]:
    """One frame with the tracked head drawn over it; for many frames keep an ``Overlay``.

    Args:
        frame: the clip's frame number ``index``, RGB.
        sequence: the track.
        index: frame number.
        head: the model it was tracked with.
    """
    return Overlay(sequence, head)(frame, index)


class Overlay:
    """Draws a clip's track on its frames.

    Args:
        sequence: the track.
        head: the model it was tracked with.
    """

    def __init__(self, sequence: TrackedSequence, head: HeadModel) -> None:
        self._sequence, self._head = sequence, head
        self._skin = head.faces[(head.part[head.faces] == 0).all(-1)]
        self._net_edges = _net_edges(head)

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> UInt8[np.ndarray, "h w 3"]:
        """Frame ``index`` with the head over it; frames without a trusted face say so."""
        pose = self._project(index)
        left, top, right, bottom = _window(pose.vertices, frame.shape[1], frame.shape[0])
        if right <= left or bottom <= top:
            return frame.copy()
        patch = frame[top:bottom, left:right]
        size = ((right - left) * OVERSAMPLING, (bottom - top) * OVERSAMPLING)
        canvas = cv2.resize(patch, size, interpolation=cv2.INTER_LINEAR)
        moved = pose.moved(left, top, OVERSAMPLING)
        tracked = bool(self._sequence.tracked[index])
        width = max(1.0, moved.face_size / 300)
        canvas = _surface(canvas, moved, SKIN if tracked else LOST)
        canvas = _net(canvas, moved, self._net_edges, NET if tracked else LOST)
        if tracked:
            _contours(canvas, moved, width)
            _axes(canvas, moved, width)
        drawn = frame.copy()
        drawn[top:bottom, left:right] = cv2.resize(canvas, patch.shape[1::-1], interpolation=cv2.INTER_AREA)
        if not tracked:
            _label(drawn, (left, top), "no face here: motion bridged")
        return drawn

    def _project(self, index: int) -> _Pose:
        sequence, head = self._sequence, self._head
        motion = sequence.motion[index]
        world, _ = head.forward(sequence.shape, motion)
        pixels, depth = cameras.project(sequence.camera, world)
        corners = world[self._skin]
        normals, facing = _facing(corners, corners.mean(1))
        front = facing > 0
        order = depth[self._skin[front]].mean(-1).argsort(descending=True)
        # Glancing patches are a little brighter, as skin is against the light: it draws the silhouette.
        light = world.new_tensor(LIGHT)
        shade = 0.25 + 0.75 * (normals @ light).clamp(0, 1) + 0.25 * (1 - facing).clamp(0, 1) ** 3
        corners = world[head.faces[head.landmark_faces]]
        points = torch.einsum("lk,lkc->lc", head.landmark_bary, corners)
        turn = axis_angle_to_matrix(motion.joints[:2])
        rotation = turn[0] @ turn[1]
        tips = points[4] + 0.045 * torch.cat([torch.zeros(1, 3).to(rotation), rotation.T])
        return _Pose(
            vertices=pixels.numpy(),
            faces=self._skin[front][order].numpy(),
            shade=shade[front][order].numpy(),
            landmarks=cameras.project(sequence.camera, points)[0].numpy(),
            facing=_facing(corners, points)[1].numpy(),
            axes=cameras.project(sequence.camera, tips)[0].numpy(),
            eyelids=tuple(motion.eyelids.tolist()),
        )


@dataclass(frozen=True)
class _Pose:
    """What one frame's head looks like in pixels."""

    vertices: Float[np.ndarray, "v 2"]
    faces: Int[np.ndarray, "f 3"]
    """Skin faces towards the viewer, the farthest first."""
    shade: Float[np.ndarray, " f"]
    landmarks: Float[np.ndarray, "l 2"]
    facing: Float[np.ndarray, " l"]
    """Cosine between each landmark's normal and the viewer."""
    axes: Float[np.ndarray, "4 2"]
    """Origin and tips of the head's axes."""
    eyelids: tuple[float, ...]
    """Closure of left and right lid."""

    @property
    def face_size(self) -> float:
        """Longer side of the landmarks' box, px."""
        return float(np.ptp(self.landmarks, axis=0).max())

    def moved(self, left: int, top: int, scale: int) -> _Pose:
        """The same in a cut-out that starts at (left, top), magnified."""

        def place(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
            return (points - (left, top)) * scale

        return _Pose(
            place(self.vertices),
            self.faces,
            self.shade,
            place(self.landmarks),
            self.facing,
            place(self.axes),
            self.eyelids,
        )


def _facing(
    corners: Float[Tensor, "f 3 3"], points: Float[Tensor, "f 3"]
) -> tuple[Float[Tensor, "f 3"], Float[Tensor, " f"]]:
    """Unit normals of faces, and their cosines with the view of a point on each (the camera is at the origin)."""
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=-1)
    view = torch.nn.functional.normalize(-points, dim=-1)
    return normals, (normals * view).sum(-1)


def _window(points: Float[np.ndarray, "n 2"], width: int, height: int) -> tuple[int, int, int, int]:
    """Part of the image the head covers, with a margin, px."""
    margin = 12
    left, top = np.floor(points.min(0)).astype(int) - margin
    right, bottom = np.ceil(points.max(0)).astype(int) + margin
    return max(int(left), 0), max(int(top), 0), min(int(right), width), min(int(bottom), height)


def _fixed(points: Float[np.ndarray, "*b 2"]) -> Int[np.ndarray, "*b 2"]:
    """OpenCV's fixed-point form of continuous image coordinates (its pixel centres are at integers)."""
    return np.round((points - 0.5) * 2**SHIFT).astype(np.int32)


def _surface(
    canvas: UInt8[np.ndarray, "h w 3"], pose: _Pose, color: tuple[int, int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """Lit surface, painted from far to near."""
    # One channel takes half the time of three. Its value is the brightness in steps that stay below one grey level
    # in the result; 0 is where there is no surface.
    layer = np.zeros(canvas.shape[:2], np.uint8)
    tones = 1 + np.round((pose.shade - SHADE_RANGE[0]) * (254 / (SHADE_RANGE[1] - SHADE_RANGE[0])))
    for triangle, tone in zip(_fixed(pose.vertices[pose.faces]), tones.tolist(), strict=True):
        cv2.fillConvexPoly(layer, triangle, tone, cv2.LINE_8, SHIFT)
    brightness = np.linspace(*SHADE_RANGE, 255)[:, None] * color
    table = np.concatenate([np.zeros((1, 3)), np.clip(np.round(brightness), 1, 255)])[:, None]
    cover = cv2.GaussianBlur((layer > 0).astype(np.float32), (0, 0), 2.0)
    return _blend(canvas, cv2.applyColorMap(layer, table.astype(np.uint8)), SURFACE_OPACITY * cover)


def _net(
    canvas: UInt8[np.ndarray, "h w 3"],
    pose: _Pose,
    edges: Int[np.ndarray, "e 2"],
    color: tuple[int, int, int],
) -> UInt8[np.ndarray, "h w 3"]:
    """Fine lines between neighbouring landmarks, fading where the face turns away."""
    strength = np.clip(pose.facing[edges].min(-1) * 2.5, 0, 1)
    ink = np.zeros(canvas.shape[:2], np.uint8)
    lines = _fixed(pose.landmarks)[edges]
    for (start, end), shown in zip(lines.tolist(), strength.tolist(), strict=True):
        if shown > 0:
            cv2.line(ink, start, end, int(255 * shown), 1, cv2.LINE_AA, SHIFT)
    paint = cv2.merge([np.full_like(ink, channel) for channel in color])
    return _blend(canvas, paint, ink * np.float32(NET_OPACITY / 255))


def _blend(
    under: UInt8[np.ndarray, "h w 3"], over: UInt8[np.ndarray, "h w 3"], opacity: Float[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """One picture over another, rounded to nearest."""
    return cv2.blendLinear(under, over, 1 - opacity, opacity)


def _net_edges(head: HeadModel) -> Int[np.ndarray, "e 2"]:
    """Edges of the Delaunay net over the unrolled landmarks, without those that cross eyes or mouth."""
    points = torch.einsum("lk,lkc->lc", head.landmark_bary, head.template[head.faces[head.landmark_faces]])[:468]
    flat = torch.stack([torch.atan2(points[:, 0], points[:, 2] + 0.06) * 0.12, points[:, 1]], -1).double().numpy()
    flat = (flat - flat.min(0)) * 1e4 + 10
    divider = cv2.Subdiv2D((0, 0, int(flat[:, 0].max()) + 20, int(flat[:, 1].max()) + 20))
    for x, y in flat.tolist():
        divider.insert((x, y))
    triangles = np.asarray(divider.getTriangleList()).reshape(-1, 3, 2)
    away = np.linalg.norm(triangles[:, :, None] - flat[None, None], axis=-1)
    known = (away.min(-1) < 1.0).all(-1)
    corners = away.argmin(-1)[known]
    for hole in HOLES:
        corners = corners[~np.isin(corners, hole).all(-1)]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    return np.unique(np.sort(edges, -1), axis=0)


def _contours(canvas: UInt8[np.ndarray, "h w 3"], pose: _Pose, width: float) -> None:
    for numbers, closed, color, weight in CONTOURS:
        line = _fixed(_smooth(pose.landmarks[list(numbers)], closed))
        pen = max(1, round(weight * width * OVERSAMPLING))
        cv2.polylines(canvas, [line], closed, color, pen, cv2.LINE_AA, SHIFT)
    pen = max(1, round(width * OVERSAMPLING))
    for numbers, closure in zip(IRISES, pose.eyelids, strict=True):
        if closure < LID_HIDES_IRIS:
            ring = _fixed(_ellipse(pose.landmarks[list(numbers)]))
            cv2.polylines(canvas, [ring], True, IRIS_COLOR, pen, cv2.LINE_AA, SHIFT)


def _smooth(points: Float[np.ndarray, "n 2"], closed: bool, parts: int = 6) -> Float[np.ndarray, "m 2"]:
    """Catmull-Rom curve through the points."""
    ends = (points[-1:], points[:2]) if closed else (points[:1], points[-1:])
    padded = np.concatenate([ends[0], points, ends[1]])
    t = np.arange(parts)[:, None, None] / parts
    a, b, c, d = (padded[i : len(padded) - 3 + i] for i in range(4))
    curve = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
    curve = curve.swapaxes(0, 1).reshape(-1, 2)
    return curve if closed else np.concatenate([curve, points[-1:]])


def _ellipse(points: Float[np.ndarray, "4 2"], parts: int = 32) -> Float[np.ndarray, "m 2"]:
    """Ellipse through four points that stand a quarter turn apart."""
    angle = np.arange(parts)[:, None] * (2 * np.pi / parts)
    across, along = (points[0] - points[2]) / 2, (points[1] - points[3]) / 2
    return points.mean(0) + np.cos(angle) * across + np.sin(angle) * along


def _axes(canvas: UInt8[np.ndarray, "h w 3"], pose: _Pose, width: float) -> None:
    """Three short lines at the tip of the nose: left, up, and where the face looks."""
    ends = _fixed(pose.axes)
    for tip, color in zip(ends[1:], AXES, strict=True):
        thickness = max(1, round(1.4 * width * OVERSAMPLING))
        cv2.line(canvas, ends[0].tolist(), tip.tolist(), color, thickness, cv2.LINE_AA, SHIFT)


def _label(image: UInt8[np.ndarray, "h w 3"], corner: tuple[int, int], text: str) -> None:
    """A line of text with a dark rim, readable on anything."""
    size = max(image.shape[:2]) / 1100
    place = (corner[0] + 8, corner[1] + round(30 * size) + 8)
    for color, thickness in (((20, 20, 20), 3), (LOST, 1)):
        pen = max(1, round(thickness * size * 1.5))
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, pen, cv2.LINE_AA)
