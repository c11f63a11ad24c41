"""Stage 1 by StyleGANEX: the whole frame, or the surroundings of the face, in the style of a trained network.

What decides a clip's look (scale, box, style codes) is found once, in ``prepare``, and kept as plain numbers; a
frame's picture then depends on that frame alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from toonifygb.errors import InputError
from toonifygb.stylize import filters
from toonifygb.stylize.exaggerate import Exaggeration
from toonifygb.stylize.styleganex.align import FaceMarks, align_face
from toonifygb.stylize.styleganex.frame import EYE_DISTANCE_PX, CropRule, crop_rule, full_rule, published_rule
from toonifygb.stylize.styleganex.paste import paste
from toonifygb.stylize.styleganex.reference import best_frame, first_frame

if TYPE_CHECKING:
    from jaxtyping import UInt8

    from toonifygb.stylize.anchors import Faces
    from toonifygb.stylize.styleganex.engine import Engine

    Frames = UInt8[np.ndarray, "t h w 3"]
    Frame = UInt8[np.ndarray, "h w 3"]

MAX_FULL_PIXELS = 640 * 640
"""Most px of a whole frame at the network's scale for which ``auto`` takes all of it: 4 GB in float32."""
BROAD = 0.35
"""Standard deviation, in eye distances, of the blur that leaves the broad colours of a picture."""


class StyleganexStylizer:
    """Faces drawn anew by a trained network, in their surroundings.

    Args:
        name: of the style.
        description: one line for people.
        engine: the network.
    """

    exaggeration = Exaggeration()

    def __init__(self, name: str, description: str, engine: Engine) -> None:
        self.name, self.description = name, description
        self.denoise = engine.config.calm
        self._engine, self._config = engine, engine.config
        if self._config.codes == "each":
            raise InputError(
                f"setting styleganex.codes is 'each', which framing '{self._config.framing}' cannot use",
                "use best or first, or styleganex.framing=aligned",
            )

    def prepare(self, samples: Frames, faces: Faces) -> dict[str, Any]:
        """Scale, box and style codes of the clip.

        Raises:
            FaceError: no sample shows a face.
        """
        published = self._config.framing == "published"
        wants_best = self._config.codes == "best"
        index = best_frame(samples, faces) if wants_best else first_frame(faces)
        marks = FaceMarks.from_mediapipe(faces.points[index])
        rule = self._rule(marks, faces, samples.shape[1:3], index)
        # As published, the aligned face is cut from the crop, beyond which it is continued by mirroring.
        image = rule.cut(samples[index]) if published else rule.scaled(samples[index])
        corner = (rule.left, rule.top) if published else (0, 0)
        aligned = align_face(image, marks.scaled(rule.scale, corner))
        return {"rule": rule.to_state(), "w_plus": self._engine.codes(aligned.image), "reference": index}

    def apply(self, frames: Frames, faces: Faces, mattes: Any, state: dict[str, Any]) -> Frames:
        """The frames in the style: of the source's size, or as large as the network makes them."""
        rule = CropRule.from_state(state["rule"])
        inputs = np.stack([rule.cut(frame) for frame in frames])
        outputs = self._engine.run(inputs, state["w_plus"])
        return np.stack([self._finished(out, frame, rule) for out, frame in zip(outputs, frames, strict=True)])

    def _rule(self, marks: FaceMarks, faces: Faces, shape: tuple[int, ...], index: int) -> CropRule:
        height, width = shape
        framing = self._config.framing
        if framing == "published":
            return published_rule(marks, height, width)
        full = full_rule(marks.eye_distance, height, width)
        if framing == "full" or (framing == "auto" and full.shape[0] * full.shape[1] <= MAX_FULL_PIXELS):
            return full
        seen = faces.points[faces.presence > 0]
        middles = np.stack([FaceMarks.from_mediapipe(points).eye_middle for points in seen])
        x, y = np.median(middles, axis=0)
        return crop_rule(marks.eye_distance, (float(x), float(y)), height, width)

    def _finished(self, output: Frame, frame: Frame, rule: CropRule) -> Frame:
        """The network's output as a frame of the stylised clip."""
        if self._config.size == "source":
            drawn = paste(output, frame, rule)
            return keep_color(drawn, frame, self._config.source_color, BROAD * rule.eye_distance)
        magnification = self._engine.magnification
        drawn = output[rule.covered(magnification)]
        source = filters.resize(frame[rule.place()], drawn.shape[1], drawn.shape[0])
        return keep_color(drawn, source, self._config.source_color, BROAD * EYE_DISTANCE_PX * magnification)


def keep_color(drawn: Frame, source: Frame, amount: float, sigma_px: float) -> Frame:
    """A stylised frame with some of the source's broad colours put back; lightness stays the style's.

    Args:
        drawn: the stylised frame.
        source: the source frame of the same size.
        amount: 0 leaves it as it is, 1 takes hue and chroma, blurred, from the source.
        sigma_px: standard deviation of the blur that tells colour from drawing.
    """
    if amount <= 0:
        return drawn
    ours, theirs = filters.to_lab(drawn), filters.to_lab(source)
    shift = filters.wide_blur(theirs[..., 1:] - ours[..., 1:], sigma_px) * np.float32(min(amount, 1.0))
    moved = cv2.merge([ours[..., 0], ours[..., 1] + shift[..., 0], ours[..., 2] + shift[..., 1]])
    return filters.to_bytes(filters.to_rgb(moved))
