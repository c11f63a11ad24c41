"""Finding faces, their 478 landmarks and the head's matte."""

from toonifygb.face.landmarks import FaceReport, find_landmarks

__all__ = ["FaceReport", "find_landmarks"]
