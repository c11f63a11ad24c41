"""Renderers for CUDA devices: our own Triton kernels, and gsplat's compositing.

Both project and colour Gaussians with the reference's torch code and share its tile lists, so near plane, low pass,
frustum margin, colour clamp and tile rectangles are the reference's own. What is left to a kernel is compositing.
``docs/decisions/041-cuda.md`` lists where gsplat's constants differ.
"""

from __future__ import annotations

import functools
import importlib.util
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from toonifygb.errors import BackendError
from toonifygb.render.base import DEFAULT_CONSTANTS, RasterConstants, RenderInfo, check_splats
from toonifygb.render.reference import Projected, project
from toonifygb.render.tiles import TileLists, tile_lists
from toonifygb.structures import Camera, Rendering, Splats

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float

INTERPRET_VARIABLE = "TRITON_INTERPRET"
"""Environment variable of Triton: 1 runs its kernels on the processor, slowly, to check them."""
GSPLAT_VERSION = "1.5.3"
FIELDS, COLUMNS = 9, 11
"""Floats of a compositing record, and of its gradient; see ``cuda_kernels``."""
STRIP_PIXELS = 64
"""Pixels that one program composites: two for each thread of a warp."""
SUM_ROWS = 32
"""Rows that are added up at once."""


@functools.cache
def unavailable(name: str = "cuda") -> str | None:
    """Why ``cuda`` or ``gsplat`` cannot be used, as a clause; ``None`` when it can."""
    if name == "cuda" and importlib.util.find_spec("triton") is None:
        return "Triton is not installed"
    if name == "cuda" and _interpreted():
        return None
    if not torch.cuda.is_available():
        return "PyTorch sees no CUDA device"
    if name == "gsplat" and importlib.util.find_spec("gsplat") is None:
        return f"gsplat is not installed (pip install gsplat=={GSPLAT_VERSION})"
    return None


def device() -> torch.device:
    """Where these backends compute: the current CUDA device, or the processor under Triton's interpreter.

    Raises:
        BackendError: there is no such device.
    """
    if torch.cuda.is_available():
        return torch.device("cuda", torch.cuda.current_device())
    require("cuda")
    return torch.device("cpu")


def _interpreted() -> bool:
    return os.environ.get(INTERPRET_VARIABLE) == "1" and not torch.cuda.is_available()


def require(name: str) -> None:
    """Makes sure that ``cuda`` or ``gsplat`` can be used.

    Raises:
        BackendError: it cannot.
    """
    if (reason := unavailable(name)) is not None:
        raise BackendError(f"the {name} backend is not available: {reason}", "use auto, which takes what there is")


def triton_kernels() -> Any:
    """The module of kernels; imported at its first use, because Triton is only where CUDA is."""
    from toonifygb.render import cuda_kernels

    return cuda_kernels


@dataclass(frozen=True)
class View:
    """Everything of a compositing that is not differentiated."""

    camera: Camera
    constants: RasterConstants
    lists: TileLists
    keep_statistic: Callable[[Float[Tensor, "m 2"]], None] | None
    """Takes the gradient for the centres, without the loss of the opacity image, px⁻¹."""


