"""A text on the whole terminal that is renewed: long lines are wrapped, and keys scroll it."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import sys
import termios
import textwrap
import tty
from collections.abc import Iterator
from typing import Final

CLEAR: Final = "\x1b[H\x1b[2J"
KEYS: Final = {
    "j": "down", "\x1b[B": "down", "k": "up", "\x1b[A": "up", " ": "page down", "\x1b[6~": "page down",
    "b": "page up", "\x1b[5~": "page up", "g": "begin", "\x1b[H": "begin", "G": "end", "\x1b[F": "end", "q": "quit",
}  # fmt: skip
"""What a key does, by the bytes that a terminal sends for it."""
_LEAST_ROOM: Final = 2
_LONGEST_KEY: Final = 16


class Screen:
    """The text that is shown, and where in it the window begins.

    Args:
        indent: columns by which the continuation of a wrapped line is indented.
    """

    def __init__(self, indent: int) -> None:
        self._indent, self._first = indent, 0
        self._text = ""

    def show(self, text: str) -> None:
        """Show a text from the line that was the first before, in the present size of the terminal."""
        self._text = text
        columns, rows = shutil.get_terminal_size()
        lines, room = wrapped(text, columns, self._indent), max(_LEAST_ROOM, rows)
        if len(lines) > room:
            self._first = min(self._first, len(lines) - room + 1)
            shown = lines[self._first : self._first + room - 1]
            last = self._first + len(shown)
            shown.append(
                f"-- lines {self._first + 1} to {last} of {len(lines)}; scroll with arrows, space and b, quit with q"[
                    :columns
                ]
            )
        else:
            self._first, shown = 0, lines
        sys.stdout.write(CLEAR + "\n".join(shown))
        sys.stdout.flush()

    def scroll(self, action: str) -> None:
        """Move the window as a key of :data:`KEYS` does, and show the text again."""
        page = max(1, shutil.get_terminal_size().lines - 2)
        moves = {"down": 1, "up": -1, "page down": page, "page up": -page, "begin": -self._first, "end": sys.maxsize}
        self._first = max(0, self._first + moves[action])
        self.show(self._text)


def wrapped(text: str, columns: int, indent: int) -> list[str]:
    """The lines of a text, each at most ``columns`` wide; nothing is left out."""
    hang = " " * (indent if columns > 2 * indent else 0)
    lines = []
    for line in text.splitlines():
        lines += textwrap.wrap(line, max(1, columns), subsequent_indent=hang) if len(line) > columns else [line]
    return lines


@contextlib.contextmanager
def keyboard() -> Iterator[bool]:
    """Single keys without an echo while this lasts; yields whether there is a keyboard."""
    try:
        before = termios.tcgetattr(sys.stdin)
    except (termios.error, OSError, ValueError):  # no terminal
        yield False
        return
    try:
        tty.setcbreak(sys.stdin, termios.TCSANOW)
        yield True
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSANOW, before)


def key(timeout_s: float) -> str:
    """What the next key within a time does, after :data:`KEYS`; empty: no such key."""
    if not select.select([sys.stdin], [], [], max(0.0, timeout_s))[0]:
        return ""
    pressed = os.read(sys.stdin.fileno(), _LONGEST_KEY).decode(errors="replace")
    return KEYS.get(pressed, KEYS.get(pressed[:1], ""))
