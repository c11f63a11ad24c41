"""Finding and loading the native engine: a shared library with a plain C interface, called through ctypes."""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import logging
import os
from ctypes import POINTER, Structure, c_char_p, c_double, c_float, c_int32, c_int64, c_void_p
from pathlib import Path
from typing import TYPE_CHECKING

from toonifygb.errors import BackendError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

log = logging.getLogger(__name__)

STEM = "toonifygb_native"
PATH_VARIABLE = "TOONIFYGB_NATIVE_LIB"
"""Environment variable naming the library file; searched for beside this file and in the installation if unset."""
ISA_VARIABLE = "TOONIFYGB_NATIVE_ISA"
"""Environment variable forcing an instruction set: avx512, avx2 or generic; the best available if unset."""
BUILD_HINT = "reinstall the package with g++ or clang++ on the PATH, or use the reference backend"


class Constants(Structure):
    """Mirrors ``tgb::Constants`` of native/src/raster.h."""

    _fields_ = [
        *((name, c_float) for name in ("near", "alpha_max", "alpha_min", "low_pass", "transmittance_min")),
        *((name, c_float) for name in ("frustum_margin", "radius_sigmas")),
        ("tile", c_int32),
    ]


class Camera(Structure):
    """Mirrors ``tgb::Camera``."""

    _fields_ = [
        ("view", c_float * 12),
        *((name, c_float) for name in ("fx", "fy", "cx", "cy")),
        ("width", c_int32),
        ("height", c_int32),
    ]


class Splats(Structure):
    """Mirrors ``tgb::Splats``."""

    _fields_ = [
        *((name, c_int32) for name in ("n", "sh_stored", "sh_degree")),
        *((name, c_void_p) for name in ("means", "quats", "scales", "opacities", "sh", "sh_frames")),
    ]


class Scene(Structure):
    """Mirrors ``tgb::Scene``."""

    _fields_ = [
        ("constants", Constants),
        ("camera", Camera),
        ("splats", Splats),
        ("background", c_float * 3),
        ("threads", c_int32),
    ]


class Gradients(Structure):
    """Mirrors ``tgb::Gradients``."""

    _fields_ = [
        *((name, c_void_p) for name in ("v_color", "v_alpha")),
        *((name, c_void_p) for name in ("means", "quats", "scales", "opacities", "sh", "sh_frames")),
        ("mean2d_color", c_void_p),
    ]


class AdamRates(Structure):
    """Mirrors ``tgb::AdamRates`` of native/src/training.h."""

    _fields_ = [*((name, c_double) for name in ("beta1", "beta2", "eps", "factor")), ("step", c_int64)]


class BlendState(Structure):
    """Mirrors ``tgb::BlendState``."""

    _fields_ = [
        *((name, c_void_p) for name in ("deltas", "first_moment", "second_moment")),
        *((name, c_void_p) for name in ("psi", "gradient", "learning_rates", "scale", "widths")),
        ("p", c_int64),
        *((name, c_int32) for name in ("k", "n", "groups", "skip_inactive", "frames")),
    ]


class Picture(Structure):
    """Mirrors ``tgb::Picture``."""

    _fields_ = [
        *((name, c_void_p) for name in ("frame", "matte", "background")),
        ("height", c_int32),
        ("width", c_int32),
    ]


class Skin(Structure):
    """Mirrors ``tgb::Skin``."""

    _fields_ = [
        *((name, c_void_p) for name in ("means", "quats", "log_scales", "opacity_logits", "weights", "transforms")),
        ("n", c_int32),
    ]


class SkinOutput(Structure):
    """Mirrors ``tgb::SkinOutput``."""

    _fields_ = [(name, c_void_p) for name in ("means", "quats", "scales", "opacities", "sh_frames")]


class SkinGradient(Structure):
    """Mirrors ``tgb::SkinGradient``."""

    _fields_ = [(name, c_void_p) for name in ("means", "quats", "log_scales", "opacity_logits")]


class DeltaGroup(Structure):
    """Mirrors ``tgb::DeltaGroup`` of native/src/playback.h."""

    _fields_ = [
        *((name, c_int32) for name in ("first", "width", "bytes")),
        *((name, c_void_p) for name in ("begin", "row", "steps", "levels")),
    ]


class Playback(Structure):
    """Mirrors ``tgb::Playback``."""

    _fields_ = [
        *((name, c_int32) for name in ("n", "rows", "sh_degree")),
        *((name, c_void_p) for name in ("neutral", "weights")),
        ("groups", DeltaGroup * 3),
    ]


