"""Log output: structured fields to the systemd journal under the service manager, plain lines to a terminal."""

from __future__ import annotations

import logging
import math
import os
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Final

from daemon.system.traceback_limit import limit_tracebacks

JOURNAL: Final = Path("/run/systemd/journal/socket")
TERMINAL_FORMAT: Final = "%(asctime)s %(levelname)-7s %(message)s"
OURS: Final = ("daemon", "estimator", "hal", "taps")
"""Packages of this project."""
PRIORITY: Final = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6, logging.DEBUG: 7}
"""Priority of syslog(3), by level."""
LONGEST: Final = 32_768
"""Longest message in bytes: it has to fit into one datagram."""

LIBRARY_LINES: Final = 10
LIBRARY_S: Final = 10.0
"""Most lines of one other package's logger in an interval of this length, s."""
LEFT_OUT: Final = " (%d more such lines were skipped before it)"

Fields = Mapping[str, object]


class Sparing:
    """Rate limiter of log lines for events at a rate that others control; suppressed lines are counted.

    Args:
        log: receives the lines. lines, seconds: largest number of lines in an interval of this length (s).
    """

    def __init__(self, log: logging.Logger, lines: int = 10, seconds: float = 10.0) -> None:
        self._log, self._lines, self._seconds = log, lines, seconds
        self._until = -math.inf
        self._told = self._left_out = 0

    def say(self, t_mono: float, level: int, text: str) -> None:
        """Log the line, or count it if the limit of the interval is reached."""
        if t_mono >= self._until:
            self._until, self._told = t_mono + self._seconds, 0
        if self._told == self._lines:
            self._left_out += 1
            return
        more, self._left_out = self._left_out, 0
        self._told += 1
        self._log.log(level, "%s%s", text, LEFT_OUT % more if more else "")


class LibraryLimit(logging.Filter):
    """Filter of a log handler: lines of other packages, whose rate a client may control; suppressed ones are counted.

    Args:
        now: monotonic time, s.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now = now
        self._until, self._told, self._left_out = -math.inf, Counter[str](), Counter[str]()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return False for a line that is left out."""
        name = record.name
        if name.partition(".")[0] in OURS or record.exc_info:
            return True
        if self._now() >= self._until:
            self._until = self._now() + LIBRARY_S
            self._told.clear()
        if self._told[name] >= LIBRARY_LINES:  # more than that: two threads at once
            self._left_out[name] += 1
            return False
        self._told[name] += 1
        if more := self._left_out.pop(name, 0):
            record.msg = f"{record.msg}{LEFT_OUT % more}"
        return True


class _ZonedTime(logging.Formatter):
    """Lines with date, time and zone (ISO 8601, to the millisecond)."""

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:  # logging's name
        return datetime.fromtimestamp(record.created).astimezone().isoformat(" ", "milliseconds")


def set_level(level: str) -> None:
    """Log from this level on: debug, info, warning or error. Lines of other packages than ours stay as they are.

    It also holds for commands without a log, whose warnings Python prints on stderr.
    """
    for name in OURS:
        logging.getLogger(name).setLevel(level.upper())
    if logging.lastResort is not None:
        logging.lastResort.setLevel(level.upper())


def start_log() -> None:
    """Start logging: to the journal where stderr is its own stream, otherwise to stderr with the time of day."""
    handler: logging.Handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_ZonedTime(TERMINAL_FORMAT))
    if to_journal():
        handler.setFormatter(_PriorityFormat("%(message)s"))
        handler = JournalHandler(JOURNAL, handler)
        handler.setFormatter(logging.Formatter("%(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    _limit(handler)


def start_command_log() -> None:
    """Start logging of a command beside the daemon: warnings to stderr, as its other messages."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("lumiloop: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    _limit(handler)


def _limit(handler: logging.Handler) -> None:
    handler.addFilter(LibraryLimit())
    limit_tracebacks(handler)


def to_journal() -> bool:
    """Whether stderr is the journal's own stream and not redirected (systemd.exec(5), JOURNAL_STREAM)."""
    try:
        at = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{at.st_dev}:{at.st_ino}"


class JournalHandler(logging.Handler):
    """Log handler that sends each line with its fields in the journal's native protocol.

    The protocol is https://systemd.io/JOURNAL_NATIVE_PROTOCOL.
    It never waits: a line that the journal does not accept at once is lost. The next line that gets through contains
    the count. Where the socket is missing, ``otherwise`` receives the lines.
    """

    def __init__(self, path: Path, otherwise: logging.Handler) -> None:
        super().__init__()
        self.lost = 0
        self._path = str(path)
        self._otherwise = otherwise
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)

    def emit(self, record: logging.LogRecord) -> None:
        """Send one line."""
        try:
            self._socket.sendto(packed(self._fields(record)), self._path)
            self.lost = 0
        except BlockingIOError:
            self.lost += 1
        except OSError:
            self._otherwise.handle(record)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        super().close()

    def _fields(self, record: logging.LogRecord) -> dict[str, object]:
        text = self.format(record).encode(errors="replace")[:LONGEST].decode(errors="ignore")
        lost = {"LUMILOOP_LINES_LOST": self.lost} if self.lost else {}
        return {
            "MESSAGE": text,
            "PRIORITY": PRIORITY.get(record.levelno, 6),
            "SYSLOG_IDENTIFIER": "lumiloop",
            "CODE_FILE": record.pathname,
            "CODE_LINE": record.lineno,
            "CODE_FUNC": record.funcName,
            "LUMILOOP_PART": record.name,
            **lost,
            **record.__dict__.get("fields", {}),
        }


def packed(fields: Fields) -> bytes:
    """Encode one entry of the native protocol; a value with line feeds is preceded by its length."""
    parts = []
    for name, value in fields.items():
        data = str(value).encode(errors="replace")
        if b"\n" in data:
            parts.append(name.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n")
        else:
            parts.append(name.encode() + b"=" + data + b"\n")
    return b"".join(parts)


class _PriorityFormat(logging.Formatter):
    """Formatter after sd-daemon(3): the priority precedes every line of a message."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = f"<{PRIORITY.get(record.levelno, 6)}>"
        return "\n".join(prefix + line for line in super().format(record).splitlines())
