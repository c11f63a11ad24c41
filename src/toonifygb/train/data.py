"""The training set: square head crops with their mattes, kept as uint8 on disk and read by number.

A clip of any length streams through ``build_dataset`` once; afterwards a frame is one page-cached read. All crops
of a clip have the same size in source pixels. The box stands still where one box holds the head throughout, else it
follows the head smoothly; each frame's camera is cropped with it, so the world never changes.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from numpy.lib.format import open_memmap

from toonifygb.atomic import replacing
from toonifygb.errors import InputError
from toonifygb.geometry.cameras import crop_camera, project
from toonifygb.progress import SILENT
from toonifygb.render.fused import place
from toonifygb.structures import Camera, Split

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jaxtyping import Float, Int, UInt8
    from torch import Tensor

    from toonifygb.config import TrainConfig
    from toonifygb.head import HeadModel
    from toonifygb.progress import Progress
    from toonifygb.structures import TrackedSequence
    from toonifygb.track import NeckCuts

FORMAT = "toonifygb-dataset"
FRAMES, MATTES, FACTS = "frames.npy", "mattes.npy", "dataset.json"
_HAIR_MARGIN = 0.12
"""Room above the bald mesh for hair, and half of it on either side, in units of the mesh's height."""
_WIDEN = 1.25
_FOLLOW_SECONDS = 0.6
"""Standard deviation of the smoothing of a moving crop box."""
_LOOK_EVERY = 5
"""Frames between those whose mesh is projected to place the crop."""


@dataclass(frozen=True)
class Dataset:
    """Random access to the crops of a clip."""

    folder: Path
    frames: UInt8[np.ndarray, "t s s 3"]
    """sRGB crops, memory-mapped."""
    mattes: UInt8[np.ndarray, "t s s"]
    """Head mattes, 255 = head, memory-mapped."""
    boxes: Int[np.ndarray, "t 4"]
    """left, top, right, bottom of each crop in px of the full frame."""
    full_camera: Camera
    split: Split
    fingerprint: str
    """Changes with everything the crops depend on."""
    cuts: NeckCuts | None = None
    """Where the neck ends in every crop; what lies below is not the head's."""
    reduction: int = 1
    """Targets are smaller than the stored crops by this whole factor."""

    @property
    def n_frames(self) -> int:
        """Number of crops, those in neither set included."""
        return len(self.frames)

    @property
    def size(self) -> int:
        """Side of a target, px."""
        return self.frames.shape[1] // self.reduction

    def reduced(self, factor: int) -> Dataset:
        """The same frames seen smaller by a whole factor that divides their size; nothing is copied."""
        return replace(self, reduction=self.reduction * factor)

    def cut_at(self, cuts: NeckCuts) -> Dataset:
        """The same frames with the necks ending where a track has them end, px of the full frame."""
        within = cuts.within(torch.from_numpy(self.boxes).float(), self.frames.shape[1])
        digest = hashlib.sha256(torch.cat([within.normal, within.reach[:, None]], 1).numpy().tobytes()).hexdigest()
        return replace(self, cuts=within, fingerprint=f"{self.fingerprint} {digest}")

    def camera(self, index: int) -> Camera:
        """Camera of one crop."""
        left, top, right, bottom = (float(edge) for edge in self.boxes[index])
        return crop_camera(self.full_camera, (left, top, right, bottom), self.size)

    def target(
        self, index: int, device: torch.device | str = "cpu"
    ) -> tuple[Float[Tensor, "s s 3"], Float[Tensor, "s s"]]:
        """What a render of this frame should be: colour × matte on black, 0..1, and the matte."""
        frame, matte = self.pixels(index, device)
        return place(frame, matte, matte.new_zeros(3), self.reduction)

    def pixels(
        self, index: int, device: torch.device | str = "cpu"
    ) -> tuple[UInt8[Tensor, "y y 3"], Float[Tensor, "y y"]]:
        """The stored crop of a frame, and its matte 0..1 that ends with the neck; not reduced.

        Bytes travel to the device, a quarter of what the floats would be.
        """
        matte = torch.tensor(self.mattes[index]).to(device).float().div_(255)
        if self.cuts is not None:
            first, kept = self.cuts.rows(index, *matte.shape)
            matte[first:] *= kept.to(device)
        return torch.tensor(self.frames[index]).to(device), matte


