"""toonifygb: from a selfie video to a stylised, animatable 3D head avatar."""

import os

# MKL, which torch uses for linear algebra, rounds differently when an array happens to start at another address. In
# this mode equal inputs give equal bits, so that a resumed run ends with the same files as an uninterrupted one.
os.environ.setdefault("MKL_CBWR", "AVX2,STRICT")

__version__ = "0.1.0"
