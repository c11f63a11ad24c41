"""The style ``paint``: oil on canvas - dabs of colour along the forms, brush relief, warm light and cool shade."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from toonifygb.stylize import filters, textures
from toonifygb.stylize.anchors import OVAL, box_around, face_unit, feature_mask, frontal, is_empty, skin_pixels
from toonifygb.stylize.exaggerate import Exaggeration
from toonifygb.stylize.filters import mix, smoothstep

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

    from toonifygb.stylize.anchors import Faces

    Frames = UInt8[np.ndarray, "t h w 3"]
    Frame = UInt8[np.ndarray, "h w 3"]
    Plane = Float[np.ndarray, "h w"]
    Lab = Float[np.ndarray, "h w 3"]
    Points = Float[np.ndarray, "478 2"]

WORK_FACE_PX = 140
"""Width of the face at which dabs are laid."""
STROKE_REST = (1.05, 1.5)
"""Direction (rad) of the brush where the picture has none, and the strength of that habit."""
GRAIN = 0.014
"""Width of a bristle mark in face widths."""
RELIEF = 3.0
"""Brightness of the steepest brush ridges, L."""


class Paint:
    """Oil painting."""

    name = "paint"
    description = "oil paint in dabs that follow the forms, warm light and cool shade"
    exaggeration = Exaggeration(eye_gain=1.12)
    denoise = True

    def prepare(self, samples: Frames, faces: Faces) -> dict[str, Any]:
        """Exposure of the clip, and the face on which brush strokes ride."""
        labs = [filters.to_lab(frame) for frame in samples]
        tones = np.concatenate([lab[::4, ::4, 0].ravel() for lab in labs])
        skin = skin_pixels(labs, faces)
        dark, bright = np.quantile(tones, [0.02, 0.98])
        return {
            "unit": face_unit(samples, faces),
            "dark": float(min(dark, 10.0)),
            "bright": float(max(bright, 90.0)),
            "pivot": float(np.median(skin[:, 0] if len(skin) else tones)),
            "template": frontal(faces),
        }

    def apply(self, frames: Frames, faces: Faces, mattes: Any, state: dict[str, Any]) -> Frames:
        """The frames painted."""
        painted = [
            self._paint(frame, points, float(presence), state)
            for frame, points, presence in zip(frames, faces.points, faces.presence, strict=True)
        ]
        return np.stack(painted)

    def _paint(self, frame: Frame, points: Points, presence: float, state: dict[str, Any]) -> Frame:
        height, width = frame.shape[:2]
        scale, size = filters.working_size(frame.shape, state["unit"], WORK_FACE_PX)
        unit = state["unit"] * scale
        lab = filters.to_lab(filters.resize(frame, *size))
        tangents, clarity = filters.structure(lab, 0.025 * unit, STROKE_REST)
        dabs = filters.kuwahara(lab, tangents, clarity, 0.045 * unit)
        dabs = filters.kuwahara(dabs, tangents, clarity, 0.03 * unit)
        if presence > 0:
            keep = feature_mask(lab.shape[:2], points * scale, unit) * np.float32(presence)
            box = box_around((points * scale)[list(OVAL)], 0.0, lab.shape)
            if not is_empty(box):
                finer = filters.kuwahara(lab[box], tangents[box], clarity[box], 0.011 * unit)
                dabs[box] = mix(dabs[box], finer, keep[box])
        relief = _relief(lab.shape[:2], points * scale, presence, tangents, unit, state["template"] * scale)
        fields = filters.resize(np.dstack([dabs, relief]), width, height)
        lit = _lit(fields[..., :3], fields[..., 3], state)
        return filters.to_bytes(filters.to_rgb(lit))


def _relief(
    shape: tuple[int, int], points: Points, presence: float, tangents: np.ndarray, unit: float, template: Points
) -> Plane:
    """Slope of the paint surface towards the light, -1..1: bristle marks drawn out along the strokes."""
    noise = textures.anchored_noise(shape, points, presence, template, unit, GRAIN, seed=5)
    strokes = filters.flow_blur(noise, tangents, 0.035 * unit, max(1.0, GRAIN * unit))
    slope = cv2.Sobel(strokes, cv2.CV_32F, 1, 0, ksize=3) + cv2.Sobel(strokes, cv2.CV_32F, 0, 1, ksize=3)
    return np.tanh(slope * np.float32(1.0 / 2.2))


def _lit(dabs: Lab, relief: Plane, state: dict[str, Any]) -> Lab:
    """Exposure stretched, contrast about the skin tone, warm lights and cool shades, ridges catching light."""
    tone = (dabs[..., 0] - state["dark"]) * np.float32(93.0 / (state["bright"] - state["dark"])) + 4.0
    pivot = np.float32(state["pivot"])
    tone = tone + 3.0 * np.sin(np.clip((tone - pivot) / 45.0, -1.0, 1.0) * np.float32(np.pi))
    warmth = smoothstep(30.0, 85.0, tone) * 2.0 - 1.0
    chroma = np.float32(1.22)
    a = dabs[..., 1] * chroma + 1.0 * warmth
    b = dabs[..., 2] * chroma + 3.5 * warmth
    thick = 0.45 + 0.55 * smoothstep(15.0, 60.0, tone)  # darks are painted thin
    return np.dstack([np.clip(tone + RELIEF * relief * thick, 0.0, 100.0), a, b]).astype(np.float32)
