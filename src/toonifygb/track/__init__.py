"""Explaining a clip's landmarks by a head model."""

from toonifygb.track import overlay
from toonifygb.track.files import load, save
from toonifygb.track.fitting import fit, landmark_errors
from toonifygb.track.overlay import Overlay
from toonifygb.track.regions import Boxes, HeadRegion, NeckCuts, head_boxes, neck_cuts
from toonifygb.track.source import Choice, choose_source
from toonifygb.track.steadiness import Report, jitter_px, report

__all__ = [
    "Boxes",
    "Choice",
    "HeadRegion",
    "NeckCuts",
    "Overlay",
    "Report",
    "choose_source",
    "fit",
    "head_boxes",
    "jitter_px",
    "landmark_errors",
    "load",
    "neck_cuts",
    "overlay",
    "report",
    "save",
]
