"""toonifygb: from a selfie video to a stylised, animatable 3D head avatar."""

__version__ = "0.1.0"
