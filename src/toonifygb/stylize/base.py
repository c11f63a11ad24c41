"""What a style is: the protocol and the registry.

A stylizer looks at a clip once (``prepare``) and is then a pure function of each chunk of frames (``apply``), so
that any worker can do any chunk and killed runs resume with identical frames. Steadiness in time therefore comes
from anchoring (landmarks, a prepared palette, fixed noise), never from state between frames. ``run`` does around
it what is common to all styles: it calms sensor noise, warps the face, and blends by strength.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from toonifygb.config import StyleganexConfig
from toonifygb.errors import InputError
from toonifygb.stylize import plugin

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from jaxtyping import Float, UInt8

    from toonifygb.stylize.anchors import Faces
    from toonifygb.stylize.exaggerate import Exaggeration


class Stylizer(Protocol):
    """One style.

    Images are uint8 RGB; ``faces`` holds one steadied set of landmarks per frame and how far it is to be trusted
    (``presence``); mattes are person mattes in 0..1.
    """

    name: str
    description: str
    """One line for ``--help``."""
    exaggeration: Exaggeration
    """Caricature applied to frames, landmarks and mattes before ``apply`` sees them."""
    denoise: bool
    """Whether frames are calmed in time before ``apply`` sees them."""

    def prepare(self, samples: UInt8[np.ndarray, "s h w 3"], faces: Faces) -> dict[str, Any]:
        """Whatever the whole clip shares (palette, exposure, scale), from frames sampled over it.

        The result is a plain dict of numbers and numpy arrays: it is stored with the run.
        """
        ...

    def apply(
        self,
        frames: UInt8[np.ndarray, "t h w 3"],
        faces: Faces,
        mattes: Float[np.ndarray, "t h w"] | None,
        state: dict[str, Any],
    ) -> UInt8[np.ndarray, "t h w 3"]:
        """The frames in this style, same count and size; independent of what was applied before.

        A style may be set to give larger frames; these can be neither blended with the source nor made an avatar.
        """
        ...


_FACTORIES: dict[str, Callable[[], Stylizer]] = {}
_WITH_WEIGHTS: dict[str, WeightedStyle] = {}
_BY_SUFFIX: dict[str, Callable[[Path, StyleganexConfig], Stylizer]] = {}


@dataclass(frozen=True)
class WeightedStyle:
    """A style that works once its weights are there."""

    open: Callable[[StyleganexConfig], Stylizer]
    """The style; raises InputError, saying how to get them, where its weights are missing."""
    weights: Callable[[], Path | None]
    """File of its weights, if it is there."""


def register(name: str, factory: Callable[[], Stylizer]) -> None:
    """Makes ``get(name)`` return ``factory()``."""
    _FACTORIES[name] = factory


def register_weighted(name: str, style: WeightedStyle) -> None:
    """Makes ``get(name)`` open a style whose weights do not come with the package."""
    _WITH_WEIGHTS[name] = style


def register_kind(suffix: str, open_file: Callable[[Path, StyleganexConfig], Stylizer]) -> None:
    """Makes ``get`` open files whose names end in ``suffix`` by ``open_file``."""
    _BY_SUFFIX[suffix] = open_file


def available() -> tuple[str, ...]:
    """Names of the styles that work without further files."""
    return tuple(sorted(_FACTORIES))


def get(name: str, options: StyleganexConfig | None = None) -> Stylizer:
    """The style of that name; the network of a weighted style is not read before it is used.

    Args:
        name: of a style, or path of a file: a model (``.onnx``, ``.ts``, ``.torchscript``; see ``plugin``), or a
            style of StyleGANEX (``.safetensors``).
        options: settings of the styles that run StyleGANEX.

    Raises:
        InputError: no such style (the nearest name is offered), its weights are missing, or its file is no model
            that can be used.
    """
    if name in _FACTORIES:
        return _FACTORIES[name]()
    if name in _WITH_WEIGHTS:
        return _WITH_WEIGHTS[name].open(options or StyleganexConfig())
    suffix = Path(name).suffix.lower()
    if suffix in _BY_SUFFIX:
        return _BY_SUFFIX[suffix](Path(name), options or StyleganexConfig())
    if plugin.is_model_file(name):
        return plugin.open_model(Path(name))
    near = difflib.get_close_matches(name, (*available(), *_WITH_WEIGHTS), n=1, cutoff=0.0)
    raise InputError(
        f"style '{name}' does not exist; available: {', '.join(available())}",
        f"did you mean '{near[0]}'?" if near else "",
    )


def files(name: str) -> tuple[Path, ...]:
    """Files a style reads beside the package: what its frames depend on beside the settings."""
    if name in _WITH_WEIGHTS:
        weights = _WITH_WEIGHTS[name].weights()
        return () if weights is None else (weights,)
    if Path(name).suffix.lower() in _BY_SUFFIX:
        return (Path(name),)
    return plugin.model_files(Path(name)) if plugin.is_model_file(name) else ()
