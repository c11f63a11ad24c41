"""From landmarks to a tracked sequence: who it is, then how that person moved.

The identity and the focal length are learned from a few dozen frames that differ most; with both held, every
frame is fitted, in overlapping stretches so that memory does not grow with the clip. Frames without a face, and
frames whose landmarks no head explains, are bridged between their neighbours and marked.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import torch

from toonifygb.errors import FaceError, InputError
from toonifygb.geometry import cameras
from toonifygb.progress import SILENT, Progress
from toonifygb.structures import TrackedSequence
from toonifygb.threads import one_torch_thread
from toonifygb.track import gaps
from toonifygb.track.energy import LandmarkEnergy, Observation, make_prior, project
from toonifygb.track.model import LandmarkModel, PoseState
from toonifygb.track.neck import on_a_neck
from toonifygb.track.solve import FocalBelief, Shared, make_acceleration, solve_identity, solve_motion
from toonifygb.track.start import diverse_frames, face_size, initial_poses

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from toonifygb.config import TrackConfig
    from toonifygb.head import HeadModel
    from toonifygb.structures import Landmarks

log = logging.getLogger(__name__)

KEYFRAMES = 64
"""Frames the identity is learned from; more change it by less than the landmarks' own bias."""
CHUNK = 384
"""Frames whose motion is solved together."""
HALO = 24
"""Frames of overlap on either side, solved and thrown away: what a frame feels of its neighbours has died out."""
ERROR_FACE_PX = 230.0
"""Face size to which reported errors are scaled: that of a portrait in a 512 px image."""
FACE_HEIGHT = 0.185
"""Longer side of the landmarks' box on an average head, m."""


def fit(
    landmarks: Landmarks,
    head: HeadModel,
    config: TrackConfig,
    *,
    fps: float,
    source_sha256: str,
    focal_px: float | None = None,
    progress: Progress = SILENT,
) -> TrackedSequence:
    """Explains the landmarks of a clip by a head model; equal inputs give equal bits.

    Args:
        landmarks: of the whole clip; frames without a face are NaN.
        head: the head model.
        config: coefficients and iterations.
        fps: frame rate of the clip; it sets how much motion between frames is believable.
        source_sha256: checksum of the clip, kept in the result.
        focal_px: focal length if known, px; otherwise estimated near what such a picture is usually taken with.
        progress: told the number of fitted frames.

    Raises:
        FaceError: no frame shows a face.
        InputError: a focal length or frame rate that is not positive.
    """
    _check(landmarks, fps, focal_px)
    # Linear algebra rounds differently with the arrays' alignment and the number of threads. Copies made by torch
    # are always aligned.
    with one_torch_thread():
        return _fit(
            landmarks.map(torch.clone), head.map(torch.clone), config, fps, source_sha256, focal_px, progress
        )


def _fit(
    landmarks: Landmarks,
    head: HeadModel,
    config: TrackConfig,
    fps: float,
    source_sha256: str,
    focal_px: float | None,
    progress: Progress,
) -> TrackedSequence:
    """What ``fit`` does, on aligned arrays and one thread."""
    valid = landmarks.valid & ~gaps.jumps(landmarks.points, fps)
    clip = _Clip(landmarks, head, config, fps)
    frames = valid.nonzero()[:, 0]
    shared = clip.learn_identity(frames, focal_px)
    person = clip.model.with_identity(shared.shape)
    state = clip.follow(person, shared.log_focal, frames, progress)
    error = clip.error_px(person, shared.log_focal, frames, state)
    explained = ~gaps.misfits(error)
    if not bool(explained.all()):
        frames, error = frames[explained], error[explained]
        state = clip.follow(person, shared.log_focal, frames, progress)
        error = clip.error_px(person, shared.log_focal, frames, state)
    n_frames = landmarks.points.shape[0]
    tracked = torch.zeros(n_frames, dtype=torch.bool).index_fill_(0, frames, True)
    errors = torch.full((n_frames,), torch.nan).index_copy_(0, frames, error)
    shape = torch.nn.functional.pad(shared.shape, (0, head.n_shape - shared.shape.shape[0]))
    motion = gaps.bridged(person.to_motion(shared.shape[:0], state), frames, n_frames)
    return TrackedSequence(
        head_model=head.name,
        shape=shape,
        motion=on_a_neck(motion, head, shape),
        camera=cameras.tracked_camera(float(shared.log_focal.exp()), landmarks.width, landmarks.height),
        landmarks=landmarks,
        tracked=tracked,
        error_px=errors,
        fps=fps,
        source_sha256=source_sha256,
    )


