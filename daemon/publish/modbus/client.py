"""Modbus UDP client that reads the published blocks of a running daemon. Standard library only."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from typing import Final

from daemon.publish.modbus import dimmed_block, lights_block, registers
from daemon.publish.modbus.block import Block
from daemon.publish.modbus.points import Value
from daemon.publish.modbus.requests import BLOCKS
from daemon.publish.port_owner import Whose, whose

_TRIES: Final = 3
_TIMEOUT_S: Final = 0.5
_REQUEST: Final = struct.Struct(">HHHBBHH")
_ANSWER: Final = struct.Struct(">HHHBBB")
_READ_INPUT: Final = 4
Reading = dict[str, Value]


class NoAnswer(Exception):
    """The daemon cannot be read; the text states the reason and the remedy."""


class Reader:
    """Reads the published block of one daemon. Use as a context manager.

    Args:
        host: name or address.
        port: of the Modbus server.
        name: of the intended daemon on this computer; None: any daemon.

    Raises:
        NoAnswer: the host's name cannot be resolved.
    """

    def __init__(self, host: str, port: int, name: str | None = None) -> None:
        self._where = f"{host}:{port}"
        self._name = name
        self._transaction = 0
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._sock = socket.socket(family, kind)
            self._sock.connect(address)
        except UnicodeError as error:
            raise NoAnswer(f"{self._where}: not a host name; check the address") from error
        except OSError as error:
            raise NoAnswer(f"{self._where}: {error.strerror or error}; check the address") from error
        self._sock.settimeout(_TIMEOUT_S)

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self._sock.close()

    def whose(self) -> Whose:
        """Process that owns the port.

        Raises:
            NoAnswer: it is another daemon than the intended one, which runs too.
        """
        if self._name is None:
            return Whose(0, "", 0)
        found = whose(self._name, *self._sock.getpeername()[:2])
        if found.another:
            raise NoAnswer(
                f"{self._where} belongs to {found}, not to `{self._name}` (process {found.meant}); give one "
                f"of them another `modbus.port`, or use `lumiloop status {self._where}` for that one"
            )
        return found

    def read(self) -> Reading:
        """The latest snapshot.

        Raises:
            NoAnswer: no reply, not a lumiloop, another version.
        """
        for _ in range(_TRIES):
            try:
                answer = self._ask(0, registers.BLOCK_WORDS)
            except TimeoutError:
                continue
            except OSError as error:
                raise NoAnswer(
                    f"{self._where}: {error.strerror}; no Modbus server runs there. Start `lumiloop run`, or "
                    "correct HOST:PORT"
                ) from error
            reading = self._reading(answer)
            for block in BLOCKS:
                if block not in (lights_block.BLOCK, dimmed_block.BLOCK) or reading["links"] is not None:
                    reading |= self._block(block)
            return reading
        raise NoAnswer(
            f"{self._where}: no answer within {_TRIES * _TIMEOUT_S:g} s; check that the daemon runs, that its "
            "`bind` is reachable from here, and that no firewall blocks UDP"
        )

    def _block(self, block: Block) -> Reading:
        """Read a block beside the first one; empty where the daemon's version does not have it."""
        for _ in range(_TRIES):
            with contextlib.suppress(OSError):
                answer = self._ask(block.address, block.registers)
                if len(answer) == _ANSWER.size and answer[7] & 0x80:
                    return {}  # no such block
                with contextlib.suppress(ValueError):
                    reading = block.decode(answer[_ANSWER.size :])
                    del reading["seq"]
                    return reading
        return {}

    def _ask(self, address: int, count: int) -> bytes:
        self._transaction = self._transaction % 0xFFFF + 1
        self._sock.send(_REQUEST.pack(self._transaction, 0, 6, 1, _READ_INPUT, address, count))
        deadline = time.monotonic() + _TIMEOUT_S
        while time.monotonic() < deadline:
            answer = self._sock.recv(512)
            if answer[:2] == self._transaction.to_bytes(2, "big"):
                return answer  # a reply to an earlier, repeated request is skipped
        raise TimeoutError

    def _reading(self, answer: bytes) -> Reading:
        if len(answer) == _ANSWER.size and answer[7] & 0x80:
            raise NoAnswer(f"{self._where}: Modbus exception {answer[8]}; this is another kind of device")
        try:
            return registers.decode_block(answer[_ANSWER.size :])
        except ValueError as error:
            raise NoAnswer(f"{self._where}: {error}") from error
