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

    from toonifygb.head import HeadModel
    from toonifygb.structures import TrackedSequence

OVERSAMPLING = 2
SHIFT = 4
"""Fractional bits of OpenCV's fixed-point coordinates."""
SURFACE_OPACITY = 0.34
NET_OPACITY = 0.30
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
    """The frame with the tracked head drawn over it; frames without a trusted face say so.

    Args:
        frame: the clip's frame number ``index``, RGB.
        sequence: the track.
        index: frame number.
        head: the model it was tracked with.
    """
    pose = _project(sequence, index, head)
    left, top, right, bottom = _window(pose.vertices, frame.shape[1], frame.shape[0])
    if right <= left or bottom <= top:
        return frame.copy()
    patch = frame[top:bottom, left:right]
    size = ((right - left) * OVERSAMPLING, (bottom - top) * OVERSAMPLING)
    canvas = cv2.resize(patch, size, interpolation=cv2.INTER_LINEAR)
    moved = pose.moved(left, top, OVERSAMPLING)
    tracked = bool(sequence.tracked[index])
    width = max(1.0, moved.face_size / 300)
    canvas = _surface(canvas, moved, SKIN if tracked else LOST)
    canvas = _net(canvas, moved, head, NET if tracked else LOST)
    if tracked:
        _contours(canvas, moved, width)
        _axes(canvas, moved, width)
    drawn = frame.copy()
    drawn[top:bottom, left:right] = cv2.resize(canvas, patch.shape[1::-1], interpolation=cv2.INTER_AREA)
    if not tracked:
        _label(drawn, (left, top), "no face here: motion bridged")
    return drawn


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


def _project(sequence: TrackedSequence, index: int, head: HeadModel) -> _Pose:
    motion = sequence.motion[index]
    world, _ = head.forward(sequence.shape, motion)
    pixels, depth = cameras.project(sequence.camera, world)
    skin = head.faces[(head.part[head.faces] == 0).all(-1)]
    corners = world[skin]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=-1)
    view = torch.nn.functional.normalize(-corners.mean(1), dim=-1)
    facing = (normals * view).sum(-1)
    front = facing > 0
    order = depth[skin[front]].mean(-1).argsort(descending=True)
    # Glancing patches are a little brighter, as skin is against the light: it draws the silhouette.
    light = world.new_tensor(LIGHT)
    shade = 0.25 + 0.75 * (normals @ light).clamp(0, 1) + 0.25 * (1 - facing).clamp(0, 1) ** 3
    points = torch.einsum("lk,lkc->lc", head.landmark_bary, world[head.faces[head.landmark_faces]])
    landmark_normals = _landmark_normals(head, world)
    landmark_view = torch.nn.functional.normalize(-points, dim=-1)
    turn = axis_angle_to_matrix(motion.joints[:2])
    rotation = turn[0] @ turn[1]
    origin = points[4]
    tips = origin + 0.045 * torch.cat([torch.zeros(1, 3).to(rotation), rotation.T])
    return _Pose(
        vertices=pixels.numpy(),
        faces=skin[front][order].numpy(),
        shade=shade[front][order].numpy(),
        landmarks=cameras.project(sequence.camera, points)[0].numpy(),
        facing=(landmark_normals * landmark_view).sum(-1).numpy(),
        axes=cameras.project(sequence.camera, tips)[0].numpy(),
        eyelids=tuple(motion.eyelids.tolist()),
    )


def _landmark_normals(head: HeadModel, world: torch.Tensor) -> torch.Tensor:
    """Normals of the faces that carry the landmarks."""
    corners = world[head.faces[head.landmark_faces]]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return torch.nn.functional.normalize(normals, dim=-1)


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
    layer = np.zeros_like(canvas)
    triangles = _fixed(pose.vertices[pose.faces])
    colors = np.clip(pose.shade[:, None] * np.asarray(color), 1, 255)
    for triangle, shaded in zip(triangles, colors.tolist(), strict=True):
        cv2.fillConvexPoly(layer, triangle, shaded, cv2.LINE_8, SHIFT)
    cover = (layer.max(-1) > 0).astype(np.float32)
    soft = cv2.GaussianBlur(cover, (0, 0), 2.0)[..., None] * SURFACE_OPACITY
    return np.round(canvas * (1 - soft) + layer * soft).astype(np.uint8)


def _net(
    canvas: UInt8[np.ndarray, "h w 3"], pose: _Pose, head: HeadModel, color: tuple[int, int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """Fine lines between neighbouring landmarks, fading where the face turns away."""
    edges = _net_edges(head)
    strength = np.clip(pose.facing[edges].min(-1) * 2.5, 0, 1)
    ink = np.zeros(canvas.shape[:2], np.uint8)
    ends = _fixed(pose.landmarks)
    for (a, b), shown in zip(edges.tolist(), strength.tolist(), strict=True):
        if shown > 0:
            cv2.line(ink, ends[a].tolist(), ends[b].tolist(), int(255 * shown), 1, cv2.LINE_AA, SHIFT)
    cover = ink[..., None] * np.float32(NET_OPACITY / 255)
    return np.round(canvas * (1 - cover) + np.asarray(color, np.float32) * cover).astype(np.uint8)


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
