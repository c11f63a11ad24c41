"""The slow, readable definition of how raw Gaussians become posed splats; every fast path is tested against it.

Order (Eqs. 1-3 of ToonifyGB, after 3D Gaussian Blendshapes): blend linearly in the raw parameters → activate →
add pose correctives → linear blend skinning. Positions take the full blended affine map; the orientation of a
Gaussian and of its view-dependent colour take that map's rotation factor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from toonifygb.geometry.harmonics import rotate
from toonifygb.geometry.rotations import matrix_to_quat, polar_factor, quat_multiply, quat_normalize
from toonifygb.structures import GaussianParams, Splats

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor


def blend_parameters(neutral: GaussianParams, deltas: GaussianParams, psi: Float[Tensor, " e"]) -> GaussianParams:
    """B = B0 + Σ ψk ΔBk in the raw parameters (Eq. 1 of ToonifyGB)."""
    return GaussianParams(
        means=neutral.means + torch.einsum("e,enc->nc", psi, deltas.means),
        quats=neutral.quats + torch.einsum("e,enc->nc", psi, deltas.quats),
        log_scales=neutral.log_scales + torch.einsum("e,enc->nc", psi, deltas.log_scales),
        opacity_logits=neutral.opacity_logits + torch.einsum("e,en->n", psi, deltas.opacity_logits),
        sh=neutral.sh + torch.einsum("e,enkc->nkc", psi, deltas.sh),
    )


def scale_deltas(deltas: GaussianParams, scale: Float[Tensor, "e n"]) -> GaussianParams:
    """ΔBk = scale_k · Δ̂k: trainable deltas damped where blendshape k hardly moves the surface."""
    return GaussianParams(
        means=deltas.means * scale[..., None],
        quats=deltas.quats * scale[..., None],
        log_scales=deltas.log_scales * scale[..., None],
        opacity_logits=deltas.opacity_logits * scale,
        sh=deltas.sh * scale[..., None, None],
    )


def activate(params: GaussianParams) -> Splats:
    """Raw parameters through their activations, still in the rest pose: unit quaternions, exp, sigmoid."""
    return Splats(
        means=params.means,
        quats=quat_normalize(params.quats),
        scales=params.log_scales.exp(),
        opacities=params.opacity_logits.sigmoid(),
        sh=params.sh,
    )


def pose_offsets(feature: Float[Tensor, " p"], pose_basis: Float[Tensor, "p n 3"]) -> Float[Tensor, "n 3"]:
    """Pose correctives, m, added in the rest pose before skinning."""
    return torch.einsum("p,pnc->nc", feature, pose_basis)


def skin_splats(
    splats: Splats,
    transforms: Float[Tensor, "n 4 4"],
    *,
    posed_offsets: Float[Tensor, "n 3"] | None = None,
    rotate_sh: bool = False,
) -> Splats:
    """Splats carried from the rest pose into the world.

    Args:
        splats: activated, rest pose; their ``sh_frames`` must be unset.
        transforms: blended joint transforms, rest → world.
        posed_offsets: added after skinning, m; 3DGB moves its eyelids there.
        rotate_sh: rotate the SH coefficients themselves, as 3DGB does, instead of handing the renderer
            ``sh_frames`` by which it turns the view direction back. Both mean the same; the second is cheaper.
    """
    linear = transforms[:, :3, :3]
    means = torch.einsum("nab,nb->na", linear, splats.means) + transforms[:, :3, 3]
    if posed_offsets is not None:
        means = means + posed_offsets
    turn = polar_factor(linear, iterations=3)
    return Splats(
        means=means,
        quats=quat_multiply(matrix_to_quat(turn), splats.quats),
        scales=splats.scales,
        opacities=splats.opacities,
        sh=rotate(splats.sh, turn) if rotate_sh else splats.sh,
        sh_frames=None if rotate_sh else turn,
    )


def concatenate(parts: list[Splats]) -> Splats:
    """One set of splats from several, in order; all must or none may carry ``sh_frames``."""
    frames = [part.sh_frames for part in parts if part.sh_frames is not None]
    if frames and len(frames) != len(parts):
        raise AssertionError(f"{len(frames)} of {len(parts)} sets carry sh_frames; expected all or none")
    return Splats(
        means=torch.cat([part.means for part in parts]),
        quats=torch.cat([part.quats for part in parts]),
        scales=torch.cat([part.scales for part in parts]),
        opacities=torch.cat([part.opacities for part in parts]),
        sh=torch.cat([part.sh for part in parts]),
        sh_frames=torch.cat(frames) if frames else None,
    )
