"""The paper's comparison: the upright face alone, aligned, stylised and put back frame by frame.

Each frame's face is turned upright into 256 px, goes through the network, and returns to its place by the inverse
map, under a mask that fades at its border. Around it the frame stays as it was filmed. It is the simpler
procedure, and steadier landmarks are all that keeps it from trembling.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from toonifygb.errors import InputError
from toonifygb.stylize import filters
from toonifygb.stylize.exaggerate import Exaggeration
from toonifygb.stylize.styleganex.align import FaceMarks, align_face
from toonifygb.stylize.styleganex.reference import best_frame, first_frame
from toonifygb.stylize.styleganex.stylizer import BROAD, keep_color

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

    from toonifygb.stylize.anchors import Faces
    from toonifygb.stylize.styleganex.align import Aligned
    from toonifygb.stylize.styleganex.engine import Engine

    Frames = UInt8[np.ndarray, "t h w 3"]
    Frame = UInt8[np.ndarray, "h w 3"]

FADE = 0.15
"""Width of the strip along the border of the aligned square over which it fades, in sides of the square."""


class AlignedStylizer:
    """Faces drawn anew one by one, in the frame as it was filmed.

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
        if self._config.size != "source":
            raise InputError(
                f"setting styleganex.size is '{self._config.size}', which aligned framing cannot give",
                "use styleganex.size=source, or another framing",
            )

    def prepare(self, samples: Frames, faces: Faces) -> dict[str, Any]:
        """Style codes of the clip; none when each frame has its own.

        Raises:
            FaceError: no sample shows a face.
        """
        index = best_frame(samples, faces) if self._config.codes == "best" else first_frame(faces)
        if self._config.codes == "each":
            return {"reference": index}
        aligned = align_face(samples[index], FaceMarks.from_mediapipe(faces.points[index]))
        return {"w_plus": self._engine.codes(aligned.image), "reference": index}

    def apply(self, frames: Frames, faces: Faces, mattes: Any, state: dict[str, Any]) -> Frames:
        """The frames with their faces stylised; frames without a face as they are."""
        return np.stack(
            [
                self._draw(frame, points, float(presence), state) if presence > 0 else frame
                for frame, points, presence in zip(frames, faces.points, faces.presence, strict=True)
            ]
        )

    def _draw(
        self, frame: Frame, points: Float[np.ndarray, "478 2"], presence: float, state: dict[str, Any]
    ) -> Frame:
        marks = FaceMarks.from_mediapipe(points)
        aligned = align_face(frame, marks)
        codes = state["w_plus"] if "w_plus" in state else self._engine.codes(aligned.image)
        output = self._engine.run(aligned.image[None], codes)[0]
        drawn = put_back(output, aligned, frame, presence)
        return keep_color(drawn, frame, self._config.source_color, BROAD * marks.eye_distance)


def put_back(output: Frame, aligned: Aligned, frame: Frame, presence: float = 1.0) -> Frame:
    """The frame with a stylised aligned face in the place it was taken from.

    Args:
        output: the stylised square, of any size.
        aligned: the face it was made from.
        frame: the frame.
        presence: 0..1, how much of it shows.
    """
    top_left, bottom_left, _, top_right = aligned.quad
    side = float(np.hypot(*(top_right - top_left)))
    small = max(2, min(round(side), output.shape[0]))  # averaging first, so that the warp skips no pixels
    picture = filters.resize(output, small, small)
    ramp = filters.smoothstep(0.0, FADE * small, np.minimum(np.arange(small) + 0.5, small - 0.5 - np.arange(small)))
    mask = np.float32(presence) * (ramp[:, None] * ramp[None, :]).astype(np.float32)
    right, down = (top_right - top_left) / small, (bottom_left - top_left) / small
    # centres of pixels lie at half-integers in the quad and at integers for OpenCV
    origin = top_left + 0.5 * (right + down) - 0.5
    matrix = np.stack([right, down, origin], axis=1)
    size = frame.shape[1], frame.shape[0]
    warped = cv2.warpAffine(picture, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    weight = cv2.warpAffine(mask, matrix, size, flags=cv2.INTER_LINEAR)
    mixed = filters.mix(frame.astype(np.float32), warped.astype(np.float32), weight)
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
