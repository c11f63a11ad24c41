"""The style ``ink``: pen on paper - flowing lines, spotted blacks, a clean wash and engraved hatching for tone."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from toonifygb.stylize import features, filters, textures
from toonifygb.stylize.anchors import anatomy, face_unit, feature_mask, frontal, skin_pixels
from toonifygb.stylize.exaggerate import Exaggeration
from toonifygb.stylize.filters import blur, mix, smoothstep

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

    from toonifygb.stylize.anchors import Faces

    Frames = UInt8[np.ndarray, "t h w 3"]
    Frame = UInt8[np.ndarray, "h w 3"]
    Plane = Float[np.ndarray, "h w"]
    Lab = Float[np.ndarray, "h w 3"]
    Points = Float[np.ndarray, "478 2"]

WORK_FACE_PX = 150
"""Width of the face at which lines are found."""
PAPER = np.array([0.975, 0.960, 0.925], np.float32)
"""sRGB of the sheet."""
INK = np.array([0.10, 0.10, 0.15], np.float32)
"""sRGB of the pen: blue-black."""
WASH = np.array([0.66, 0.69, 0.74], np.float32)
"""Share of light that comes back through a full coat of diluted ink."""
PALETTE = tuple(zip(PAPER.tolist(), (PAPER * WASH).tolist(), INK.tolist(), strict=True))
"""Paper, wash and pen for each channel."""
HATCH_PERIOD = 0.028
"""Distance of two hatching lines in face widths."""
HATCH_ANGLES = (0.95, -0.65)
"""Direction (rad) of the first hatching and of the one that crosses it in the darks."""


class Ink:
    """Pen and ink."""

    name = "ink"
    description = "pen lines, wash and hatching on paper"
    exaggeration = Exaggeration(eye_gain=1.12)
    denoise = True

    def prepare(self, samples: Frames, faces: Faces) -> dict[str, Any]:
        """Which tones stay paper and which turn to ink: placed below the skin, so that faces stay light."""
        labs = [filters.to_lab(frame) for frame in samples]
        tones = np.concatenate([lab[::4, ::4, 0].ravel() for lab in labs])
        skin = skin_pixels(labs, faces)
        light = float(np.quantile(skin[:, 0], 0.6)) if len(skin) else float(np.quantile(tones, 0.7))
        return {
            "unit": face_unit(samples, faces),
            "light": max(light, 25.0),
            "template": frontal(faces),
        }

    def apply(self, frames: Frames, faces: Faces, mattes: Any, state: dict[str, Any]) -> Frames:
        """The frames drawn in ink; with mattes the background keeps only its lines and a hint of wash."""
        drawn = []
        for index, frame in enumerate(frames):
            matte = None if mattes is None else mattes[index]
            drawn.append(self._draw(frame, faces.points[index], float(faces.presence[index]), matte, state))
        return np.stack(drawn)

    def _draw(
        self, frame: Frame, points: Points, presence: float, matte: Plane | None, state: dict[str, Any]
    ) -> Frame:
        height, width = frame.shape[:2]
        scale, size = filters.working_size(frame.shape, state["unit"], WORK_FACE_PX)
        lab = filters.to_lab(filters.resize(frame, *size))
        fields = _tone_and_lines(lab, points * scale, presence, state["unit"] * scale)
        fields = filters.resize(fields, width, height)
        darkness = 1.0 - fields[..., 0] / np.float32(state["light"])
        darkness *= 1.0 + 0.4 * fields[..., 2]  # eyes, brows and mouth are drawn with a fuller pen
        if matte is not None:
            darkness = mix(0.35 * darkness, darkness, matte)
        bare, coats = np.ones((height, width), np.float32), _wash(darkness)
        bare *= 1.0 - _hatching(darkness, fields[..., 2], points, presence, state)
        bare *= 1.0 - 0.96 * smoothstep(0.66, 0.74, darkness)
        bare *= 1.0 - 0.95 * smoothstep(1.1, 2.8, fields[..., 1])
        rgb = cv2.merge([(paper - (paper - wash) * coats - ink) * bare + ink for paper, wash, ink in PALETTE])
        if presence > 0:
            features.draw_lashes(rgb, points, presence, state["unit"], INK)
        return filters.to_bytes(rgb + _paper((height, width)))


def _tone_and_lines(lab: Lab, points: Points, presence: float, unit: float) -> np.ndarray:
    """Simplified lightness, ink response, and where eyes and mouth are, at working size."""
    tangents, clarity = filters.structure(lab, 0.012 * unit)
    simple = filters.kuwahara(lab, tangents, clarity, 0.03 * unit)[..., 0]
    fine = lab[..., 0]
    response = filters.ink_response(mix(simple, fine, 0.8), tangents, 0.0075 * unit)
    if presence > 0:
        response *= 1.0 + np.float32(presence) * anatomy(lab.shape[:2], points, unit)
        keep = feature_mask(lab.shape[:2], points, unit) * np.float32(presence)
        simple = mix(simple, blur(fine, 0.004 * unit), keep)
        return np.dstack([simple, response, keep])
    return np.dstack([simple, response, np.zeros_like(simple)])


def _wash(darkness: Plane) -> Plane:
    """Coats of diluted ink for darkness 0 (skin in the light) .. 1 (black)."""
    return 0.42 * smoothstep(0.10, 0.16, darkness) + 0.42 * smoothstep(0.34, 0.42, darkness)


def _hatching(darkness: Plane, keep: Plane, points: Points, presence: float, state: dict[str, Any]) -> Plane:
    """Share 0..1 of ink laid by hatching; none over eyes and mouth (``keep``), which have tones of their own."""
    shape, unit = darkness.shape, state["unit"]
    bare = np.ones(shape, np.float32)
    on_head = textures.head_share(shape, points, presence, unit) > 0.5 if presence > 0 else None
    place = textures.head_place(points, state["template"]) if presence > 0 else textures.IDENTITY
    for angle, start in zip(HATCH_ANGLES, (0.22, 0.46), strict=True):
        phase = _hatch_phase(shape, textures.IDENTITY, angle, unit)
        if on_head is not None:
            phase = np.where(on_head, _hatch_phase(shape, place, angle, unit), phase)
        distance = np.abs(phase - np.rint(phase)) * 2.0  # 0 on a line, 1 half way between two
        cover = 0.75 * smoothstep(start, start + 0.45, darkness) + 0.16 * smoothstep(start, start + 0.04, darkness)
        edge = 1.6 / _period(unit)  # one px of anti-aliasing, in these units
        lines = smoothstep(-edge, edge, cover - distance) * np.minimum(cover * 8.0, 1.0)
        bare *= 1.0 - 0.8 * lines * (1.0 - keep)
    return 1.0 - bare


def _period(unit: float) -> float:
    """Distance of two hatching lines in px; never finer than the pixels can show."""
    return max(HATCH_PERIOD * unit, 3.0)


def _hatch_phase(shape: tuple[int, int], place: Float[np.ndarray, "2 3"], angle: float, unit: float) -> Plane:
    """Number of the line at each pixel, with fractions, on a sheet that lies at ``place``; slightly wavering."""
    waver = textures.laid(shape, textures.noise_tile(8.0, 13), place, 45.0 / max(unit, 1.0))
    x, y, start = np.array([np.cos(angle), np.sin(angle)]) @ place / _period(unit)
    columns = (x * np.arange(shape[1])).astype(np.float32)
    rows = (y * np.arange(shape[0]) + start).astype(np.float32)
    return rows[:, None] + columns + np.float32(0.22) * waver


@functools.lru_cache(maxsize=2)
def _paper(shape: tuple[int, int]) -> np.ndarray:
    """Tooth and fibres of the sheet, fixed in the picture; a small difference in sRGB. Read-only."""
    tooth = 0.006 * textures.fixed_noise(shape, 0.9, 11) + 0.004 * textures.fixed_noise(shape, 5.0, 12)
    sheet = filters.spread(tooth.astype(np.float32), 3)
    sheet.setflags(write=False)
    return sheet
