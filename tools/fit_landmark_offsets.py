"""Measures how far off the surface the landmarks lie; writes ``open_head/landmark_offsets.csv``.

``fit_landmark_embedding.py`` pins each landmark to the surface. The face network's idea of it may lie beside that
point by the same millimetre or two in every picture (above all along the outline of the face), and it slides a
little as the head turns. Here random heads are rendered again and each landmark's miss, in the head's axes, is
fitted as a constant plus a part that is linear in the direction of the view. Only the constant is kept, made
symmetric: the sliding differs between bald clay heads and people.

    python tools/fit_landmark_offsets.py
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from fit_landmark_embedding import N_MESH, paint, random_view
from open_head.landmarks import OFFSETS

from toonifygb import head
from toonifygb.face.crop import Square
from toonifygb.face.mesh import FaceMesh, next_square
from toonifygb.geometry import cameras, meshes
from toonifygb.geometry.align import kabsch
from toonifygb.render.mesh import render_clay

SEED = 5
FAR_M = 0.006
"""Misses of about this size count a quarter."""
RIDGE = 0.25
"""Pull of the fit towards zero, in renders."""


@dataclass(frozen=True)
class Misses:
    """What n renders showed."""

    miss: np.ndarray
    """Detected minus true landmark in the image plane, m (n, 468, 2), x right, y up."""
    to_image: np.ndarray
    """Head axes to those of the image plane (n, 2, 3)."""
    view: np.ndarray
    """1, yaw and pitch of the camera seen from the head, rad (n, 3)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--renders", type=int, default=300)
    parser.add_argument("--out", type=Path, default=OFFSETS)
    options = parser.parse_args()
    model = head.load("open")
    misses = observe(model, options.renders)
    mirror = model.landmark_mirror[:N_MESH].numpy()
    constant = np.stack([fit_one(misses, landmark)[0] for landmark in range(N_MESH)])
    balanced = (constant + constant[mirror] * (-1, 1, 1)) / 2
    with options.out.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow("landmark x_mm y_mm z_mm".split())
        for landmark, offset in enumerate(1000 * balanced):
            table.writerow([landmark, *(f"{value:.2f}" for value in offset)])
    left = np.abs(constant - balanced).mean() * 1000
    print(f"mean offset {1000 * np.linalg.norm(balanced, axis=1).mean():.2f} mm, asymmetry {left:.2f} mm")


def observe(model: head.HeadModel, count: int) -> Misses:
    """Render random heads and compare detected with true landmarks."""
    random, network = np.random.default_rng(SEED), FaceMesh()
    rows = []
    skull = (model.skin_weights[:, 1] > 0.99) & (model.regions["face"] < 0.5)
    for _ in range(count):
        vertices, camera = random_view(model, random)
        normals = meshes.vertex_normals(vertices, model.faces)
        image = render_clay(vertices, model.faces, normals, camera, colors=paint(model, random))
        color = image.color + (1 - image.alpha)[..., None] * float(random.uniform(0.2, 0.9))
        frame = (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        pixels, _ = cameras.project(camera, vertices)
        face = pixels[model.regions["face"] > 0.5].numpy()
        low, high = face.min(0), face.max(0)
        square = Square(*((low + high) / 2).tolist(), 1.5 * float((high - low).max()))
        for _ in range(3):
            points, presence = network.run([frame], [square])
            square = next_square(points[0])
        if presence[0] < 0.5:
            continue
        corners = vertices[model.faces[model.landmark_faces[:N_MESH]]]
        true = (corners * model.landmark_bary[:N_MESH, :, None]).sum(1)
        rotation, _ = kabsch(model.template[skull], vertices[skull])
        found, depth = cameras.project(camera, true)
        off = (torch.from_numpy(points[0, :N_MESH]) - found) * (depth / camera.K[0, 0])[:, None]
        towards = torch.nn.functional.normalize(-true.mean(0), dim=0) @ rotation
        angles = (1.0, float(torch.atan2(towards[0], towards[2])), float(torch.asin(towards[1])))
        rows.append((off.numpy() * (1, -1), rotation[:2].numpy(), np.array(angles)))
    return Misses(*(np.stack(column) for column in zip(*rows, strict=True)))


def fit_one(misses: Misses, landmark: int) -> np.ndarray:
    """Constant, yaw and pitch part of one landmark's miss in the head's axes, m (3, 3), by weighted ridge."""
    miss = misses.miss[:, landmark]
    design = np.einsum("nf,nac->nafc", misses.view, misses.to_image).reshape(len(miss), 2, 9)
    weight = (1 + np.square(miss).sum(1) / FAR_M**2) ** -2
    weighed = (design * weight[:, None, None]).reshape(-1, 9)
    normal = weighed.T @ design.reshape(-1, 9) + RIDGE * np.eye(9)
    return np.linalg.solve(normal, weighed.T @ miss.reshape(-1)).reshape(3, 3)


if __name__ == "__main__":
    main()
