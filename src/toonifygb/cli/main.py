"""``toonifygb``: reads the command line, runs one command, turns errors into one sentence and an exit code."""

from __future__ import annotations

import difflib
import errno
import inspect
import logging
import os
import sys

from toonifygb import __version__
from toonifygb.cli.commands import COMMANDS
from toonifygb.errors import InputError, ToonifyError
from toonifygb.progress import Stopped

_DISK = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "permission is denied",
    errno.EPERM: "permission is denied",
}
_SETTINGS = "--settings"
EXIT_STOPPED = 130
"""What a shell reports for a command ended by Ctrl-C."""


def main(argv: list[str] | None = None) -> None:
    """Entry point of the ``toonifygb`` command."""
    sys.exit(run(sys.argv[1:] if argv is None else argv))


def run(argv: list[str]) -> int:
    """Runs one command.

    Returns:
        The exit code: 0, or the code of the error class, or 130 when the user stopped the run.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    name = argv[0] if argv else "--help"
    try:
        if name in ("-h", "--help", "--version"):
            print(__version__ if name == "--version" else _overview())
        else:
            _command(name, argv[1:])
    except ToonifyError as error:
        return _fail(error)
    except Stopped:
        print("stopped; the same command goes on from here", file=sys.stderr)
        return EXIT_STOPPED
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from the last finished piece", file=sys.stderr)
        return EXIT_STOPPED
    except BrokenPipeError:  # the reader of our output, `head` for instance, has seen enough
        sys.stdout = open(os.devnull, "w")
        return 0
    except OSError as error:
        if error.errno not in _DISK:
            raise
        place = error.filename or "the output"
        return _fail(
            InputError(f"cannot write {place}: {_DISK[error.errno]}", "free some space or pass another --out")
        )
    return 0


def _overview() -> str:
    """The text of ``toonifygb --help``: made from the commands' docstrings alone, so it appears at once."""
    lines = [
        "usage: toonifygb COMMAND [OPTIONS]",
        "",
        "From a selfie video to a stylised, animatable 3D head avatar.",
        "",
    ]
    for name, command in COMMANDS.items():
        summary = inspect.getdoc(command) or ""
        lines.append(f"  {name:<10} {summary.splitlines()[0]}")
    lines += [
        "",
        "toonifygb COMMAND --help   says what the command takes",
        "toonifygb demo             is the place to start",
    ]
    return "\n".join(lines)


def _command(name: str, argv: list[str]) -> None:
    """Parses the options of one command and runs it."""
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.0)[0]
        raise InputError(
            f"command '{name}' does not exist; available: {', '.join(COMMANDS)}", f"did you mean '{near}'?"
        )
    import tyro

    # Settings of a dataclass are options of the command itself: --steps, not --config.steps.
    markers = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
    tyro.cli(COMMANDS[name], prog=f"toonifygb {name}", args=_gathered(argv), config=markers)


def _gathered(argv: list[str]) -> list[str]:
    """The arguments with the values of every ``--settings`` after the first one: alone, the last would count."""
    own, values, inside = [], [], False
    for argument in argv:
        name, equals, value = argument.partition("=")
        if name == _SETTINGS:
            inside = not equals
            values += [value] if equals else []
        elif argument.startswith("-"):
            inside = False
            own.append(argument)
        else:
            (values if inside else own).append(argument)
    return [*own, _SETTINGS, *values] if values else argv


def _fail(error: ToonifyError) -> int:
    print(f"error: {error.message}", file=sys.stderr)
    if error.hint:
        print(f"  hint: {error.hint}", file=sys.stderr)
    return error.exit_code


if __name__ == "__main__":
    main()
