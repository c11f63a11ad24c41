"""How long work tells the world how far it is, and how the world asks it to stop.

A loop calls ``progress.update`` at points where stopping is safe. When the user has asked to stop, ``update``
raises ``Stopped``; a loop with something to save catches it, saves, and raises it again.
"""

from __future__ import annotations

from typing import Protocol


class Stopped(Exception):
    """The user asked to stop; everything finished so far is on disk."""


class Progress(Protocol):
    """Receiver of progress."""

    def update(self, done: int, total: int | None, **figures: float) -> None:
        """Says that ``done`` of ``total`` units are finished, with figures worth showing (``loss=0.12``).

        Raises:
            Stopped: the user asked to stop.
        """
        ...


class Silent:
    """Progress that nobody watches."""

    def update(self, done: int, total: int | None, **figures: float) -> None:
        """Does nothing."""


SILENT = Silent()
