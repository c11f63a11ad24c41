"""What this build of FFmpeg can write."""

from __future__ import annotations

import av
import av.error


def has_encoder(name: str = "libx264") -> bool:
    """Whether frames can be written with that encoder."""
    try:
        av.Codec(name, "w")
    except av.error.FFmpegError:
        return False
    return True
