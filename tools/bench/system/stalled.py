"""What taps that hang, and then crash, change about how late cycles begin.

As `tools.bench.system.viewers`: stretches of ten seconds in pairs, *alone* and *stalled*. In the latter a process of
its own has eight connections to the stream, wants every topic there is, and takes nothing; at the end of the stretch it
is killed.
"""

from __future__ import annotations

import socket
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from daemon.devices.light_setup import Lights
from daemon.publish.stream.server import TOPICS, framed
from daemon.runtime.warmup import load
from estimator.cdma.air_interface import PROFILE_A
from tools.bench.support.children import child
from tools.bench.support.drive import EndlessDrive
from tools.bench.system.latency import long_form
from tools.bench.system.viewers import compared, paced
from tools.ci.figures import Figure

COMMAND: Final = "python -m tools.bench stalled"
TURNS: Final = 6
TAPS: Final = 8


class Taps:
    """They ask, and take nothing."""

    def __init__(self, stream: str) -> None:
        self._command = sys.executable, "-m", "tools.bench.system.stalled", "--hang", stream
        self._undo = ExitStack()

    def turn(self, on: bool) -> None:
        """On, or killed."""
        self.kill()
        if on:
            self._undo.enter_context(child(*self._command))

    def end(self) -> tuple[int, int]:
        """They were told nothing that they have taken."""
        self.kill()
        return 0, 0

    def kill(self) -> None:
        """As a crash would."""
        self._undo.close()


def hang(stream: str) -> None:
    """Want everything and take nothing, until killed."""
    taps = [socket.socket(socket.AF_UNIX) for _ in range(TAPS)]
    for tap in taps:
        tap.connect(stream)
        tap.sendall(framed({"want": list(TOPICS)}))
    while True:
        time.sleep(1.0)


def figures(told: dict[str, Any]) -> list[Figure]:
    """All rows."""
    return compared(told, "stalled", COMMAND)


def run(turns: int = TURNS) -> list[Figure]:
    """Some 130 s."""
    load(Lights(EndlessDrive().survey, PROFILE_A))
    with tempfile.TemporaryDirectory() as name:
        return figures(paced(Path(name), turns, Taps))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--hang"]:
        hang(sys.argv[2])
    long_form("stalled", "python -m tools.bench.system.stalled", "stalled", run)
