"""Tracked heads as other projects keep them on disk: read into our track and pictures, and written for them."""

from toonifygb.datasets.export import Crops, Exported, export_dataset
from toonifygb.datasets.folders import LAYOUTS, ForeignFolder, ForeignTrack, Picture, read_picture
from toonifygb.datasets.reading import FPS, read_track, recognize

__all__ = [
    "FPS",
    "LAYOUTS",
    "Crops",
    "Exported",
    "ForeignFolder",
    "ForeignTrack",
    "Picture",
    "export_dataset",
    "read_picture",
    "read_track",
    "recognize",
]