def _check(landmarks: Landmarks, fps: float, focal_px: float | None) -> None:
    if not math.isfinite(fps) or fps <= 0:
        raise InputError(f"frame rate {fps} cannot be used, a positive number was expected")
    if focal_px is not None and not (math.isfinite(focal_px) and focal_px > 0):
        raise InputError(
            f"focal length {focal_px} px cannot be used, a positive number was expected",
            "leave it unset to have it estimated",
        )
    if not bool(landmarks.valid.any()):
        raise FaceError(
            f"none of the {landmarks.points.shape[0]} frames shows a face that could be tracked",
            "choose a clip in which one face is large and looks at the camera",
        )


def expected_focal(width: int, height: int, face_px: float) -> float:
    """Focal length such a picture is usually taken with, px.

    Two things are known beforehand: pictures that show the sensor's whole view have a focal length near 1.1 ×
    their longer side (phones 0.8, webcams 0.8, portrait lenses 1.5 and more), and faces are filmed from some
    0.7 m (selfies 0.4, desks 0.7, interviews 1.2), which a picture cropped to the face does not change. Both are
    equally vague, so the estimate is their geometric mean.

    Args:
        width: of the picture, px.
        height: of the picture, px.
        face_px: longer side of the landmarks' box, px.
    """
    by_sensor = 1.1 * max(width, height)
    by_distance = 0.7 / FACE_HEIGHT * face_px
    return math.sqrt(by_sensor * by_distance)


def landmark_errors(sequence: TrackedSequence, head: HeadModel) -> Float[Tensor, " t"]:
    """Mean distance of the head's landmarks from the detected ones in each frame, px with the face scaled to
    ``ERROR_FACE_PX``; NaN where none were detected.

    Args:
        sequence: a track, whatever became of its motion since it was fitted.
        head: its head model.
    """
    points, _ = head.landmarks().forward(sequence.shape, sequence.motion)
    found = sequence.landmarks.points
    off = (cameras.project(sequence.camera, points)[0] - found).norm(dim=-1).mean(-1)
    return off * ERROR_FACE_PX / face_size(found)


class _Clip:
    """What the stages of one fit have in common."""

    def __init__(self, landmarks: Landmarks, head: HeadModel, config: TrackConfig, fps: float) -> None:
        self.points = landmarks.points
        self.width, self.height = landmarks.width, landmarks.height
        self.centre = landmarks.points.new_tensor([landmarks.width / 2, landmarks.height / 2])
        self.iterations = config.iterations
        self.fps = fps
        self.model = LandmarkModel.from_head(head, config.n_shape)
        self.prior = make_prior(self.model, head)

    def learn_identity(self, frames: Int[Tensor, " k"], focal_px: float | None) -> Shared:
        """Identity and focal length from the most different of the trusted frames."""
        points = self.points[frames]
        points = points[diverse_frames(points, KEYFRAMES)]
        if focal_px is None:
            expected = expected_focal(self.width, self.height, float(face_size(points).median()))
            belief = FocalBelief(math.log(expected))
        else:
            belief = FocalBelief(math.log(focal_px), sigma=0.0)
        observation = Observation(points, self.centre)
        start = initial_poses(self.model, observation, points.new_tensor(belief.log_focal))
        energy = LandmarkEnergy(self.model, observation)
        shared, _ = solve_identity(energy, self.prior, belief, start, self.iterations)
        log.debug("identity from %d frames, focal length %.0f px", len(points), float(shared.log_focal.exp()))
        return shared

    def follow(
        self, person: LandmarkModel, log_focal: Float[Tensor, ""], frames: Int[Tensor, " k"], progress: Progress
    ) -> PoseState:
        """Motion of a known person in the trusted frames, solved in overlapping stretches."""
        kept = []
        for start in range(0, len(frames), CHUNK):
            stop = min(start + CHUNK, len(frames))
            first, last = max(start - HALO, 0), min(stop + HALO, len(frames))
            stretch = frames[first:last]
            observation = Observation(self.points[stretch], self.centre)
            state = solve_motion(
                LandmarkEnergy(person, observation),
                self.prior,
                make_acceleration(stretch, person.n_values, self.fps, person.template),
                log_focal,
                initial_poses(person, observation, log_focal),
                self.iterations,
            )
            kept.append(state[start - first : stop - first])
            progress.update(stop, len(frames))
        return PoseState(torch.cat([part.rotation for part in kept]), torch.cat([part.values for part in kept]))

    def error_px(
        self, person: LandmarkModel, log_focal: Float[Tensor, ""], frames: Int[Tensor, " k"], state: PoseState
    ) -> Float[Tensor, " k"]:
        """Mean landmark error of each frame, px with the face scaled to ``ERROR_FACE_PX``."""
        points = self.points[frames]
        posed = person.pose(person.template.new_zeros(0), state)
        off = (project(posed.points, log_focal, self.centre) - points).norm(dim=-1).mean(-1)
        return off * ERROR_FACE_PX / face_size(points)
