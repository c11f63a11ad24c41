"""Frames in, frames out, streaming. The only room that imports av."""

from toonifygb.video.checksum import source_sha256
from toonifygb.video.encoder import has_encoder
from toonifygb.video.join import join
from toonifygb.video.read import Clip, open_clip, probe, read
from toonifygb.video.still import encode_jpeg, load_image, load_rgba, save_png
from toonifygb.video.write import Writer

__all__ = [
    "Clip",
    "Writer",
    "encode_jpeg",
    "has_encoder",
    "join",
    "load_image",
    "load_rgba",
    "open_clip",
    "probe",
    "read",
    "save_png",
    "source_sha256",
]
