"""What a style is: the protocol and the registry.

A stylizer looks at a clip once (``prepare``) and is then a pure function of each chunk of frames (``apply``), so
that any worker can do any chunk and killed runs resume with identical frames. Steadiness in time therefore comes
from anchoring (landmarks, a prepared palette, fixed noise), never from state between frames. ``run`` does around
it what is common to all styles: it calms sensor noise, warps the face, and blends by strength.
"""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, Any, Protocol

from toonifygb.errors import InputError

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
        """The frames in this style, same size and count; independent of what was applied before."""
        ...


_FACTORIES: dict[str, Callable[[], Stylizer]] = {}


def register(name: str, factory: Callable[[], Stylizer]) -> None:
    """Makes ``get(name)`` return ``factory()``."""
    _FACTORIES[name] = factory


def available() -> tuple[str, ...]:
    """Names of the styles that work without further files."""
    return tuple(sorted(_FACTORIES))


def get(name: str) -> Stylizer:
    """The style of that name.

    Raises:
        InputError: no such style; the nearest name is offered.
    """
    if name in _FACTORIES:
        return _FACTORIES[name]()
    near = difflib.get_close_matches(name, available(), n=1, cutoff=0.0)
    raise InputError(
        f"style '{name}' does not exist; available: {', '.join(available())}",
        f"did you mean '{near[0]}'?" if near else "",
    )
