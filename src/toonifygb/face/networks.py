"""The shipped networks by name, and their fingerprints.

All four come from MediaPipe 0.10.21 (Apache-2.0), converted by ``tools/build_face_weights.py``:

* ``detector_near``: BlazeFace short range, 128 px, faces of about 10 % of the image and more
* ``detector_far``: BlazeFace full range, 192 px, smaller faces
* ``landmarks``: attention mesh, 192 px, 478 points
* ``person``: selfie segmentation (general), 256 px
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from toonifygb.face.graph import Graph, load_graph

DATA = Path(__file__).parent / "data"
Name = Literal["detector_near", "detector_far", "landmarks", "person"]
SHA256: dict[Name, str] = {
    "detector_near": "124881f0d2d85cd62028ca55d9e6c641c015b443ba117c3039439fb5092bff22",
    "detector_far": "930113e49d4e10078c44df0d91744200a0a1f36f15a93092166e160b1b5591f7",
    "landmarks": "d025efb55e548b66bb5dad8ef071cfbb03083aab60c4b136ed08f5c7ab5231e0",
    "person": "c1e18b6c966fb0d6f933d590210b75703a6ecafd704c04c175d3109c54bb22ca",
}


def load_network(name: Name, device: str = "cpu") -> Graph:
    """The shipped network of that name on ``device``."""
    return load_graph(DATA / f"{name}.safetensors").to(device)
