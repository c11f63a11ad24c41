"""Progress of several pieces of work that follow each other."""

from __future__ import annotations

from toonifygb.progress import Part


class Notes:
    def __init__(self) -> None:
        self.seen: list[tuple[int, int | None, dict[str, float]]] = []

    def update(self, done: int, total: int | None, **figures: float) -> None:
        self.seen.append((done, total, figures))


def test_parts_make_one_whole() -> None:
    notes = Notes()
    first, second = Part(notes, 0, 5), Part(notes, 2, 5)
    first.update(2, 2, loss=0.5)
    assert list(second.over("abc")) == ["a", "b", "c"]
    assert notes.seen == [(2, 5, {"loss": 0.5}), (3, 5, {}), (4, 5, {}), (5, 5, {})]


def test_an_item_counts_when_the_next_is_asked_for() -> None:
    notes = Notes()
    items = Part(notes, 0, 2).over("ab")
    next(items)
    assert notes.seen == []
    next(items)
    assert [done for done, _, _ in notes.seen] == [1]
