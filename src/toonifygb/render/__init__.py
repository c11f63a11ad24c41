"""Renderers: a readable reference, the native CPU engine and CUDA kernels that must agree with it."""

from __future__ import annotations

import functools
import logging
from typing import TYPE_CHECKING

import torch

from toonifygb.errors import InputError
from toonifygb.render import cuda, library
from toonifygb.render.base import DEFAULT_CONSTANTS, RasterConstants, Renderer, RenderInfo
from toonifygb.render.proof import disagreement

if TYPE_CHECKING:
    from toonifygb.render.fused import Kernels

__all__ = ["DEFAULT_CONSTANTS", "RasterConstants", "RenderInfo", "Renderer", "get", "kernels", "resolve_backend"]

log = logging.getLogger(__name__)

BACKENDS = ("auto", "cuda", "gsplat", "native", "reference")


@functools.cache
def resolve_backend(backend: str) -> str:
    """The backend that a name stands for; says once in the log what ``auto`` became and why."""
    if backend not in BACKENDS:
        raise InputError(f"backend is {backend!r}, expected one of {', '.join(BACKENDS)}", "use auto")
    if backend != "auto":
        return backend
    if torch.cuda.is_available():
        reason = cuda.unavailable() or disagreement(cuda.CudaRenderer())
        if reason is None:
            log.info("backend auto: CUDA (%s)", torch.cuda.get_device_name())
            return "cuda"
        log.warning("backend auto: the processor, because CUDA cannot be used: %s", reason)
    reason = library.unavailable()
    if reason is None:
        log.info("backend auto: native engine (%s)", library.isa())
        return "native"
    log.warning("backend auto: slow reference renderer, because the native engine is not available: %s", reason)
    return "reference"


def get(backend: str = "auto", threads: int | None = None) -> Renderer:
    """Renderer by name.

    Args:
        backend: ``cuda`` (Triton), ``gsplat``, ``native``, ``reference``, or ``auto``: cuda where there is a device
            for it and it draws a small scene as the reference does, else native where it is built.
        threads: threads of the native engine; all available processors when ``None``.

    Raises:
        InputError: no such backend.
        BackendError: a backend was asked for by name and is not available.
    """
    name = resolve_backend(backend)
    if name in ("cuda", "gsplat"):
        return cuda.CudaRenderer() if name == "cuda" else cuda.GsplatRenderer()
    if name == "native":
        from toonifygb.render.native import NativeRenderer

        return NativeRenderer(threads)
    from toonifygb.render.reference import ReferenceRenderer

    return ReferenceRenderer()


def kernels(backend: str = "auto", threads: int | None = None) -> Kernels:
    """Fused training kernels by name; arguments and errors as in ``get``."""
    name = resolve_backend(backend)
    if name in ("cuda", "gsplat"):
        from toonifygb.render.cuda_fused import CudaKernels

        return CudaKernels()
    if name == "native":
        from toonifygb.render.native_fused import NativeKernels

        return NativeKernels(threads)
    from toonifygb.render.fused import ReferenceKernels

    return ReferenceKernels()