_SIGNATURES = {
    "tgb_isa": (c_char_p, []),
    "tgb_set_isa": (c_int32, [c_char_p]),
    "tgb_raster_forward": (c_void_p, [POINTER(Scene), c_void_p, c_void_p, c_void_p, POINTER(c_double)]),
    "tgb_raster_backward": (c_int32, [c_void_p, POINTER(Scene), POINTER(Gradients), POINTER(c_double)]),
    "tgb_raster_release": (None, [c_void_p]),
    "tgb_raster_counts": (None, [c_void_p, POINTER(c_int32)]),
    "tgb_play": (
        c_int32,
        [POINTER(Playback), c_void_p, c_void_p, POINTER(Scene), c_void_p, c_void_p, POINTER(c_double)],
    ),
    "tgb_measure_flops": (c_double, []),
    "tgb_blend": (None, [c_void_p, c_void_p, c_int32, c_void_p, c_int32, c_int64, c_void_p, c_int32]),
    "tgb_add_blends": (None, [c_void_p, c_void_p, c_int32, c_int32, c_int64, c_void_p, c_int64, c_int32]),
    "tgb_adam": (None, [*[c_void_p] * 5, c_int64, POINTER(AdamRates), c_int32]),
    "tgb_blend_adam": (None, [POINTER(BlendState), POINTER(AdamRates), c_int32]),
    "tgb_skin": (None, [POINTER(Skin), POINTER(SkinOutput), c_int32]),
    "tgb_skin_backward": (None, [POINTER(Skin), POINTER(SkinOutput), POINTER(SkinGradient), c_int32]),
    "tgb_place": (c_int32, [POINTER(Picture), c_int32, c_void_p, c_void_p, c_int32]),
    "tgb_l1_dssim": (c_double, [c_void_p, c_void_p, c_int32, c_int32, c_float, c_float, c_void_p, c_int32]),
}


def pointer(tensor: Tensor | None) -> int | None:
    """Address of a contiguous tensor's data; null for ``None``."""
    return None if tensor is None else tensor.data_ptr()


def _candidates() -> Iterator[Path]:
    """Places where the library may be, most explicit first.

    An editable install leaves the sources where they are and puts the library into site-packages, so the installed
    distribution's own list of files is asked too.
    """
    if named := os.environ.get(PATH_VARIABLE):
        yield Path(named)
        return
    yield from sorted(Path(__file__).parent.glob(f"{STEM}.*"))
    try:
        files = importlib.metadata.files("toonifygb") or []
    except importlib.metadata.PackageNotFoundError:
        return
    yield from (Path(str(file.locate())) for file in files if file.stem == STEM)


@functools.cache
def _load() -> ctypes.CDLL | str:
    """The library with its signatures declared, or one clause saying why there is none."""
    path = next((path for path in _candidates() if path.is_file()), None)
    if path is None:
        named = os.environ.get(PATH_VARIABLE)
        return (
            f"{PATH_VARIABLE} names {named}, which is not a file" if named else "it was not built on this machine"
        )
    try:
        library = ctypes.CDLL(str(path))
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        return f"{path} cannot be loaded ({error})"
    isa = os.environ.get(ISA_VARIABLE)
    if isa and not library.tgb_set_isa(isa.encode()):
        return f"{ISA_VARIABLE} asks for {isa}, which this machine or build does not have"
    log.debug("loaded %s (%s)", path, library.tgb_isa().decode())
    return library


def load() -> ctypes.CDLL:
    """The native library, loaded once; a failure is remembered too.

    Raises:
        BackendError: it is not built or cannot be loaded.
    """
    loaded = _load()
    if isinstance(loaded, str):
        raise BackendError(f"the native engine is not available: {loaded}", BUILD_HINT)
    return loaded


def unavailable() -> str | None:
    """Why the native library cannot be used, as a clause; ``None`` when it can."""
    loaded = _load()
    return loaded if isinstance(loaded, str) else None


def isa() -> str:
    """Instruction set in use: avx512, avx2 or generic."""
    return load().tgb_isa().decode()


def set_isa(name: str) -> None:
    """Makes all later calls use instruction set ``name``.

    Raises:
        BackendError: the machine or the build lacks it.
    """
    if not load().tgb_set_isa(name.encode()):
        raise BackendError(f"instruction set {name} is not available here", "use avx512, avx2 or generic")
