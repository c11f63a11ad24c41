"""What a style is: the protocol and the registry.

A stylizer looks at a clip once (``prepare``) and is then a pure function of each chunk of frames (``apply``), so
that any worker can do any chunk and killed runs resume with identical frames. Steadiness in time therefore comes
from anchoring (landmarks, a prepared palette, fixed noise in head coordinates), never from state between frames.
"""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, Any, Protocol

from toonifygb.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from jaxtyping import Float, UInt8


class Stylizer(Protocol):
    """One style.

    Images are uint8 RGB ``(t, h, w, 3)``; landmarks are px ``(t, 478, 2)``, NaN where no face was found; mattes
    are person mattes ``(t, h, w)`` in 0..1.
    """

    name: str
    description: str
    """One line for ``--help``."""

    def prepare(self, samples: UInt8[np.ndarray, "s h w 3"], landmarks: Float[np.ndarray, "s 478 2"]) -> Any:
        """Whatever the whole clip shares (palette, exposure, scale), from frames sampled over it.

        The result is a plain dict of numbers and numpy arrays: it is stored with the run.
        """
        ...

    def apply(
        self,
        frames: UInt8[np.ndarray, "t h w 3"],
        landmarks: Float[np.ndarray, "t 478 2"],
        mattes: Float[np.ndarray, "t h w"] | None,
        state: Any,
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
