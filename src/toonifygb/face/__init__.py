"""Finding faces, their 478 landmarks and the head's matte."""

from toonifygb.face.landmarks import FaceReport, Follower, find_landmarks
from toonifygb.face.matting import PersonSegmenter, foreground, head_matte

__all__ = ["FaceReport", "Follower", "PersonSegmenter", "find_landmarks", "foreground", "head_matte"]