def build_dataset(
    pairs: Iterable[tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]],
    sequence: TrackedSequence,
    head: HeadModel,
    config: TrainConfig,
    out_dir: Path | str,
    *,
    progress: Progress = SILENT,
) -> Dataset:
    """Crops every frame and writes the training set; a complete one with the same settings is taken as it is.

    Args:
        pairs: frame uint8 RGB and head matte 0..1 of the same size, in clip order, one per tracked frame.
        sequence: the track; its camera and its lost frames.
        head: the head model of the track.
        config: ``resolution``, ``crop_scale``, ``test_share`` and ``max_test_frames`` are used.
        out_dir: created when absent.
        progress: told after every frame.

    Raises:
        InputError: the clip ends before the track does.
    """
    folder = Path(out_dir)
    wanted = _fingerprint(sequence, config)
    if (folder / FACTS).is_file() and _read_facts(folder).get("fingerprint") == wanted:
        return load_dataset(folder)
    folder.mkdir(parents=True, exist_ok=True)
    boxes = crop_boxes(sequence, head, config.crop_scale, config.resolution)
    _write_crops(pairs, boxes, config.resolution, folder, progress)
    split = split_frames(sequence, config)
    facts = {
        "format": FORMAT,
        "fingerprint": wanted,
        "boxes": boxes.tolist(),
        "camera": {
            "K": sequence.camera.K.tolist(),
            "world_to_camera": sequence.camera.world_to_camera.tolist(),
            "size": [sequence.camera.width, sequence.camera.height],
        },
        "train": list(split.train),
        "test": list(split.test),
    }
    with replacing(folder / FACTS) as note:
        note.write_text(json.dumps(facts) + "\n", encoding="utf-8")
    return load_dataset(folder)


def load_dataset(folder: Path | str) -> Dataset:
    """Opens a training set written by ``build_dataset``.

    Raises:
        InputError: the folder holds none or a damaged one.
    """
    folder = Path(folder)
    facts = _read_facts(folder)
    try:
        frames = np.load(folder / FRAMES, mmap_mode="r")
        mattes = np.load(folder / MATTES, mmap_mode="r")
    except (OSError, ValueError) as error:
        raise InputError(
            f"the training set in {folder} is damaged ({error})", "delete the folder and run again"
        ) from error
    boxes = np.asarray(facts["boxes"], np.int64)
    if not len(frames) == len(mattes) == len(boxes):
        raise InputError(
            f"the training set in {folder} holds {len(frames)} frames, {len(mattes)} mattes and {len(boxes)} "
            "boxes; expected equal counts",
            "delete the folder and run again",
        )
    camera = facts["camera"]
    return Dataset(
        folder=folder,
        frames=frames,
        mattes=mattes,
        boxes=boxes,
        full_camera=Camera(torch.tensor(camera["K"]), torch.tensor(camera["world_to_camera"]), *camera["size"]),
        split=Split(tuple(facts["train"]), tuple(facts["test"])),
        fingerprint=json.dumps(facts["fingerprint"], sort_keys=True),
    )


def split_frames(sequence: TrackedSequence, config: TrainConfig) -> Split:
    """The end of the clip is held out, or that of every part; frames where the face was lost are in neither set."""
    n = sequence.n_frames
    n_test = min(config.max_test_frames, round(config.test_share * n))
    bounds = np.linspace(0, n, config.test_parts + 1).round().astype(int)
    each = np.diff(np.linspace(0, n_test, config.test_parts + 1).round().astype(int))
    held_out = {i for end, count in zip(bounds[1:], each, strict=True) for i in range(end - count, end)}
    usable = [index for index in range(n) if bool(sequence.tracked[index])]
    return Split(
        tuple(index for index in usable if index not in held_out),
        tuple(index for index in usable if index in held_out),
    )


def crop_boxes(
    sequence: TrackedSequence, head: HeadModel, crop_scale: float, resolution: int = 1
) -> Int[np.ndarray, "t 4"]:
    """Square crop of every frame, px of the full frame, all of one size and inside the frame.

    The side is ``crop_scale`` face boxes, or up to ``_WIDEN`` times that where this saves magnifying the picture to
    ``resolution`` px: invented pixels cost as much to train on as filmed ones. Where the mesh with room for hair
    stays within one such box over the whole clip, that box is used for every frame; else the box follows the mesh
    smoothly.
    """
    width, height = sequence.camera.width, sequence.camera.height
    points = sequence.landmarks.points[sequence.tracked & sequence.landmarks.valid]
    if len(points) == 0:
        raise InputError("the track has no frame with a face", "choose a clip that shows a face")
    extent = (points.amax(1) - points.amin(1)).amax(-1)
    wanted = round(float(extent.median()) * crop_scale)
    side = min(max(wanted, min(resolution, int(_WIDEN * wanted))), width, height)
    bounds = _head_bounds(sequence, head)
    union = np.concatenate([bounds[:, :2].min(0), bounds[:, 2:].max(0)])
    if max(union[2] - union[0], union[3] - union[1]) <= side:
        centres = np.repeat(_centre(union[None]), sequence.n_frames, axis=0)
    else:
        centres = _smooth(_centre(bounds), _FOLLOW_SECONDS * sequence.fps)
    corner = np.clip(np.rint(centres - side / 2), 0, [width - side, height - side]).astype(np.int64)
    return np.concatenate([corner, corner + side], axis=1)


