"""The style ``none``: the frames as they are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from toonifygb.stylize.exaggerate import Exaggeration

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import UInt8

    from toonifygb.stylize.anchors import Faces

    Frames = UInt8[np.ndarray, "t h w 3"]


class Plain:
    """No style: an avatar that looks like the clip."""

    name = "none"
    description = "the frames as they are"
    exaggeration = Exaggeration()
    denoise = False

    def prepare(self, samples: Frames, faces: Faces) -> dict[str, Any]:
        """Nothing is shared."""
        return {}

    def apply(self, frames: Frames, faces: Faces, mattes: Any, state: dict[str, Any]) -> Frames:
        """The same frames."""
        return frames
