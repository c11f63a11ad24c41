"""The native CPU renderer: the C++ engine behind ``Renderer``, differentiable through autograd.

It computes in float32 and must agree with ``reference.py``; the same bits come out for every number of threads.
"""

from __future__ import annotations

import ctypes
import os
from dataclasses import astuple, dataclass, fields
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from toonifygb.render import library
from toonifygb.render.base import DEFAULT_CONSTANTS, RasterConstants, RenderInfo, check_splats
from toonifygb.structures import Camera, Rendering, Splats

if TYPE_CHECKING:
    from jaxtyping import Float

_SPLAT_FIELDS = ("means", "quats", "scales", "opacities", "sh", "sh_frames")


def available_threads() -> int:
    """Processors this process may run on."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    return len(affinity(0)) if affinity else os.cpu_count() or 1


class _Frame:
    """Owner of what the engine keeps between a forward and its backward pass."""

    def __init__(self, handle: int, engine: ctypes.CDLL) -> None:
        self.handle = handle
        self._release = engine.tgb_raster_release

    def __del__(self) -> None:
        self._release(self.handle)


@dataclass
class _View:
    """Everything of a render call that is not differentiated."""

    camera: library.Camera
    constants: library.Constants
    sh_degree: int
    threads: int
    info: RenderInfo | None


def native_camera(camera: Camera) -> library.Camera:
    """The camera as the engine reads it."""
    K, rows = camera.K.tolist(), camera.world_to_camera[:3].flatten().tolist()
    native = library.Camera(
        fx=K[0][0], fy=K[1][1], cx=K[0][2], cy=K[1][2], width=camera.width, height=camera.height
    )
    native.view[:] = rows
    return native


def _scene(tensors: list[Tensor | None], background: Tensor, view: _View) -> library.Scene:
    means, sh = tensors[0], tensors[4]
    assert means is not None and sh is not None
    splats = library.Splats(n=means.shape[0], sh_stored=sh.shape[1], sh_degree=view.sh_degree)
    for name, tensor in zip(_SPLAT_FIELDS, tensors, strict=True):
        setattr(splats, name, library.pointer(tensor))
    scene = library.Scene(camera=view.camera, constants=view.constants, splats=splats, threads=view.threads)
    scene.background[:] = background.tolist()
    return scene


def _forward(tensors: list[Tensor | None], background: Tensor, view: _View) -> tuple[Tensor, Tensor, _Frame]:
    engine = library.load()
    color = torch.empty(view.camera.height, view.camera.width, 3)
    alpha = torch.empty(view.camera.height, view.camera.width)
    scene = _scene(tensors, background, view)
    radii = None
    if view.info is not None:
        radii = view.info.radii = torch.empty(scene.splats.n, dtype=torch.int32)
    handle = engine.tgb_raster_forward(scene, color.data_ptr(), alpha.data_ptr(), library.pointer(radii), None)
    if not handle:
        raise MemoryError("the native renderer ran out of memory")
    return color, alpha, _Frame(handle, engine)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, view: _View, background: Tensor, *tensors: Tensor | None) -> tuple[Tensor, Tensor]:
        color, alpha, ctx.frame = _forward(list(tensors), background, view)
        ctx.view = view
        ctx.save_for_backward(background, alpha, *tensors)
        return color, alpha

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        v_color, v_alpha = (output.contiguous() for output in outputs)
        background, alpha, *tensors = ctx.saved_tensors
        view: _View = ctx.view
        scene = _scene(tensors, background, view)
        results = [None if tensor is None else torch.empty_like(tensor) for tensor in tensors]
        gradients = library.Gradients(v_color=v_color.data_ptr(), v_alpha=v_alpha.data_ptr())
        for name, result in zip(_SPLAT_FIELDS, results, strict=True):
            setattr(gradients, name, library.pointer(result))
        statistic = None
        if view.info is not None:
            statistic = torch.empty(scene.splats.n, 2)
            gradients.mean2d_color = statistic.data_ptr()
        if not library.load().tgb_raster_backward(ctx.frame.handle, scene, gradients, None):
            raise MemoryError("the native renderer ran out of memory")
        if view.info is not None and statistic is not None:
            half = statistic.new_tensor([view.camera.width / 2, view.camera.height / 2])
            view.info.mean2d_gradient = statistic * half
        v_background = None
        if ctx.needs_input_grad[1]:
            v_background = (v_color * (1 - alpha)[..., None]).sum((0, 1))
        return None, v_background, *results


class NativeRenderer:
    """Renders on the CPU with the C++ engine.

    Args:
        threads: threads of the engine; all available processors when ``None``.

    Raises:
        BackendError: the engine is not built or cannot be loaded.
    """

    name = "native"

    def __init__(self, threads: int | None = None) -> None:
        library.load()
        self.threads = threads or available_threads()

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
        view = _View(
            camera=native_camera(camera),
            constants=library.Constants(*astuple(constants)),
            sh_degree=check_splats(splats, sh_degree),
            threads=self.threads,
            info=info,
        )
        tensors: list[Tensor | None] = []
        for name in _SPLAT_FIELDS:
            field = getattr(splats, name)
            tensors.append(None if field is None else field.to("cpu", torch.float32).contiguous())
        background = torch.zeros(3) if background is None else background.to("cpu", torch.float32)
        differentiate = torch.is_grad_enabled() and any(
            tensor is not None and tensor.requires_grad for tensor in (*tensors, background)
        )
        if differentiate:
            color, alpha = _Rasterize.apply(view, background, *tensors)
        else:
            color, alpha, _ = _forward(tensors, background, view)
        return Rendering(color=color, alpha=alpha)


if tuple(field.name for field in fields(RasterConstants)) != tuple(name for name, *_ in library.Constants._fields_):
    raise TypeError("RasterConstants and the engine's constants differ in their fields")
