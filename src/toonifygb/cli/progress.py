"""What a person at the terminal sees while a run works, and how Ctrl-C reaches it."""

from __future__ import annotations

import signal
import sys
import time
from typing import TYPE_CHECKING

from toonifygb.progress import Stopped

if TYPE_CHECKING:
    from types import FrameType

_BAR = 24
_CLEAR = "\r\x1b[2K"
_TTY_EVERY = 0.1
_LOG_EVERY = 10.0


def duration(seconds: float) -> str:
    """``75`` → ``1:15``; ``4000`` → ``1:06:40``."""
    whole = round(seconds)
    hours, minutes, rest = whole // 3600, whole // 60 % 60, whole % 60
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class _StageLine:
    """Progress of one stage as a single line that is redrawn (terminal) or a line now and then (log file)."""

    def __init__(self, terminal: Terminal, title: str) -> None:
        self.terminal = terminal
        self.title = title
        self.start = time.monotonic()
        self.first_done: int | None = None
        self.shown = self.start if not terminal.is_tty else 0.0

    def update(self, done: int, total: int | None, **figures: float) -> None:
        """Redraws the line when it is due; raises ``Stopped`` when the user asked to stop."""
        now = time.monotonic()
        if self.first_done is None:  # work resumed from a checkpoint says nothing about today's speed
            self.first_done, self.start = done, now
        finished = total is not None and done >= total
        if now - self.shown >= (_TTY_EVERY if self.terminal.is_tty else _LOG_EVERY) or finished:
            self.shown = now
            self.terminal.draw(self._text(done, total, figures, now))
        if self.terminal.stop_requested and not finished:
            raise Stopped

    def _text(self, done: int, total: int | None, figures: dict[str, float], now: float) -> str:
        shown = "  ".join(f"{key} {value:.4g}" for key, value in figures.items())
        advanced = done - (self.first_done or 0)
        if not total:
            return f"{self.title:<28} {done}  {shown}"
        share = min(done / total, 1.0)
        filled = round(share * _BAR)
        left = f"{duration((now - self.start) / advanced * (total - done))} left" if advanced > 0 else ""
        bar = "█" * filled + "░" * (_BAR - filled)
        return f"{self.title:<28} {bar} {share:4.0%}  {done}/{total}  {left:<13} {shown}"


class Terminal:
    """A ``Reporter`` that writes to standard error and listens for Ctrl-C.

    The first Ctrl-C lets the current stage save and stop; the second one ends the process at once.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self.is_tty = sys.stderr.isatty()
        self.stop_requested = False
        self._line_open = False

    def listen(self) -> None:
        """Takes over SIGINT and SIGTERM."""
        signal.signal(signal.SIGINT, self._on_signal)
        signal.signal(signal.SIGTERM, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.stop_requested:
            raise KeyboardInterrupt
        self.stop_requested = True
        self.say("stopping after saving; press Ctrl-C again to stop at once")

    def draw(self, text: str) -> None:
        """Shows a line that the next ``draw`` replaces."""
        if self.quiet:
            return
        if self.is_tty:
            sys.stderr.write(f"{_CLEAR}{text}")
            self._line_open = True
        else:
            sys.stderr.write(f"{text.rstrip()}\n")
        sys.stderr.flush()

    def say(self, text: str) -> None:
        """Shows a line that stays."""
        if self.quiet:
            return
        sys.stderr.write(f"{_CLEAR if self._line_open else ''}{text}\n")
        self._line_open = False
        sys.stderr.flush()

    def stage(self, name: str, title: str) -> _StageLine:
        """Begins the line of a stage."""
        if not self.is_tty:
            self.say(f"{title} …")
        return _StageLine(self, title)

    def cached(self, name: str, title: str) -> None:
        """Says that a finished stage is reused."""
        self.say(f"✓ {title:<34} as before")

    def finished(self, title: str, seconds: float) -> None:
        """Closes the line of a stage."""
        self.say(f"✓ {title:<34} {duration(seconds)}")

    def note(self, sentence: str) -> None:
        """One thing worth knowing."""
        self.say(f"  note: {sentence}")
