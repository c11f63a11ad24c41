"""How long work tells the world how far it is, and how the world asks it to stop.

A loop calls ``progress.update`` at points where stopping is safe. When the user has asked to stop, ``update``
raises ``Stopped``; a loop with something to save catches it, saves, and raises it again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

T = TypeVar("T")


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


class Part:
    """Progress of one piece of work among several that follow each other.

    Args:
        whole: progress of all of them.
        first: units finished before this piece.
        total: units of all pieces.
    """

    def __init__(self, whole: Progress, first: int, total: int) -> None:
        self._whole, self._first, self._total = whole, first, total

    def update(self, done: int, total: int | None, **figures: float) -> None:
        """Says how far this piece is; ``total``, its own units, is not looked at."""
        self._whole.update(self._first + done, self._total, **figures)

    def over(self, items: Iterable[T]) -> Iterator[T]:
        """The items, each a unit that is finished when the next one is asked for."""
        for done, item in enumerate(items, start=1):
            yield item
            self.update(done, None)
