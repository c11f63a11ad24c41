"""Renderers: a readable reference, and the native CPU engine that must agree with it."""

from __future__ import annotations

import functools
import logging
from typing import TYPE_CHECKING

from toonifygb.errors import InputError
from toonifygb.render import library
from toonifygb.render.base import DEFAULT_CONSTANTS, RasterConstants, Renderer, RenderInfo

if TYPE_CHECKING:
    from toonifygb.render.fused import Kernels

__all__ = ["DEFAULT_CONSTANTS", "RasterConstants", "RenderInfo", "Renderer", "get", "kernels", "resolve_backend"]

log = logging.getLogger(__name__)

BACKENDS = ("auto", "native", "reference")


@functools.cache
def resolve_backend(backend: str) -> str:
    """``native`` or ``reference`` for a backend's name; says once in the log what ``auto`` became and why."""
    if backend not in BACKENDS:
        raise InputError(f"backend is {backend!r}, expected one of {', '.join(BACKENDS)}", "use auto")
    if backend != "auto":
        return backend
    reason = library.unavailable()
    if reason is None:
        log.info("backend auto: native engine (%s)", library.isa())
        return "native"
    log.warning("backend auto: slow reference renderer, because the native engine is not available: %s", reason)
    return "reference"


def get(backend: str = "auto", threads: int | None = None) -> Renderer:
    """Renderer by name.

    Args:
        backend: ``native``, ``reference``, or ``auto``: native where it is built.
        threads: threads of the native engine; all available processors when ``None``.

    Raises:
        InputError: no such backend.
        BackendError: ``native`` was asked for and is not available.
    """
    if resolve_backend(backend) == "native":
        from toonifygb.render.native import NativeRenderer

        return NativeRenderer(threads)
    from toonifygb.render.reference import ReferenceRenderer

    return ReferenceRenderer()


def kernels(backend: str = "auto", threads: int | None = None) -> Kernels:
    """Fused training kernels by name; arguments and errors as in ``get``."""
    if resolve_backend(backend) == "native":
        from toonifygb.render.native_fused import NativeKernels

        return NativeKernels(threads)
    from toonifygb.render.fused import ReferenceKernels

    return ReferenceKernels()
