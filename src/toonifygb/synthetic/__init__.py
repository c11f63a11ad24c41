"""People who do not exist, filmed: clips with known truth for demos, tests and benchmarks."""

from __future__ import annotations

from toonifygb.synthetic.clip import SyntheticClip, render_clip
from toonifygb.synthetic.compare import FitErrors, errors
from toonifygb.synthetic.scene import SyntheticFrame
from toonifygb.synthetic.subject import Subject, make_subject

__all__ = ["FitErrors", "Subject", "SyntheticClip", "SyntheticFrame", "errors", "make_subject", "render_clip"]
