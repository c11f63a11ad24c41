"""Landmarks of one person through a clip.

The face is detected once; from then on the square searched in a frame comes from the landmarks of the frame
before, as in MediaPipe's tracking mode. Every ``_LOOK_AROUND`` frames the detector looks whether other faces are
about. After a loss it searches again and continues with the same person, judged by place and size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from toonifygb.errors import FaceError, InputError
from toonifygb.face.detect import FaceFinder, face_square, overlap
from toonifygb.face.mesh import N_LANDMARKS, FaceMesh, face_box, next_square
from toonifygb.progress import SILENT
from toonifygb.structures import Landmarks

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jaxtyping import Float

    from toonifygb.config import FaceConfig
    from toonifygb.progress import Progress
    from toonifygb.structures import Frame

MIN_FACE_PX = 40
"""Narrower faces carry too little to track."""
_LOOK_AROUND = 15
"""Frames between two counts of the faces in view."""
_SEARCH_ALL = 10
"""While no face is known, frames between two searches on every scale; in between only the first level."""
_SETTLE = 2
"""Times the landmarks of a newly found face are found again in the square they give themselves."""
_SAME_PLACE = 0.3
"""Overlap (intersection over union) from which two boxes are taken for one person."""
_MAX_JUMP = 3.0
"""After a loss, the farthest the face may have moved, in face widths; grows with the time of the loss."""
_MAX_SCALE = 2.0
"""… and the largest change of its size."""
_JUMP_GROWTH = 0.1
"""Growth of both tolerances per lost frame."""
_CHOICES = ("largest", "left", "right", "centre")


@dataclass(frozen=True)
class FaceReport:
    """What finding and following one face was like."""

    n_frames: int
    n_found: int
    lost: tuple[tuple[int, int], ...]
    """First and last frame of every stretch without the face."""
    n_faces: int
    """Most faces seen in one of the frames that were looked at for others."""
    crowded: tuple[int, ...]
    """Frames looked at (one in 15) that show further faces."""
    min_width_px: float
    """Narrowest face found, px; NaN when none."""
    median_width_px: float
    best_score: float
    """Highest face presence met, also where it was not enough."""
    problems: tuple[str, ...] = ()
    """What a user should know, one sentence each."""


@dataclass(frozen=True)
class _Face:
    """A face confirmed by the landmark network."""

    points: Float[np.ndarray, "478 2"]
    score: float

    @property
    def box(self) -> Float[np.ndarray, " 4"]:
        return face_box(self.points)

    @property
    def width(self) -> float:
        return float(np.ptp(self.points[:, 0]))

    @property
    def centre(self) -> Float[np.ndarray, " 2"]:
        return (self.box[:2] + self.box[2:]) / 2


def find_landmarks(
    frames: Iterable[Frame],
    config: FaceConfig,
    *,
    n_frames: int | None = None,
    progress: Progress = SILENT,
    device: str = "cpu",
) -> tuple[Landmarks, FaceReport]:
    """Landmarks of one followed person in every frame, and how it went.

    Args:
        frames: the clip, read once, one frame in memory at a time; all of one size.
        config: whom to follow, and what counts as found.
        n_frames: number of frames expected, for ``progress`` only.
        progress: told after every frame.
        device: where the networks run.

    Raises:
        FaceError: no face in the whole clip, the face too small, lost too often, or a face number that is not
            there.
        InputError: ``config.choose`` is not a choice, or the clip has no frame.
    """
    follower = Follower(config, device)
    points, scores = [], []
    height = width = 0
    for index, frame in enumerate(frames):
        height, width = frame.shape[:2]
        face = follower.step(frame)
        points.append(np.full((N_LANDMARKS, 2), np.nan, np.float32) if face is None else face.points)
        scores.append(0.0 if face is None else face.score)
        progress.update(index + 1, n_frames, presence=scores[-1])
    if not points:
        raise InputError("the clip has no frame", "check that the file plays")
    landmarks = Landmarks(
        torch.from_numpy(np.stack(points).astype(np.float32)), torch.tensor(scores), width, height
    )
    report = _report(landmarks, follower)
    _refuse_unusable(report, config)
    return landmarks, report


class Follower:
    """Finds a face once, then follows it frame by frame.

    Args:
        config: whom to follow, and what counts as found.
        device: where the networks run.

    Raises:
        InputError: ``config.choose`` is not a choice.
    """

    def __init__(self, config: FaceConfig, device: str = "cpu") -> None:
        self._choose = _parse_choice(config.choose)
        self._min_score = config.min_score
        self._finder = FaceFinder(device)
        self._mesh = FaceMesh(device)
        self._last: _Face | None = None
        self._rivals: list[Float[np.ndarray, " 4"]] = []
        self._index = -1
        self._lost_for = 0
        self.best_score = 0.0
        self.n_faces = 0
        self.crowded: list[int] = []

    def step(self, frame: Frame) -> _Face | None:
        """The followed face in the next frame; ``None`` where it is not found."""
        self._index += 1
        face = None
        if self._last is not None and not self._lost_for:
            face = self._confirm(frame, [next_square(self._last.points)])[0]
        if face is None:
            face = self._search(frame)
        elif self._index % _LOOK_AROUND == 0:
            self._look_around(frame, face)
        if face is None:
            self._lost_for += 1
        else:
            self._last, self._lost_for = face, 0
        return face

    def _search(self, frame: Frame) -> _Face | None:
        """The followed face, sought in the whole frame."""
        thorough = self._lost_for % _SEARCH_ALL == 0
        for detections in self._finder.levels(frame, thorough=thorough):
            found = self._confirm(frame, [face_square(d) for d in detections], settle=_SETTLE)
            faces = _distinct([face for face in found if face is not None])
            chosen = self._pick(faces, frame.shape[1]) if faces else None
            if chosen is not None:
                self._note(faces, chosen)
                return chosen
        return None

    def _look_around(self, frame: Frame, face: _Face) -> None:
        """Counts the faces beside the followed one."""
        detections = next(self._finder.levels(frame, thorough=False))
        away = [d for d in detections if overlap(d.box.numpy()[None], face.box[None])[0, 0] < _SAME_PLACE / 2]
        found = self._confirm(frame, [face_square(d) for d in away])
        self._note(_distinct([face, *(other for other in found if other is not None)]), face)

    def _note(self, faces: list[_Face], chosen: _Face) -> None:
        self.n_faces = max(self.n_faces, len(faces))
        self._rivals = [face.box for face in faces if face is not chosen]
        if self._rivals:
            self.crowded.append(self._index)

    def _confirm(self, frame: Frame, squares: list, settle: int = 0) -> list[_Face | None]:
        """For each square the face in it, if the landmark network agrees that there is one."""
        faces: list[_Face | None] = []
        for square in squares:
            points, presence = self._mesh.run([frame], [square])
            for _ in range(settle if presence[0] >= self._min_score else 0):
                points, presence = self._mesh.run([frame], [next_square(points[0])])
            self.best_score = max(self.best_score, float(presence[0]))
            faces.append(_Face(points[0], float(presence[0])) if presence[0] >= self._min_score else None)
        return faces

    def _pick(self, faces: list[_Face], image_width: int) -> _Face | None:
        """The face to follow: by the user's choice at first, by place and size after a loss."""
        if self._last is None:
            return _choose(faces, self._choose, image_width)
        last = self._last
        growth = 1 + _JUMP_GROWTH * self._lost_for

        def distance(face: _Face) -> float:
            move = float(np.linalg.norm(face.centre - last.centre)) / last.width / (_MAX_JUMP * growth)
            scale = abs(np.log(face.width / last.width)) / np.log(_MAX_SCALE * growth)
            return max(move, scale)

        known = np.array(self._rivals).reshape(-1, 4)
        strangers = [face for face in faces if not (overlap(face.box[None], known) > _SAME_PLACE).any()]
        best = min(strangers, key=distance, default=None)
        return best if best is not None and distance(best) <= 1 else None