def _head_bounds(sequence: TrackedSequence, head: HeadModel) -> Float[np.ndarray, "t 4"]:
    """Box around the projected mesh with room for hair, px, in every frame; interpolated between looks."""
    looks = np.unique(np.append(np.arange(0, sequence.n_frames, _LOOK_EVERY), sequence.n_frames - 1))
    found = []
    for index in looks:
        vertices, _ = head.forward(sequence.shape, sequence.motion[int(index)])
        pixels, _ = project(sequence.camera, vertices)
        low, high = pixels.amin(0).numpy(), pixels.amax(0).numpy()
        margin = _HAIR_MARGIN * (high[1] - low[1])
        found.append([low[0] - margin / 2, low[1] - margin, high[0] + margin / 2, high[1]])
    table = np.asarray(found)
    every = np.arange(sequence.n_frames)
    return np.stack([np.interp(every, looks, table[:, side]) for side in range(4)], axis=1)


def _centre(bounds: Float[np.ndarray, "t 4"]) -> Float[np.ndarray, "t 2"]:
    return 0.5 * (bounds[:, :2] + bounds[:, 2:])


def _smooth(values: Float[np.ndarray, "t c"], sigma: float) -> Float[np.ndarray, "t c"]:
    """Gaussian smoothing over time with the ends held."""
    reach = max(1, int(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    columns = [np.convolve(padded[:, c], kernel / kernel.sum(), mode="valid") for c in range(values.shape[1])]
    return np.stack(columns, axis=1)


def _write_crops(
    pairs: Iterable[tuple[np.ndarray, np.ndarray]],
    boxes: Int[np.ndarray, "t 4"],
    size: int,
    folder: Path,
    progress: Progress,
) -> None:
    n, done = len(boxes), 0
    with replacing(folder / FRAMES) as frames_path, replacing(folder / MATTES) as mattes_path:
        frames = open_memmap(frames_path, mode="w+", dtype=np.uint8, shape=(n, size, size, 3))
        mattes = open_memmap(mattes_path, mode="w+", dtype=np.uint8, shape=(n, size, size))
        for frame, matte in pairs:
            if done == n:
                break
            frames[done] = crop(frame, boxes[done], size)
            # Rounded before resizing: mattes are judged at 8 bits anyway and uint8 resizing is four times faster.
            mattes[done] = crop(np.rint(matte * 255).astype(np.uint8), boxes[done], size)
            done += 1
            progress.update(done, n)
        if done < n:
            raise InputError(f"the clip ends after {done} frames but was tracked for {n}", "track the clip again")
        frames.flush()
        mattes.flush()


def crop(image: UInt8[np.ndarray, "h w *c"], box: Int[np.ndarray, " 4"], size: int) -> UInt8[np.ndarray, "s s *c"]:
    """The box of an image at the training size; area averaging downwards, cubic upwards."""
    left, top, right, bottom = (int(edge) for edge in box)
    method = cv2.INTER_AREA if right - left >= size else cv2.INTER_CUBIC
    return cv2.resize(image[top:bottom, left:right], (size, size), interpolation=method)


def _fingerprint(sequence: TrackedSequence, config: TrainConfig) -> dict[str, Any]:
    """What the crops depend on; a set made from anything else is made again."""
    motion = sequence.motion
    total = float(motion.joints.double().sum() + motion.translation.double().sum() + sequence.shape.double().sum())
    return {
        "source": sequence.source_sha256,
        "n_frames": sequence.n_frames,
        "track": total,
        "resolution": config.resolution,
        "crop_scale": config.crop_scale,
        "test_share": config.test_share,
        "max_test_frames": config.max_test_frames,
        "test_parts": config.test_parts,
    }


def _read_facts(folder: Path) -> dict[str, Any]:
    path = folder / FACTS
    if not path.is_file():
        raise InputError(f"no training set in {folder}: {FACTS} is missing", "build it first")
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON ({error})", "delete the folder and run again") from error
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise InputError(f"{path} does not describe a training set", "delete the folder and run again")
    return facts
