"""Console output of commands on stderr, and their exit codes.

Exit codes: 0 done, 1 failed (the text states why and the remedy), 2 wrong usage or configuration, 130 interrupted.
"""

from __future__ import annotations

import sys
from typing import Final

OK: Final = 0
FAILED: Final = 1
USAGE: Final = 2
INTERRUPTED: Final = 130


def fail(message: str, code: int = FAILED) -> int:
    """Print an error message on stderr and return the exit code."""
    sys.stderr.write(f"lumiloop: {message}\n")
    return code


class _Output:
    quiet = False


def be_quiet(quiet: bool = True) -> None:
    """Print no notes and no progress from now on, or print them again; errors and results stay."""
    _Output.quiet = quiet


def note(text: str) -> None:
    """Print a line on stderr that is no result, unless the user wants none."""
    if not _Output.quiet:
        say(text)


def progress(text: str) -> None:
    """Print a progress line on stderr: overwritten on a terminal, appended elsewhere."""
    if _Output.quiet:
        return
    sys.stderr.write(f"\r\x1b[K{text}" if sys.stderr.isatty() else f"{text}\n")
    sys.stderr.flush()


def say(text: str) -> None:
    """Print one line on stderr and flush it."""
    sys.stderr.write(f"lumiloop: {text}\n")
    sys.stderr.flush()
