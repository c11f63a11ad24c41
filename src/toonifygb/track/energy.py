"""What the tracker minimises: landmark distances, lid and lip gaps, and what is believed of faces beforehand.

Every term is a sum of squares in units of its own standard deviation, so weights are answers to "how far off is
one sigma?". Energies carry no factor ½: a term r² has gradient 2 Jᵀr and Gauss-Newton curvature 2 JᵀJ, and the
common 2 is left out throughout.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from toonifygb.structures import TensorRecord
from toonifygb.track.model import ANGLES, EXPRESSION, EYELIDS, POSITION, LandmarkModel, Posed, PoseState

if TYPE_CHECKING:
    from jaxtyping import Float

    from toonifygb.head import HeadModel

N_FACE = 468
"""Landmarks of the skin; those behind them are the two irises, five each: the subject's right, then left."""
LID_PAIRS = (
    (159, 145), (158, 153), (160, 144), (157, 154), (161, 163),
    (386, 374), (385, 380), (387, 373), (384, 381), (388, 390),
)  # fmt: skip
LIP_PAIRS = ((13, 14), (82, 87), (312, 317), (81, 178), (311, 402), (61, 291), (0, 17))
"""Landmarks whose distance says how far eyes and mouth are open: it is known better than either position."""

DATA_SHARE = 1.2
"""Weight of a landmark at one sigma against one sigma of a prior."""
KERNEL = 5.0
"""Geman-McClure scale, sigmas: landmarks further off than this hardly count."""
SIGMA_SHARE, SIGMA_RANGE = 0.7, (0.7e-3, 1.1e-3)
"""Trust in a landmark: this share of the detector's wander on the surface (the rest is common to the whole face and
moves with the pose), within bounds, m. Lips and lids count most; without the upper bound contour landmarks, which
wander most, would count next to nothing, although they alone say how wide the face is."""
PAIR_SIGMA = 0.6e-3
"""Trust in a lid or lip gap, m."""
FACING_EDGE, FACING_SOFTNESS, FACING_FLOOR = 0.05, 0.08, 0.05
"""Landmarks fade out where the cosine between their patch and the viewer drops below the edge."""
IRIS_WEIGHT = 0.8
MIN_DEPTH = 0.05
"""A head nearer to the camera than this is no solution, m."""
BATCH = 16
"""Frames whose Jacobians are held at once: about 8 MB, near the size of a processor's cache."""


@dataclass(frozen=True)
class Observation(TensorRecord):
    """Detected landmarks of the frames being fitted, in a camera whose centre is the image centre."""

    points: Float[Tensor, "n l 2"]
    """px, finite."""
    centre: Float[Tensor, " 2"]
    """Principal point, px."""

    def __getitem__(self, index: slice) -> Observation:
        return Observation(self.points[index], self.centre)


@dataclass(frozen=True)
class Prior(TensorRecord):
    """Independent beliefs about ``PoseState.values``: a Gaussian around zero, and walls that give a little."""

    precision: Float[Tensor, " q"]
    lower: Float[Tensor, " q"]
    upper: Float[Tensor, " q"]
    wall: Float[Tensor, " q"]
    """Precision beyond the bounds."""
    coupling: Float[Tensor, "q q"]
    """Precision of differences between values: both eyes look the same way."""

    def _beyond(self, values: Float[Tensor, "n q"]) -> Float[Tensor, "n q"]:
        return values - values.clamp(self.lower, self.upper)

    def energy(self, values: Float[Tensor, "n q"]) -> Float[Tensor, " n"]:
        """Energy of each frame."""
        own = self.precision * values.square() + self.wall * self._beyond(values).square()
        return own.sum(-1) + ((values @ self.coupling) * values).sum(-1)

    def gradient(self, values: Float[Tensor, "n q"]) -> Float[Tensor, "n q"]:
        """Half the derivative of ``energy``."""
        return self.precision * values + self.wall * self._beyond(values) + values @ self.coupling

    def curvature(self, values: Float[Tensor, "n q"]) -> Float[Tensor, "n q q"]:
        """Half the second derivative of ``energy``."""
        outside = (self._beyond(values) != 0).to(values.dtype)
        return torch.diag_embed(self.precision + self.wall * outside) + self.coupling


