"""`lumiloop status`: reads a running daemon over Modbus UDP and prints it as a table or as JSON.

Standard library only, so that it starts at once on any computer.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from typing import TYPE_CHECKING, Final

from daemon.cli.reports.output import print_report
from daemon.cli.reports.status import as_object
from daemon.cli.reports.terminal_screen import Screen, key, keyboard
from daemon.cli.status_table import as_table
from daemon.publish.modbus.client import NoAnswer, Reader, Reading
from daemon.publish.modbus.points import Value
from daemon.publish.port_owner import Whose

if TYPE_CHECKING:
    from daemon.config.schema import Config

OK: Final = 0
FAILED: Final = 1
DEFAULT_PORT: Final = 1502
_STALL_S: Final = 0.4  # the slowest lidar makes a snapshot every 0.15 s
_REFRESH_S: Final = 0.5
_ANY_HOST: Final = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}
_INDENT: Final = 11  # of a wrapped line: below the text, not below the label


def main(args: argparse.Namespace) -> int:
    """Runs the command; `args` has address, json, watch, and settings (:class:`daemon.config.schema.Config`)."""
    try:
        host, port = address_of(args.address, args.settings)
        with Reader(host, port, None if args.address or args.settings is None else args.settings.name) as reader:
            return _watch(reader, args.json) if args.watch else _once(reader, args.json)
    except NoAnswer as error:
        sys.stderr.write(f"lumiloop: {error}\n")
        return FAILED


def address_of(text: str | None, settings: Config | None) -> tuple[str, int]:
    """Returns host and port to read: as named, else those on which the configured daemon listens.

    Raises:
        NoAnswer: not an address.
    """
    if not text:
        host, port = (settings.bind, settings.modbus.port) if settings is not None else ("127.0.0.1", DEFAULT_PORT)
        if port == 0:
            raise NoAnswer("Modbus is disabled in the configuration (modbus.port is 0); name HOST:PORT")
        return _ANY_HOST.get(host, host), port
    host, colon, port_text = text.rpartition(":")
    if text.startswith("[") and text.endswith("]"):
        return text[1:-1], DEFAULT_PORT
    if not colon or (":" in host and not host.startswith("[")):
        return text, DEFAULT_PORT
    if not (port_text.isascii() and port_text.isdigit() and 0 < int(port_text) < 1 << 16):
        raise NoAnswer(f"{text}: {port_text!r} is not a port; give HOST or HOST:PORT, as in 192.168.0.10:1502")
    return host.strip("[]") or "127.0.0.1", int(port_text)


def _once(reader: Reader, as_json: bool) -> int:
    first = reader.read()
    who = reader.whose()
    time.sleep(_STALL_S)
    reading = reader.read()
    _show(reading, as_json, reading["seq"] == first["seq"], who)
    return OK


def _watch(reader: Reader, as_json: bool) -> int:
    screen = Screen(_INDENT) if sys.stdout.isatty() and not as_json else None
    with keyboard() if screen is not None else contextlib.nullcontext(False) as keys:
        return _watch_on(reader, as_json, screen, keys)


def _watch_on(reader: Reader, as_json: bool, screen: Screen | None, keys: bool) -> int:
    before: Value = None
    who, told = None, ""
    while True:
        try:
            reading = reader.read()
            who = reader.whose() if before is None or who is None else who
        except NoAnswer as error:
            if screen is not None:
                screen.show(f"{error}; waiting")
            elif str(error) != told:
                sys.stderr.write(f"lumiloop: {error}; waiting\n")
            before, told = None, str(error)
        else:
            told = ""
            _show(reading, as_json, reading["seq"] == before, who, screen)
            before = reading["seq"]
        if screen is None or not keys:
            time.sleep(_REFRESH_S)
        elif not _scroll(screen):
            return OK


def _scroll(screen: Screen) -> bool:
    """Scroll by the keys that are pressed until the next look; returns whether to go on."""
    end = time.monotonic() + _REFRESH_S
    while (left := end - time.monotonic()) > 0.0:
        action = key(left)
        if action == "quit":
            sys.stdout.write("\n")
            return False
        if action:
            screen.scroll(action)
    return True


def _show(reading: Reading, as_json: bool, stalled: bool, who: Whose, screen: Screen | None = None) -> None:
    if as_json:
        print_report("status", as_object(reading, stalled, who.pid))
        return
    table, owner = as_table(reading, stalled), f"{'daemon':<10} {who}" if who.pid else ""
    text = "\n".join(filter(None, [owner, table] if screen is None else [table, owner]))  # on a screen: state first
    if screen is not None:
        screen.show(text)
        return
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
