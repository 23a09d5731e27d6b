"""Control interface for fault orders while the devices run: text lines over a unix socket or a method call.

::

    order WORD [key=value ...]   silence for=2      bit_flip part=sum count=3      status code=98
    clear [WORD [DEVICE]]        lift what is in force and forget what is to come
    list                         what is in force or to come
    words [DEVICE]               the vocabulary

The last line of an answer is ``ok`` or ``refused: why``.
"""

from __future__ import annotations

import asyncio
import contextlib
import shlex
import stat
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hal.errors import DeviceRefused
from hal.fake.faults.orders import FaultError, Word, read_fault
from hal.fake.faults.schedule import FaultSchedule


def _value(text: str) -> Any:
    """A TOML value; an unquoted word is a text."""
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text


def _described(name: str, word: Word) -> str:
    keys = " ".join(f"{key}={rule.default!r}" for key, rule in word.parameters.items())
    return f"{name} ({word.kind}) {keys}{' ' if keys else ''}- {word.help}"


class Control:
    """Parses control lines and passes orders to a schedule."""

    def __init__(self, schedule: FaultSchedule) -> None:
        self._schedule = schedule

    def answer(self, line: str) -> str:
        """Carry out one line; the answer ends with ``ok`` or ``refused: why`` and a newline."""
        try:
            return "".join(f"{text}\n" for text in self._execute(line)) + "ok\n"
        except (FaultError, ValueError) as error:  # ValueError: quotes that do not close
            return f"refused: {error}\n"

    def _execute(self, line: str) -> Iterable[str]:
        verb, *words = shlex.split(line, posix=False) or ["list"]
        if verb == "order":
            return self._order(words)
        if verb == "clear":
            return [f"cleared {fault}" for fault in self._schedule.clear(*words[:2])]
        if verb == "list":
            return list(self._schedule.listing())
        if verb == "words":
            return [
                f"{device}: {_described(name, word)}"
                for device, vocabulary in self._schedule.vocabularies.items()
                if words[:1] in ([], [device])
                for name, word in vocabulary.items()
            ]
        raise FaultError(verb, "expected order, clear, list or words")

    def _order(self, words: list[str]) -> list[str]:
        table: dict[str, Any] = {}
        for word in words:
            key, equals, text = word.partition("=")
            table[key if equals else "what"] = _value(text) if equals else key
        fault = read_fault(table, "order", self._schedule.vocabularies)
        self._schedule.order(fault)
        return [f"ordered {fault}"]


def _remove_stale_socket(path: Path) -> None:
    if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
        raise DeviceRefused(str(path), "the path exists and is not a socket", "choose another path")
    path.unlink(missing_ok=True)


async def serve_control(control: Control, path: Path) -> asyncio.Server:
    """Answer control lines on a unix socket until the returned server is closed.

    Raises:
        DeviceRefused: ``path`` exists and is no socket.
    """
    _remove_stale_socket(path)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError, ValueError), contextlib.closing(writer):  # ValueError: endless line
            while line := await reader.readline():
                writer.write(control.answer(line.decode("utf-8", errors="replace")).encode())
                await writer.drain()

    return await asyncio.start_unix_server(serve, path)
