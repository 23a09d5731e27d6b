"""Ports of loopback for what a test or a bench starts."""

from __future__ import annotations

import contextlib
import socket


class NoFreePort(RuntimeError):
    """No port is free; the text has the remedy."""


def free_port() -> int:
    """A port that is free on loopback for both TCP and UDP just now. Raises `NoFreePort`."""
    for _ in range(50):
        with socket.socket() as tcp, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", 0))
            port = int(tcp.getsockname()[1])
            with contextlib.suppress(OSError):
                udp.bind(("127.0.0.1", port))
                return port
    raise NoFreePort("no port is free on 127.0.0.1 for both TCP and UDP; close some programs")
