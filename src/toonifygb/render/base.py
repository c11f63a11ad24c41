"""What every renderer is: the protocol, and the constants that make two of them comparable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from toonifygb.structures import Camera, Rendering, Splats


@dataclass(frozen=True)
class RasterConstants:
    """The rasteriser's decisions; the defaults are 3DGB's, gsplat differs in ``alpha_max`` (0.999).

    They stand here and nowhere else, and every renderer takes them as an argument.
    """

    near: float = 0.2
    """Gaussians whose centre is nearer than this are dropped, m."""
    alpha_max: float = 0.99
    """Opacity of one Gaussian at one pixel is clamped to this; the clamp is ignored by the gradient."""
    alpha_min: float = 1.0 / 255.0
    """Weaker contributions are skipped."""
    low_pass: float = 0.3
    """Variance added to both image axes, px²: the anti-aliasing filter."""
    transmittance_min: float = 1e-4
    """A pixel stops *before* the Gaussian that would take its transmittance below this."""
    frustum_margin: float = 1.3
    """In the projection's Jacobian x/z and y/z are clamped to ± this × tan(fov / 2)."""
    radius_sigmas: float = 3.0
    """A Gaussian covers the square of ceil(this × largest standard deviation) px."""
    tile: int = 16
    """Side of the tiles that decide which Gaussians a pixel meets, px."""


DEFAULT_CONSTANTS = RasterConstants()


class Renderer(Protocol):
    """Turns splats into an image, differentiably.

    Gradients reach every floating field of ``splats`` through both ``color`` and ``alpha``.
    """

    name: str

    def render(
        self,
        splats: Splats,
        camera: Camera,
        *,
        background: Float[Tensor, " 3"] | None = None,
        sh_degree: int | None = None,
        constants: RasterConstants = DEFAULT_CONSTANTS,
    ) -> Rendering:
        """Image of ``splats`` seen by ``camera``.

        Args:
            splats: world-space Gaussians.
            camera: pinhole camera; pixel centres at half-integers.
            background: RGB 0..1 behind everything; black when ``None``.
            sh_degree: active SH degree; the degree stored when ``None``.
            constants: the rasteriser's decisions.
        """
        ...
