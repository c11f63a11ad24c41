"""Stage 2: training the avatar against a tracked clip."""

from __future__ import annotations

from toonifygb.train.data import Dataset, build_dataset, crop, crop_boxes, load_dataset, split_frames
from toonifygb.train.evaluate import evaluate
from toonifygb.train.loop import first_avatar, train
from toonifygb.train.photometric import refine_track

__all__ = [
    "Dataset",
    "build_dataset",
    "crop",
    "crop_boxes",
    "evaluate",
    "first_avatar",
    "load_dataset",
    "refine_track",
    "split_frames",
    "train",
]