def make_prior(model: LandmarkModel, head: HeadModel) -> Prior:
    """Beliefs about jaw, gaze, lids and expression of ``head``."""
    sigma = model.template.new_full((model.n_values,), torch.inf)
    lower, upper, give = -sigma, sigma.clone(), torch.ones_like(sigma)
    # Jaw: opens to about 24 degrees in speech, sideways to 4; the bound keeps it from closing through the teeth.
    sigma[ANGLES] = sigma.new_tensor([0.35, 0.06, 0.25, 0.30, 0.25, 0.30])
    lower[ANGLES.start], give[ANGLES.start] = 0.0, 0.02
    sigma[EYELIDS], lower[EYELIDS], upper[EYELIDS], give[EYELIDS] = 1.0, 0.0, 1.1, 0.05
    span = head.expression_upper - head.expression_lower
    sigma[EXPRESSION] = head.expression_sigma
    lower[EXPRESSION] = head.expression_lower
    upper[EXPRESSION] = head.expression_upper + 0.2 * span  # strong faces may exceed the artist's full expression
    give[EXPRESSION] = 0.05 * span
    coupling = sigma.new_zeros((model.n_values, model.n_values))
    pitch_left, yaw_left, pitch_right, yaw_right = range(ANGLES.start + 2, ANGLES.stop)
    for left, right, apart in ((pitch_left, pitch_right, 0.04), (yaw_left, yaw_right, 0.10)):
        for i, j in ((left, right), (right, left)):
            coupling[i, i] += apart**-2
            coupling[i, j] -= apart**-2
    wall = torch.where(lower.isfinite(), 4.0 / give.square(), 0.0)
    return Prior(sigma.pow(-2), lower, upper, wall, coupling)


def project(
    points: Float[Tensor, "n l 3"], log_focal: Float[Tensor, ""], centre: Float[Tensor, " 2"]
) -> Float[Tensor, "n l 2"]:
    """Pixels of world points in the tracked camera (looking along −z, y up), px."""
    return centre + log_focal.exp() * points[..., :2] / points[..., 2:] * points.new_tensor([-1.0, 1.0])


def projection_slopes(points: Float[Tensor, "n l 3"], log_focal: Float[Tensor, ""]) -> Float[Tensor, "n l 2 3"]:
    """Derivatives of ``project`` by the points, px/m."""
    x, y, z = points.unbind(-1)
    scale, zero = -log_focal.exp() / z, torch.zeros_like(z)
    across = torch.stack([scale, zero, -scale * x / z], -1)
    down = torch.stack([zero, -scale, scale * y / z], -1)
    return torch.stack([across, down], -2)


@dataclass(frozen=True)
class Weights(TensorRecord):
    """Weights of squared pixel residuals, held while a step is sought."""

    landmark: Float[Tensor, "n l"]
    pair: Float[Tensor, "n k"]


@dataclass(frozen=True)
class NormalEquations(TensorRecord):
    """Gauss-Newton system of n frames and what they share (identity, then log focal length)."""

    frame: Float[Tensor, "n p p"]
    frame_gradient: Float[Tensor, "n p"]
    cross: Float[Tensor, "n p s"]
    shared: Float[Tensor, "s s"]
    shared_gradient: Float[Tensor, " s"]


