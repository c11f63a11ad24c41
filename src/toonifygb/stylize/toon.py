"""The style ``toon``: cel shading in soft bands, coloured ink lines, large bright eyes.

Everything that decides where a band or a line lies (levels, skin colour, line width) is fixed once per clip by
``prepare``; a frame only supplies the picture. Fields are simplified at a working size in which the face is about
``WORK_FACE_PX`` wide, enlarged, and only then thresholded, so edges are crisp at any size of frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from toonifygb.stylize import features, filters
from toonifygb.stylize.anchors import anatomy, face_mask, face_unit, skin_pixels
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

WORK_FACE_PX = 140
"""Width of the face at which regions are simplified; more shows pores, less loses nostrils."""
INK = np.array([0.17, 0.09, 0.13], np.float32)
"""sRGB of the lines: a warm near-black, which sits better on skin than pure black."""
SKIN_SPREAD = 11.0
"""Distance in Lab a, b at which a colour stops being skin."""


class Toon:
    """Cel shading: bands of colour, ink lines, enlarged eyes."""

    name = "toon"
    description = "cel shading with ink lines and large bright eyes"
    exaggeration = Exaggeration(eye_gain=1.3, chin=0.025)
    denoise = True

    def prepare(self, samples: Frames, faces: Faces) -> dict[str, Any]:
        """Bands from the clip's own tones, its skin colour, and the width of its face."""
        labs = [filters.to_lab(frame) for frame in samples]
        unit = face_unit(samples, faces)
        tones = np.concatenate([blur(lab[..., 0], 0.02 * unit)[::4, ::4].ravel() for lab in labs])
        skin = skin_pixels(labs, faces)
        has_skin = len(skin) > 0
        middle = np.median(skin, axis=0) if has_skin else np.array([60.0, 0.0, 0.0])
        dark, bright = np.quantile(tones, [0.02, 0.98])
        # a flat clip is given the depth of a drawing, within limits; the skin's own lightness stays
        gain = float(np.clip(88.0 / max(bright - dark, 1.0), 1.0, 1.15))
        levels = filters.cluster_levels(tones, 6)
        skin_levels = filters.cluster_levels(skin[:, 0], 4) if has_skin else levels
        return {
            "unit": unit,
            "has_skin": has_skin,
            "skin": [float(value) for value in middle],
            "chroma": float(np.clip(26.0 / max(float(np.hypot(*middle[1:])), 1.0), 1.1, 1.3)),
            # skin under cool light is drawn warmer, up to a hue of 40 degrees: pink faces look sore in flat colour
            "warmth": float(np.clip(0.84 * middle[1] - middle[2], 0.0, 6.0)) if has_skin else 0.0,
            "tone_curve": filters.band_curve(levels, 1.6, 0.35, (float(middle[0]), gain)),
            "skin_curve": filters.band_curve(skin_levels, 1.2, 0.25, (float(middle[0]) - 12.0, 1.2)),
        }

    def apply(self, frames: Frames, faces: Faces, mattes: Any, state: dict[str, Any]) -> Frames:
        """The frames drawn as cels."""
        drawn = [
            self._draw(frame, points, float(presence), state)
            for frame, points, presence in zip(frames, faces.points, faces.presence, strict=True)
        ]
        return np.stack(drawn)

    def _draw(self, frame: Frame, points: Points, presence: float, state: dict[str, Any]) -> Frame:
        height, width = frame.shape[:2]
        scale, size = filters.working_size(frame.shape, state["unit"], WORK_FACE_PX)
        lab = filters.to_lab(filters.resize(frame, *size))
        fields = _simplified(lab, points * scale, presence, state, state["unit"] * scale)
        *fields, response = (filters.resize(field, width, height) for field in fields)
        painted = _shaded(fields, state)
        if presence > 0:
            features.draw_toon_features(painted, frame, points, presence, state["unit"])
        line = smoothstep(1.5, 3.6, response)
        rgb = filters.to_rgb(painted)
        rgb = filters.tint(rgb, INK, 0.86 * line)  # the rest of the colour shines through
        if presence > 0:
            features.draw_lashes(rgb, points, presence, state["unit"], INK)
        return filters.to_bytes(rgb)


def _simplified(lab: Lab, points: Points, presence: float, state: dict[str, Any], unit: float) -> list[Plane]:
    """What shading and lines need, at working size: L, a, b, share of skin, ink response."""
    tangents, clarity = filters.structure(lab, 0.012 * unit)
    simple = filters.kuwahara(lab, tangents, clarity, 0.03 * unit)
    fine = lab - simple
    stands_out = filters.flow_blur(np.sqrt(filters.dot(fine, fine)), tangents, 0.02 * unit)
    sharp = smoothstep(4.5, 10.0, stands_out)
    skin = np.zeros(lab.shape[:2], np.float32)
    if state["has_skin"]:
        inside = face_mask(lab.shape[:2], points, 0.03 * unit) * np.float32(presence)
        skin = _skin(simple, state["skin"], unit) * (0.5 + 0.5 * inside)
        simple = _smooth_skin(simple, inside * skin, unit)
    simple += fine * filters.spread(sharp, 3)  # thin things that stand out: spectacles, jewellery, collars
    response = filters.ink_response(mix(simple[..., 0], lab[..., 0], 0.75), tangents, 0.008 * unit)
    if presence > 0:
        response *= 1.0 + np.float32(presence) * anatomy(lab.shape[:2], points, unit)
    return [*cv2.split(simple), skin, response]


def _skin(lab: Lab, colour: list[float], unit: float) -> Plane:
    """How much each place has the colour of the clip's skin and is not in the dark, 0..1."""
    near = blur(lab, 0.02 * unit)
    tone, a, b = cv2.split(near)
    a -= np.float32(colour[1])
    b -= np.float32(colour[2])
    lit = smoothstep(0.35 * colour[0], 0.6 * colour[0] + 1.0, tone)
    return np.exp((a * a + b * b) * np.float32(-0.5 / SKIN_SPREAD**2)) * lit


def _smooth_skin(lab: Lab, amount: Plane, unit: float) -> Lab:
    """Skin without its small tones, and with a wide, even complexion taken from skin alone."""
    tone = mix(lab[..., 0], blur(lab[..., 0], 0.02 * unit), amount)
    wide = filters.wide_blur(cv2.merge([lab[..., 1] * amount, lab[..., 2] * amount, amount]), 0.06 * unit)
    share = 0.7 * amount / np.maximum(wide[..., 2], 1e-3)
    keep = 1.0 - 0.7 * amount
    return cv2.merge([tone, lab[..., 1] * keep + wide[..., 0] * share, lab[..., 2] * keep + wide[..., 1] * share])


def _shaded(fields: list[Plane], state: dict[str, Any]) -> Lab:
    """Fields to Lab colour: tones gathered into bands, richer chroma, shadows leaning to violet."""
    tone, green_red, blue_yellow, skin = fields
    banded = mix(
        filters.curve_lookup(tone, state["tone_curve"]), filters.curve_lookup(tone, state["skin_curve"]), skin
    )
    shade = smoothstep(2.0, 24.0, np.float32(state["skin"][0]) - banded) * skin
    chroma = mix(np.full_like(tone, 1.22), state["chroma"], skin)
    a = green_red * chroma + 3.5 * shade
    b = blue_yellow * chroma - 1.5 * shade + np.float32(state["warmth"]) * skin
    return cv2.merge([banded, a, b])
