"""Every noun that crosses a door between rooms, as frozen records of tensors.

Conventions, once for the whole house:

* **Lengths** are metres, **angles** radians, **image positions** pixels. Quaternions are ``(w, x, y, z)``.
* **Images** are sRGB; ``uint8`` 0..255 at the file boundary, ``float32`` 0..1 inside networks and losses.
* **Pixels**: continuous image coordinates, origin at the top-left *corner*; the centre of pixel ``(row i,
  column j)`` is at ``(x, y) = (j + 0.5, i + 0.5)``. ``K`` and landmarks use these coordinates.
* **Head frame**: y up, z out of the face, +x towards the subject's left.
* **World frame** of a tracked clip: the axes of an OpenGL camera (x right, y up, z towards the viewer) at the
  physical camera; the head is in front of it at negative z. So a clip's ``world_to_camera`` is the constant
  ``diag(1, -1, -1, 1)`` and the head's motion lives in ``HeadMotion``.
* **Camera frame**: OpenCV (x right, y down, z forward).
* ``sh`` has the DC coefficient first; colour = max(0, Σ coefficient·basis + 0.5).

Leading batch axes are written ``*b``. Records are frozen: a stage returns a new one, it never edits its input.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from torch import Tensor

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    import torch
    from jaxtyping import Bool, Float, Int, UInt8

T = TypeVar("T", bound="TensorRecord")


@dataclass(frozen=True)
class TensorRecord:
    """Base of records whose tensor fields move and slice together."""

    def map(self: T, function: Callable[[Tensor], Tensor]) -> T:
        """Record with ``function`` applied to every tensor field, nested records included."""
        changed = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                changed[field.name] = function(value)
            elif isinstance(value, TensorRecord):
                changed[field.name] = value.map(function)
        return replace(self, **changed)

    def to(self: T, *args: torch.device | torch.dtype | str) -> T:
        """Record with every tensor moved as by ``Tensor.to``."""
        return self.map(lambda tensor: tensor.to(*args))  # type: ignore[arg-type]

    def detach(self: T) -> T:
        """Record cut from the autograd graph."""
        return self.map(lambda tensor: tensor.detach())


@dataclass(frozen=True)
class VideoInfo:
    """What is known of a clip before its frames are read; sizes are after rotation metadata is applied."""

    path: str
    width: int
    height: int
    fps: float
    """Mean frames per second; the pace at which the clip is written again."""
    n_frames: int | None
    """Frame count promised by the container; ``None`` when unknown. The stream itself decides."""
    has_audio: bool
    problems: tuple[str, ...] = ()
    """Things a user should know: variable frame rate, dropped alpha, damaged tail. One sentence each."""


@dataclass(frozen=True)
class Detection(TensorRecord):
    """One found face."""

    box: Float[Tensor, " 4"]
    """left, top, right, bottom in px of the searched image."""
    keypoints: Float[Tensor, "6 2"]
    """Right eye, left eye (the subject's), nose tip, mouth centre, right and left ear tragion, px."""
    score: float


@dataclass(frozen=True)
class Landmarks(TensorRecord):
    """Face landmarks of a clip (or, with t = 1, of one image) in MediaPipe's 478-point scheme."""

    points: Float[Tensor, "t 478 2"]
    """px, continuous image coordinates; NaN where the face was not found."""
    score: Float[Tensor, " t"]
    """Face presence 0..1; 0 where not found."""
    width: int
    height: int

    @property
    def valid(self) -> Bool[Tensor, " t"]:
        """Frames in which the face was found."""
        return self.points.isfinite().all(-1).all(-1)


@dataclass(frozen=True)
class Camera(TensorRecord):
    """A pinhole camera without distortion."""

    K: Float[Tensor, "3 3"]
    """px, for continuous image coordinates (pixel centres at half-integers)."""
    world_to_camera: Float[Tensor, "4 4"]
    width: int
    height: int


@dataclass(frozen=True)
class HeadMotion(TensorRecord):
    """What changes from frame to frame: expression and pose of a head model."""

    expression: Float[Tensor, "*b e"]
    """ψ; open head: 39 unit weights, nominally 0..1; FLAME: standard deviations."""
    joints: Float[Tensor, "*b 5 3"]
    """Θ, axis-angle rad; order root, neck, jaw, left eye, right eye; each relative to its parent."""
    translation: Float[Tensor, "*b 3"]
    """World position added after skinning, m."""
    eyelids: Float[Tensor, "*b 2"]
    """Closure of left and right lid, 0 open .. 1 lids just meet."""

    def __getitem__(self, index: int | slice | Int[Tensor, " i"]) -> HeadMotion:
        """Motion of the chosen frame(s), indexing the leading axis."""
        return self.map(lambda tensor: tensor[index])


@dataclass(frozen=True)
class TrackedSequence(TensorRecord):
    """A clip explained by a head model: one identity, one camera, one motion per frame."""

    head_model: str
    """Name of the head model, for instance ``open``."""
    shape: Float[Tensor, " s"]
    """β, identity coefficients, standard deviations."""
    motion: HeadMotion
    """Leading axis = frame."""
    camera: Camera
    """Full-frame camera, constant over the clip."""
    landmarks: Landmarks
    """The observations the fit explains."""
    tracked: Bool[Tensor, " t"]
    """False where the face was lost and the motion is bridged between neighbours."""
    error_px: Float[Tensor, " t"]
    """Mean landmark error of each frame with its face scaled to 230 px width; NaN where not tracked."""
    fps: float
    source_sha256: str

    @property
    def n_frames(self) -> int:
        """Number of frames, tracked or bridged."""
        return self.tracked.shape[0]


@dataclass(frozen=True)
class GaussianParams(TensorRecord):
    """3D Gaussians before activation: the linear space in which blendshapes add up (B = B0 + Σ ψk ΔBk).

    With a leading axis e the same record holds the expression deltas ΔBk.
    """

    means: Float[Tensor, "*e n 3"]
    """Centres in the rest pose, m."""
    quats: Float[Tensor, "*e n 4"]
    """Unnormalised wxyz."""
    log_scales: Float[Tensor, "*e n 3"]
    """Natural logarithm of the standard deviation along each own axis, log m."""
    opacity_logits: Float[Tensor, "*e n"]
    sh: Float[Tensor, "*e n k 3"]
    """k = (degree + 1)² coefficients, DC first."""

    @property
    def n(self) -> int:
        """Number of Gaussians."""
        return self.means.shape[-2]


@dataclass(frozen=True)
class Splats(TensorRecord):
    """Activated 3D Gaussians in world space, ready for a renderer."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """wxyz; renderers take them as they are and do not normalise (3DGB's convention)."""
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]
    sh_frames: Float[Tensor, "n 3 3"] | None = None
    """Rotation R of each Gaussian's SH function; its view direction is turned by Rᵀ before evaluation, which
    equals rotating the coefficients. ``None`` when ``sh`` is already in world axes."""


@dataclass(frozen=True)
class Rendering(TensorRecord):
    """One rendered image."""

    color: Float[Tensor, "h w 3"]
    """0..1 (not clamped above), sRGB, composited over the background."""
    alpha: Float[Tensor, "h w"]
    """Accumulated opacity 0..1."""
    depth: Float[Tensor, "h w"] | None = None


@dataclass(frozen=True)
class Split:
    """Frame numbers of the training and held-out sets."""

    train: tuple[int, ...]
    test: tuple[int, ...]


Frame: TypeAlias = "UInt8[np.ndarray, 'h w 3']"
"""An image at the file boundary: numpy uint8 RGB, contiguous."""