class LandmarkEnergy:
    """The landmark terms of one clip or part of it."""

    def __init__(self, model: LandmarkModel, observation: Observation) -> None:
        self.model = model
        self.observation = observation
        self.pairs = torch.tensor(LID_PAIRS + LIP_PAIRS, device=observation.points.device)
        self._sigma = (SIGMA_SHARE * model.sigma).clamp(*SIGMA_RANGE)

    def residuals(self, posed: Posed, log_focal: Float[Tensor, ""]) -> Float[Tensor, "n l 2"]:
        """Projected minus detected landmarks, px."""
        return project(posed.points, log_focal, self.observation.centre) - self.observation.points

    def weights(self, posed: Posed, state: PoseState, log_focal: Float[Tensor, ""]) -> Weights:
        """Weights at a state: robust kernel, patches turned away, closed eyes."""
        residuals = self.residuals(posed, log_focal)
        px_per_m = log_focal.exp() / -posed.points[..., 2].mean(-1, keepdim=True)
        sigma_px = self._sigma * px_per_m
        kernel = (1 + (residuals.norm(dim=-1) / (KERNEL * sigma_px)).square()).pow(-2)
        view = torch.nn.functional.normalize(-posed.points, dim=-1)
        cosine = ((self.model.normals @ state.rotation.mT) * view).sum(-1)
        facing = torch.sigmoid((cosine - FACING_EDGE) / FACING_SOFTNESS)
        facing = FACING_FLOOR + (1 - FACING_FLOOR) * facing
        # The irises of a closing eye are guessed by the detector.
        left, right = (IRIS_WEIGHT * (1 - state.values[:, EYELIDS]).clamp(0.02, 1)).unbind(-1)
        irises = torch.stack([right] * 5 + [left] * 5, -1)
        facing = torch.cat([facing[:, :N_FACE], facing[:, N_FACE:] * irises], -1)
        return Weights(
            landmark=DATA_SHARE * kernel * facing / sigma_px.square(),
            pair=DATA_SHARE * facing[:, self.pairs].amin(-1) / (PAIR_SIGMA * px_per_m).square(),
        )

    def energy(self, residuals: Float[Tensor, "n l 2"], weights: Weights) -> Float[Tensor, " n"]:
        """Energy of each frame under held weights."""
        gaps = residuals[:, self.pairs[:, 0]] - residuals[:, self.pairs[:, 1]]
        landmark = (weights.landmark * residuals.square().sum(-1)).sum(-1)
        return landmark + (weights.pair * gaps.square().sum(-1)).sum(-1)

    def normal_equations(
        self,
        posed: Posed,
        state: PoseState,
        log_focal: Float[Tensor, ""],
        weights: Weights,
        *,
        rigid: bool = False,
        shared: bool = False,
    ) -> NormalEquations:
        """Gauss-Newton system of the landmark terms, assembled a few frames at a time.

        Args:
            posed: ``model.pose`` at ``state``.
            state: the poses.
            log_focal: logarithm of the focal length in px.
            weights: as held.
            rigid: only rotation and position move.
            shared: identity and focal length move too; otherwise their parts are empty.
        """
        residuals = self.residuals(posed, log_focal)[..., None]
        root = weights.landmark.sqrt()[..., None, None]
        parts = []
        for start in range(0, state.n, BATCH):
            part = slice(start, start + BATCH)
            blocks = self._jacobian(posed[part], state[part], log_focal, rigid, shared)
            rows = torch.cat([*blocks, residuals[part]], -1)
            gaps = rows[:, self.pairs[:, 0]] - rows[:, self.pairs[:, 1]]
            gaps = (gaps * weights.pair[part].sqrt()[..., None, None]).flatten(1, 2)
            rows = (rows * root[part]).flatten(1, 2)
            parts.append(rows.mT @ rows + gaps.mT @ gaps)
        system = torch.cat(parts)
        p = 6 if rigid else 3 + self.model.n_values
        total = system[:, p:, p:].sum(0)
        return NormalEquations(
            frame=system[:, :p, :p],
            frame_gradient=system[:, :p, -1],
            cross=system[:, :p, p:-1],
            shared=total[:-1, :-1],
            shared_gradient=total[:-1, -1],
        )

    def _jacobian(
        self, posed: Posed, state: PoseState, log_focal: Float[Tensor, ""], rigid: bool, shared: bool
    ) -> list[Float[Tensor, "n l 2 _"]]:
        """Derivatives of the projected landmarks: state, then (if shared) identity and log focal length, px."""
        slopes = projection_slopes(posed.points, log_focal)
        if rigid:
            arm = posed.points - state.values[:, None, POSITION]
            return [torch.linalg.cross(arm[:, :, None].expand_as(slopes), slopes, dim=-1), slopes]
        blocks = self.model.derivatives(posed, state, slopes)
        if shared:
            from_centre = project(posed.points, log_focal, torch.zeros_like(self.observation.centre))
            blocks.append(from_centre[..., None])
        return blocks
