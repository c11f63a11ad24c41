"""A style run over a clip: frames in, the same number of frames out, never more than a few in memory.

Around the style itself this does what all styles share: landmarks are steadied over the whole clip, source frames
are calmed in time, the caricature is applied, and the result is blended with the (equally warped) original.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from toonifygb.errors import InputError
from toonifygb.stylize import steady
from toonifygb.stylize.anchors import Faces, follow
from toonifygb.stylize.exaggerate import Exaggeration, move_points, warp

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from jaxtyping import Float, UInt8

    from toonifygb.structures import Landmarks
    from toonifygb.stylize.base import Stylizer

    Frame = UInt8[np.ndarray, "h w 3"]
    Frames = UInt8[np.ndarray, "t h w 3"]
    Matte = Float[np.ndarray, "h w"]

SAMPLES = 12
"""Frames of a clip that ``prepare`` looks at."""


def prepare(
    frames: Iterable[Frame], landmarks: Landmarks, stylizer: Stylizer, *, strength: float = 1.0
) -> dict[str, Any]:
    """What the style keeps constant over the clip, from ``SAMPLES`` frames spread evenly over it.

    Args:
        frames: the clip from its first frame; read no further than the last sample.
        landmarks: of the whole clip; frames without a face are NaN.
        stylizer: the style.
        strength: as for ``stylize_frames``.

    Raises:
        InputError: the clip has no frames.
    """
    total = landmarks.points.shape[0]
    chosen = sorted({int(index) for index in np.linspace(0, max(total - 1, 0), SAMPLES).round()})
    samples, kept = [], []
    wanted = set(chosen)
    for index, frame in enumerate(islice(frames, chosen[-1] + 1)):
        if index in wanted:
            samples.append(frame)
            kept.append(index)
    if not samples or total == 0:
        raise InputError("the clip has no frames; a style needs at least one", "check that the video plays")
    amount = stylizer.exaggeration.scaled(_checked(strength))
    warped, faces, _ = _warped(samples, follow(landmarks)[kept], None, amount)
    return stylizer.prepare(warped, faces)


def stylize_frames(
    frames: Iterable[Frame],
    landmarks: Landmarks,
    stylizer: Stylizer,
    state: dict[str, Any],
    *,
    strength: float = 1.0,
    mattes: Iterable[Matte] | None = None,
    chunk: int = 8,
    start: int = 0,
) -> Iterator[Frame]:
    """The clip in the given style, frame by frame.

    Args:
        frames: the clip from its first frame, all of one size.
        landmarks: of the whole clip; frames without a face are NaN.
        stylizer: the style.
        state: what ``prepare`` returned for this clip.
        strength: 0 gives the frames back bit for bit; between, geometry and colour are blended together.
        mattes: person mattes beside the frames.
        chunk: frames handed to the style at once; changes memory, never the result.
        start: first frame to deliver; those before it are read and passed over, the rest is as it would have been.

    Raises:
        InputError: ``strength`` outside 0..1, more frames than landmarks, or a partial strength of a style that
            changes the size of the frames.
    """
    amount = stylizer.exaggeration.scaled(_checked(strength))
    faces = follow(landmarks)
    pairs = _counted(frames, mattes, len(faces))
    if strength == 0:
        yield from (frame for index, frame, _ in pairs if index >= start)
        return
    reach = steady.RADIUS if stylizer.denoise else 0
    near = (each for each in pairs if each[0] >= start - reach)
    calm = _calmed(near) if stylizer.denoise else ((*each, each[1]) for each in near)
    source = (each for each in calm if each[0] >= start)
    while batch := list(islice(source, max(1, chunk))):
        indices = [index for index, *_ in batch]
        planes = None if mattes is None else [matte for _, _, matte, _ in batch if matte is not None]
        clean, moved, planes = _warped([calm for *_, calm in batch], faces[indices], planes, amount)
        drawn = stylizer.apply(clean, moved, planes, state)
        for position, (index, frame, _, _) in enumerate(batch):
            if strength == 1:
                yield drawn[position]
            else:
                original = _warp_frame(frame, faces, index, amount)
                yield _blend(original, drawn[position], strength)


def warp_landmarks(landmarks: Landmarks, stylizer: Stylizer, strength: float = 1.0) -> Landmarks:
    """Landmarks of the clip carried to where the style's caricature puts them.

    The warp follows steadied landmarks but moves the measured ones, so fitting the result to stylised frames is as
    exact as fitting the originals to the original frames.
    """
    amount = stylizer.exaggeration.scaled(_checked(strength))
    faces = follow(landmarks)
    points = landmarks.points.detach().cpu().numpy().astype(np.float32)
    moved = [
        move_points(each, amount.scaled(float(presence)), anchors)
        for each, anchors, presence in zip(points, faces.points, faces.presence, strict=True)
    ]
    carried = torch.from_numpy(np.stack(moved)) if moved else landmarks.points
    return replace(landmarks, points=carried.to(landmarks.points))


def warp_frames(
    frames: Iterable[Frame], landmarks: Landmarks, stylizer: Stylizer, strength: float = 1.0
) -> Iterator[Frame]:
    """The filmed frames with the caricature alone: photographs whose outlines are those of the drawn frames.

    Mattes found in them fit the drawn frames, where a slimmer chin would leave a rim of background in a matte of
    the originals.
    """
    amount = stylizer.exaggeration.scaled(_checked(strength))
    faces = follow(landmarks)
    for index, frame in enumerate(frames):
        yield _warp_frame(frame, faces, index, amount)


def _checked(strength: float) -> float:
    if not 0.0 <= strength <= 1.0:
        raise InputError(f"strength {strength:g} is outside 0..1", "use 0 for the original, 1 for the full style")
    return strength


def _counted(
    frames: Iterable[Frame], mattes: Iterable[Matte] | None, n_landmarks: int
) -> Iterator[tuple[int, Frame, Matte | None]]:
    """Frames with their number and matte."""
    planes = None if mattes is None else iter(mattes)
    for index, frame in enumerate(frames):
        if index >= n_landmarks:
            raise InputError(
                f"the clip goes on after frame {n_landmarks - 1}, the last with landmarks",
                "find landmarks on the same frames that are stylised",
            )
        matte = None if planes is None else next(planes, None)
        if planes is not None and matte is None:
            raise InputError(f"frame {index} has no matte", "compute mattes on the same frames that are stylised")
        yield index, frame, matte


def _calmed(
    pairs: Iterable[tuple[int, Frame, Matte | None]],
) -> Iterator[tuple[int, Frame, Matte | None, Frame]]:
    """Each frame with its calmed version appended; reads ``steady.RADIUS`` frames ahead."""
    window: deque[tuple[int, Frame, Matte | None]] = deque(maxlen=2 * steady.RADIUS + 1)
    done = -1  # number of the next frame to hand on
    for item in pairs:
        done = item[0] if done < 0 else done
        window.append(item)
        if item[0] - done == steady.RADIUS:
            yield _calmed_item(window, done)
            done += 1
    while window and done <= window[-1][0]:
        yield _calmed_item(window, done)
        done += 1


def _calmed_item(
    window: deque[tuple[int, Frame, Matte | None]], number: int
) -> tuple[int, Frame, Matte | None, Frame]:
    near = [item for item in window if abs(item[0] - number) <= steady.RADIUS]
    index = next(place for place, item in enumerate(near) if item[0] == number)
    return (*near[index], steady.calmed([frame for _, frame, _ in near], index))


def _warped(
    frames: Sequence[Frame], faces: Faces, mattes: Sequence[Matte] | None, amount: Exaggeration
) -> tuple[Frames, Faces, Float[np.ndarray, "t h w"] | None]:
    """Frames, landmarks and mattes with the caricature applied."""
    everyone = range(len(frames))
    pictures = np.stack([_warp_frame(frames[i], faces, i, amount) for i in everyone])
    planes = None
    if mattes is not None:
        planes = np.clip(np.stack([_warp_frame(mattes[i], faces, i, amount) for i in everyone]), 0.0, 1.0)
    points = [move_points(faces.points[i], amount.scaled(float(faces.presence[i]))) for i in everyone]
    return pictures, Faces(np.stack(points), faces.presence), planes


def _warp_frame(image: np.ndarray, faces: Faces, index: int, amount: Exaggeration) -> np.ndarray:
    presence = float(faces.presence[index])
    return warp(image, faces.points[index], amount.scaled(presence)) if presence > 0 else image


def _blend(original: Frame, drawn: Frame, strength: float) -> Frame:
    if original.shape != drawn.shape:
        raise InputError(
            f"strength {strength:g} blends frames with the source, and this style makes frames of another size",
            "use strength 1, or a setting of the style that keeps the size",
        )
    mixed = original.astype(np.float32) * np.float32(1.0 - strength) + drawn * np.float32(strength)
    return np.rint(mixed).astype(np.uint8)