class _Composite(torch.autograd.Function):
    """Records of projected Gaussians to an image over a background, by the Triton kernels."""

    @staticmethod
    def forward(ctx: Any, view: View, records: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        camera, constants, lists = view.camera, view.constants, view.lists
        color = records.new_empty(camera.height, camera.width, 3)
        transmittance = records.new_empty(camera.height, camera.width)
        stops = torch.empty_like(transmittance, dtype=torch.int32)
        entries = records[lists.gaussians]
        per_tile, launch = _strips(view)
        triton_kernels().composite_forward[(lists.n_tiles * per_tile,)](
            entries,
            lists.starts,
            color,
            transmittance,
            stops,
            camera.width,
            camera.height,
            lists.columns,
            constants.alpha_min,
            constants.alpha_max,
            constants.transmittance_min,
            **launch,
        )
        ctx.view = view
        ctx.save_for_backward(entries, background, transmittance, stops)
        return color + transmittance[..., None] * background, 1 - transmittance

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        v_color, v_alpha = (output.contiguous() for output in outputs)
        entries, background, transmittance, stops = ctx.saved_tensors
        view: View = ctx.view
        lists, constants = view.lists, view.constants
        v_statistic = v_color @ background
        per_tile, launch = _strips(view)
        rows = entries.new_zeros(len(entries) * per_tile, COLUMNS)
        triton_kernels().composite_backward[(lists.n_tiles * per_tile,)](
            entries,
            lists.starts,
            lists.slots,
            transmittance,
            stops,
            v_color,
            v_statistic - v_alpha,
            v_statistic,
            rows,
            view.camera.width,
            view.camera.height,
            lists.columns,
            constants.alpha_min,
            constants.alpha_max,
            COLUMNS=COLUMNS,
            **launch,
        )
        starts = lists.slot_starts * per_tile
        gradients = entries.new_empty(len(starts) - 1, COLUMNS)
        if len(gradients):
            triton_kernels().sum_rows[(len(gradients),)](
                rows, starts, gradients, COLUMNS=COLUMNS, WIDE=16, BLOCK=SUM_ROWS, num_warps=1
            )
        if view.keep_statistic is not None:
            view.keep_statistic(gradients[:, FIELDS:])
        v_background = (transmittance[..., None] * v_color).sum((0, 1)) if ctx.needs_input_grad[2] else None
        return None, gradients[:, :FIELDS], v_background


def _strips(view: View) -> tuple[int, dict[str, int]]:
    """Strips of a tile, and what the compositing kernels are compiled for."""
    tile = view.constants.tile
    # The interpreter pays for every program, not for pixels.
    rows = tile if _interpreted() else max(1, STRIP_PIXELS // tile)
    pixels = 1 << (tile * rows - 1).bit_length()
    launch = {"FIELDS": FIELDS, "TILE": tile, "ROWS": rows, "PIXELS": pixels, "num_warps": max(1, pixels // 64)}
    return -(-tile // rows), launch


class CudaRenderer:
    """Renders on a CUDA device with Triton kernels, in float32; the same bits every time.

    Splats may live anywhere; the image comes back to their device.

    Raises:
        BackendError: there is no CUDA device or no Triton.
    """

    name = "cuda"

    def __init__(self) -> None:
        require(self.name)
        self.device = device()

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
        """Image of ``splats`` seen by ``camera``; see ``Renderer.render``."""
        degree, home = check_splats(splats, sh_degree), splats.means.device
        near = splats.map(lambda field: field.to(self.device, torch.float32))
        seen = camera.to(self.device)
        projected = project(near, seen, degree, constants)
        behind = torch.zeros(3) if background is None else background
        lists = tile_lists(projected, camera, constants.tile)
        keep = _recorder(info, projected, camera, len(near.means), home)
        view = View(camera, constants, lists, keep)
        color, alpha = self._composite(view, projected, behind.to(self.device, torch.float32))
        return Rendering(color=color.to(home), alpha=alpha.to(home))

    def _composite(self, view: View, projected: Projected, background: Tensor) -> tuple[Tensor, Tensor]:
        fields = (projected.centres, projected.conics, projected.opacities[:, None], projected.colors)
        return _Composite.apply(view, torch.cat(fields, -1), background)


class GsplatRenderer(CudaRenderer):
    """The same with gsplat's compositing, whose clamp of opacity is 0.999 and stops its gradient.

    Raises:
        BackendError: there is no CUDA device or no gsplat.
    """

    name = "gsplat"

    def _composite(self, view: View, projected: Projected, background: Tensor) -> tuple[Tensor, Tensor]:
        from gsplat import rasterize_to_pixels  # type: ignore[import-not-found]

        _check_gsplat(view.constants)
        centres, lists = projected.centres, view.lists
        color, alpha = rasterize_to_pixels(
            (centres + 0.5)[None],  # gsplat's pixel centres are at half-integers
            projected.conics[None],
            projected.colors[None],
            projected.opacities[None],
            view.camera.width,
            view.camera.height,
            view.constants.tile,
            lists.starts[:-1].view(1, lists.rows, lists.columns),
            lists.gaussians,
            backgrounds=background[None],
            packed=False,
        )
        return _watched(color[0], centres, view), alpha[0, ..., 0]


def _watched(color: Tensor, centres: Tensor, view: View) -> Tensor:
    """The image; its backward pass also finds what it alone pulls at the centres."""
    keep = view.keep_statistic
    if keep is None or not color.requires_grad:
        return color
    watched = color.view_as(color)
    watched.register_hook(lambda v: keep(torch.autograd.grad(color, centres, v, retain_graph=True)[0]))
    return watched


def _check_gsplat(constants: RasterConstants) -> None:
    """Makes sure that what gsplat was compiled with is what is asked for.

    Raises:
        BackendError: it is not.
    """
    for name in ("alpha_min", "transmittance_min"):
        wanted, built = getattr(constants, name), getattr(DEFAULT_CONSTANTS, name)
        if wanted != built:
            raise BackendError(f"{name} is {wanted:g}, gsplat is compiled for {built:g}", "use the cuda backend")


def _recorder(
    info: RenderInfo | None, projected: Projected, camera: Camera, n: int, home: torch.device
) -> Callable[[Tensor], None] | None:
    """Fills ``info`` with the radii now; what it returns fills in the statistic."""
    if info is None:
        return None
    radii = torch.zeros(n, dtype=torch.int32, device=projected.index.device)
    info.radii = radii.index_put((projected.index,), projected.radii.to(torch.int32)).to(home)
    half = projected.centres.new_tensor([camera.width / 2, camera.height / 2])

    def keep(gradient: Tensor) -> None:
        statistic = gradient.new_zeros(n, 2).index_put((projected.index,), gradient * half)
        info.mean2d_gradient = statistic.to(home)

    return keep
