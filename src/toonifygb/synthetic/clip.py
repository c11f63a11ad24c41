"""A clip of a synthetic person, with the parameters it was made from."""

from __future__ import annotations

import hashlib
import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.cameras import project, tracked_camera
from toonifygb.structures import Landmarks, TrackedSequence
from toonifygb.synthetic.motion import make_motion
from toonifygb.synthetic.room import paint_room
from toonifygb.synthetic.scene import SyntheticFrame, draw

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from jaxtyping import Float32, UInt8

    from toonifygb.structures import HeadMotion
    from toonifygb.synthetic.subject import Subject

WORKERS = min(4, os.cpu_count() or 1)
"""Frames drawn at the same time while a clip is read in order."""
FOCAL_HEIGHTS = 1.42
"""Focal length in image heights: the square cut from what a phone films held at arm's length."""


@dataclass(frozen=True)
class SyntheticClip:
    """Frames, drawn when asked for; each depends on its number alone, so any order and any worker will do."""

    subject: Subject
    sequence: TrackedSequence
    """What a perfect tracker would find: parameters, camera, and the landmarks' true places on the surface."""
    room: Float32[np.ndarray, "h w 3"]
    """The background, sRGB 0..1."""
    threads: int | None = None

    def __len__(self) -> int:
        return self.sequence.n_frames

    def __getitem__(self, index: int) -> SyntheticFrame:
        return draw(
            self.subject, self.sequence.motion[index], self.sequence.camera, self.room, threads=self.threads
        )

    @property
    def frames(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """The pictures alone, in order."""
        return (frame.image for frame in self)

    def __iter__(self) -> Iterator[SyntheticFrame]:
        """All frames in order; a few are drawn ahead, each on a thread of its own."""
        with ThreadPoolExecutor(WORKERS) as pool:
            ahead: deque[Future[SyntheticFrame]] = deque()
            for index in range(len(self)):
                ahead.append(pool.submit(self.__getitem__, index))
                if len(ahead) > WORKERS:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()


def render_clip(
    subject: Subject,
    *,
    n_frames: int = 250,
    size: int | tuple[int, int] = 512,
    fps: float = 25.0,
    seed: int | None = None,
    motion: HeadMotion | None = None,
    threads: int | None = None,
) -> SyntheticClip:
    """A clip of a talking person in a room.

    Args:
        subject: who.
        n_frames: length.
        size: side of the square picture, or (width, height), px.
        fps: frames per second.
        seed: of the motion and the room; the subject's own when ``None``.
        motion: what to show instead of the made-up motion, leading axis = frame; ``n_frames`` is then its length.
        threads: threads of the native rasteriser; the frames do not depend on it.
    """
    width, height = (size, size) if isinstance(size, int) else size
    seed = subject.seed if seed is None else seed
    if motion is None:
        motion = make_motion(subject.head, n_frames, fps, seed)
    truth = _truth(subject, motion, width, height, fps, f"synthetic {subject.seed} {seed} {width}x{height} {fps}")
    return SyntheticClip(subject, truth, paint_room(subject.look, width, height, seed), threads)


def _truth(subject: Subject, motion: HeadMotion, width: int, height: int, fps: float, name: str) -> TrackedSequence:
    """The parameters of a clip as a tracker would report them."""
    camera = tracked_camera(FOCAL_HEIGHTS * height, width, height)
    points, _ = subject.head.landmarks().forward(subject.shape, motion)
    pixels, _ = project(camera, points)
    n_frames = len(pixels)
    tracked = torch.ones(n_frames, dtype=torch.bool)
    return TrackedSequence(
        head_model=subject.head.name,
        shape=subject.shape,
        motion=motion,
        camera=camera,
        landmarks=Landmarks(pixels, tracked.float(), width, height),
        tracked=tracked,
        error_px=torch.zeros(n_frames),
        fps=fps,
        source_sha256=hashlib.sha256(f"{name} {n_frames}".encode()).hexdigest(),
    )
