"""Client of the local command socket: sends one request and returns the reply. Standard library and msgspec only."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from typing import Any, Final

from daemon.config.paths import SERVICE, commands_beside, daemons_in, runtime_folder, stream_path
from daemon.publish.command_messages import request_line
from daemon.publish.modbus.holding import Request

LONGEST_REPLY: Final = 4096


class NotGiven(Exception):
    """An order whose result is not known; the text states the reason and the remedy."""


def give(name: str, request: Request, longest_s: float) -> dict[str, Any]:
    """Give an order to the daemon of that name on this computer; returns its reply (docs/stream.md).

    Raises:
        NotGiven: no such daemon, no permission, or no reply within ``longest_s``.
    """
    path = commands_beside(stream_path(name))
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        try:
            sock.settimeout(longest_s)
            sock.connect(str(path))
            sock.sendall(request_line(request))
            reply = _line(sock, time.monotonic() + longest_s)
        except TimeoutError:
            raise NotGiven(
                f"not finished after {longest_s:g} s; the command continues, and `lumiloop status` shows the state"
            ) from None
        except PermissionError:
            raise NotGiven(
                f"{path}: only the daemon's user and group may send commands; use sudo, or --host if "
                "`modbus.write` is true"
            ) from None
        except OSError as error:
            raise NotGiven(f"{path}: {error.strerror or error}; {_others(name)}") from None
    try:
        answer = json.loads(reply)
    except ValueError:
        raise NotGiven(f"{path}: the daemon closed the connection; read its log") from None
    if not isinstance(answer, dict) or "result" not in answer:
        raise NotGiven(f"{path}: the reply is not from a lumiloop daemon")
    return answer


def _line(sock: socket.socket, end: float) -> bytes:
    """The reply until the daemon closes, or LONGEST_REPLY bytes."""
    received = b""
    while len(received) < LONGEST_REPLY:
        sock.settimeout(max(0.001, end - time.monotonic()))
        data = sock.recv(LONGEST_REPLY)
        if not data:
            break
        received += data
    return received


def _others(name: str) -> str:
    """What to do where no daemon of that name serves orders."""
    folders = dict.fromkeys((runtime_folder(), SERVICE))
    others = sorted({other for folder in folders for other in daemons_in(Path(folder))} - {name})
    if others:
        return f"no daemon has the name {name}; running daemons: {', '.join(others)} (--set name=NAME, or --config)"
    return "no daemon runs; start one with `lumiloop run`"