def _parse_choice(text: str) -> str | int:
    """The choice as a word, or as a number counted from 1."""
    if text in _CHOICES:
        return text
    if text.isdecimal() and int(text) >= 1:
        return int(text)
    raise InputError(
        f"'{text}' does not say which face to follow; {', '.join(_CHOICES)} or a number from 1 was expected",
        "1 is the leftmost face",
    )


def _choose(faces: list[_Face], choice: str | int, image_width: int) -> _Face:
    """The face of the user's choice among the faces of one frame."""
    ordered = sorted(faces, key=lambda face: float(face.centre[0]))
    if isinstance(choice, int):
        if choice > len(ordered):
            raise FaceError(
                f"face {choice} was chosen, but the first frame with a face shows {len(ordered)}",
                f"choose a number from 1 to {len(ordered)}, counted from the left",
            )
        return ordered[choice - 1]
    if choice == "left":
        return ordered[0]
    if choice == "right":
        return ordered[-1]
    if choice == "centre":
        return min(ordered, key=lambda face: abs(float(face.centre[0]) - image_width / 2))
    return max(ordered, key=lambda face: face.width)


def _distinct(faces: list[_Face]) -> list[_Face]:
    """The faces without repetitions: several detections may lead to one face."""
    kept: list[_Face] = []
    for face in faces:
        if not any(overlap(face.box[None], other.box[None])[0, 0] > _SAME_PLACE for other in kept):
            kept.append(face)
    return kept


