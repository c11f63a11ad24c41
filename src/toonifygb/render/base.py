"""What every renderer is: the protocol, and the constants that make two of them comparable."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
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
    """Side of the tiles that decide which Gaussians a pixel meets, px; a multiple of 4."""

    def __post_init__(self) -> None:
        if self.tile <= 0 or self.tile % 4:
            raise ValueError(f"tile is {self.tile} px, expected a positive multiple of 4")


DEFAULT_CONSTANTS = RasterConstants()


@dataclass
class RenderInfo:
    """What a rendering knows beside its image; hand an empty one to ``Renderer.render`` to have it filled."""

    radii: Int[Tensor, " n"] | None = None
    """Radius of each Gaussian's square on the image, px; 0 where it is not visible."""
    mean2d_gradient: Float[Tensor, "n 2"] | None = None
    """∂L/∂(projected centre) in normalised device units (pixel gradient × width/2, height/2), the colour image's
    part only: 3DGB's densification statistic. Filled by the backward pass."""

    @property
    def visible(self) -> Bool[Tensor, " n"]:
        """Gaussians that touch the image."""
        if self.radii is None:
            raise ValueError("this RenderInfo has not been through Renderer.render yet")
        return self.radii > 0


class Renderer(Protocol):
    """Turns splats into an image, differentiably.

    Gradients reach every floating field of ``splats`` (``sh_frames`` included) and ``background`` through both
    ``color`` and ``alpha``; the camera gets none. A Gaussian with a field that is not finite is not drawn.
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
        info: RenderInfo | None = None,
    ) -> Rendering:
        """Image of ``splats`` seen by ``camera``.

        Args:
            splats: world-space Gaussians.
            camera: pinhole camera; pixel centres at half-integers.
            background: RGB 0..1 behind everything; black when ``None``.
            sh_degree: active SH degree; the degree stored when ``None``.
            constants: the rasteriser's decisions.
            info: filled with what densification needs.

        Raises:
            ValueError: the splats' shapes disagree, or ``sh_degree`` exceeds what is stored.
        """
        ...


def check_splats(splats: Splats, sh_degree: int | None) -> int:
    """Active SH degree of consistent splats.

    Raises:
        ValueError: shapes disagree, or the degree is not within 0..3 and what ``splats.sh`` stores.
    """
    n = splats.means.shape[0]
    k = splats.sh.shape[1] if splats.sh.ndim == 3 else -1
    expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh": (n, k, 3)}
    if splats.sh_frames is not None:
        expected["sh_frames"] = (n, 3, 3)
    for name, shape in expected.items():
        found = tuple(getattr(splats, name).shape)
        if found != shape:
            raise ValueError(f"splats.{name} has shape {found}, expected {shape}")
    stored = math.isqrt(k) - 1
    if stored not in range(4) or (stored + 1) ** 2 != k:
        raise ValueError(f"splats.sh has {k} coefficients, expected 1, 4, 9 or 16")
    degree = stored if sh_degree is None else sh_degree
    if not 0 <= degree <= stored:
        raise ValueError(f"sh_degree is {degree}, expected 0 to {stored}, the degree stored")
    return degree
