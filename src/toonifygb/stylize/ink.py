"""The style ``ink``: pen on paper - flowing lines, spotted blacks, a clean wash and engraved hatching for tone."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

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

WORK_FACE_PX = 180
"""Width of the face at which lines are found."""
PAPER = np.array([0.975, 0.960, 0.925], np.float32)
"""sRGB of the sheet."""
INK = np.array([0.10, 0.10, 0.15], np.float32)
"""sRGB of the pen: blue-black."""
WASH = np.array([0.66, 0.69, 0.74], np.float32)
"""sRGB of one coat of diluted ink on the sheet."""
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
        scale = min(1.0, WORK_FACE_PX / state["unit"])
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        lab = filters.to_lab(filters.resize(frame, *size))
        fields = _tone_and_lines(lab, points * scale, presence, state["unit"] * scale)
        fields = filters.resize(fields, width, height)
        darkness = 1.0 - fields[..., 0] / np.float32(state["light"])
        if matte is not None:
            darkness = mix(0.35 * darkness, darkness, matte)
        rgb = _toned(darkness, fields[..., 2], points, presence, state)
        line = smoothstep(1.1, 2.8, fields[..., 1])
        rgb = mix(rgb, INK, 0.95 * line)
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


def _toned(darkness: Plane, keep: Plane, points: Points, presence: float, state: dict[str, Any]) -> np.ndarray:
    """Paper with wash, hatching and solid blacks for darkness 0 (skin in the light) .. 1 (black); no hatching
    over eyes and mouth (``keep``), which have tones of their own.
    """
    shape, unit = darkness.shape, state["unit"]
    first = smoothstep(0.10, 0.16, darkness)
    second = smoothstep(0.34, 0.42, darkness)
    rgb = PAPER * (1.0 - (1.0 - WASH) * (0.42 * first + 0.42 * second)[..., None])
    share = textures.head_share(shape, points, presence, unit) if presence > 0 else None
    place = textures.head_place(points, state["template"]) if presence > 0 else textures.IDENTITY
    for angle, start in zip(HATCH_ANGLES, (0.22, 0.46), strict=True):
        cover = 0.75 * smoothstep(start, start + 0.45, darkness) + 0.16 * smoothstep(start, start + 0.04, darkness)
        lines = _hatch(textures.IDENTITY, angle, unit, cover)
        if share is not None:
            lines = mix(lines, _hatch(place, angle, unit, cover), smoothstep(0.4, 0.6, share))
        rgb = mix(rgb, INK, 0.8 * lines * (1.0 - keep))
    return mix(rgb, INK, 0.96 * smoothstep(0.66, 0.74, darkness))


def _hatch(place: Float[np.ndarray, "2 3"], angle: float, unit: float, cover: Plane) -> Plane:
    """Slightly wavering parallel lines whose thickness is the share ``cover`` of the sheet they ink."""
    height, width = cover.shape
    period = max(HATCH_PERIOD * unit, 3.0)
    waver = textures.laid(cover.shape, textures.noise_tile(8.0, 13), place, 45.0 / max(unit, 1.0))
    x, y, start = np.array([np.cos(angle), np.sin(angle)]) @ place / period
    columns = (x * np.arange(width)).astype(np.float32)
    rows = (y * np.arange(height) + start).astype(np.float32)
    phase = rows[:, None] + columns + np.float32(0.22) * waver
    distance = np.abs(phase - np.rint(phase)) * 2.0  # 0 on a line, 1 half way between two
    edge = 1.6 / period  # one px of anti-aliasing, in these units
    return smoothstep(-edge, edge, cover - distance) * np.minimum(cover * 8.0, 1.0)


@functools.lru_cache(maxsize=2)
def _paper(shape: tuple[int, int]) -> np.ndarray:
    """Tooth and fibres of the sheet, fixed in the picture; a small difference in sRGB. Read-only."""
    tooth = 0.006 * textures.fixed_noise(shape, 0.9, 11) + 0.004 * textures.fixed_noise(shape, 5.0, 12)
    sheet = filters.spread(tooth.astype(np.float32), 3)
    sheet.setflags(write=False)
    return sheet