def _report(landmarks: Landmarks, follower: Follower) -> FaceReport:
    valid = landmarks.valid.numpy()
    x = landmarks.points[..., 0].numpy()[valid]
    widths = np.ptp(x, axis=1) if len(x) else np.array([np.nan])
    lost = _stretches(~valid)
    problems = []
    for first, last in lost:
        span = f"frame {first}" if first == last else f"frames {first} to {last}"
        problems.append(f"the face was not found in {span} of {len(valid)}")
    if follower.crowded:
        problems.append(
            f"{follower.n_faces} faces were seen (first in frame {follower.crowded[0]}); one of them is followed"
        )
    if widths.min() < 2 * MIN_FACE_PX:
        problems.append(f"the face is only {widths.min():.0f} px wide at its smallest; details will be missing")
    return FaceReport(
        n_frames=len(valid),
        n_found=int(valid.sum()),
        lost=lost,
        n_faces=follower.n_faces,
        crowded=tuple(follower.crowded),
        min_width_px=float(widths.min()),
        median_width_px=float(np.median(widths)),
        best_score=follower.best_score,
        problems=tuple(problems),
    )


def _stretches(flags: Float[np.ndarray, " t"]) -> tuple[tuple[int, int], ...]:
    """First and last index of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return tuple((int(start), int(end) - 1) for start, end in edges.reshape(-1, 2))


def _refuse_unusable(report: FaceReport, config: FaceConfig) -> None:
    """Raises the error of a clip whose face cannot be tracked."""
    if not report.n_found:
        raise FaceError(
            f"no face was found in {report.n_frames} frames (best score {report.best_score:.2f}, needs "
            f"{config.min_score:.2f})",
            "use a clip that shows one face from the front, at least 40 px wide",
        )
    if report.median_width_px < MIN_FACE_PX:
        raise FaceError(
            f"the face is {report.median_width_px:.0f} px wide; at least {MIN_FACE_PX} px are needed",
            "use a clip in which the face is larger, or the original before it was scaled down",
        )
    share = 1 - report.n_found / report.n_frames
    if share > config.max_lost_share:
        raise FaceError(
            f"the face was lost in {share:.0%} of {report.n_frames} frames; at most "
            f"{config.max_lost_share:.0%} may be",
            "trim the clip to the part that shows the face, or raise face.max_lost_share",
        )
