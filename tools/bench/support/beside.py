"""Clients of a daemon that are there in every other stretch of a benchmark: readers, browsers, taps that hang.

python -m tools.bench.support.beside STREAM     connections that want every topic and read nothing, until killed
"""

import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final, Protocol

from daemon.publish.stream.server import TOPICS, framed
from tools.bench.support.children import CannotRun, child, ended, lines, two_counts
from tools.sim.ports import free_port

READERS: Final = (sys.executable, "-m", "tools.bench.support.readers")
VIEWERS: Final = (sys.executable, "-m", "tools.bench.support.viewers")
HANGING: Final = (sys.executable, "-m", "tools.bench.support.beside")
TELLING: Final = ("pose", "lights", "scan", "state", "loop")
BROWSERS: Final = 20
TAPS: Final = 8
CONNECT_S: Final = 10.0


class Beside(Protocol):
    """Clients that come and go."""

    def turn(self, on: bool) -> None:
        """On or off."""

    def end(self) -> tuple[int, int]:
        """End them; two counts of what they did."""

    def kill(self) -> None:
        """Whatever has become of them."""


class Readers:
    """Modbus readers, and a client of the stream that never reads."""

    def __init__(self, stream: str, modbus: int) -> None:
        self._stream = stream
        self._stuck: socket.socket | None = None
        self._undo = ExitStack()
        self._readers = self._undo.enter_context(child(*READERS, str(modbus), hear=True))
        self._readers.send_signal(signal.SIGSTOP)

    def turn(self, on: bool) -> None:
        """On or off."""
        self._readers.send_signal(signal.SIGCONT if on else signal.SIGSTOP)
        self._release()
        if on:
            self._stuck = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._stuck.settimeout(CONNECT_S)
            try:
                self._stuck.connect(self._stream)
                self._stuck.sendall(framed({"want": list(TELLING)}))
            except OSError as error:
                raise CannotRun(f"the daemon's stream takes no client: {error}") from error

    def end(self) -> tuple[int, int]:
        """Requests asked and answered."""
        self._release()
        self._readers.send_signal(signal.SIGCONT)
        return two_counts(self._readers, "the readers")

    def kill(self) -> None:
        """Whatever has become of them."""
        self._release()
        self._undo.close()

    def _release(self) -> None:
        if self._stuck is not None:
            self._stuck.close()
            self._stuck = None


class Browsers:
    """The page's server and browsers."""

    def __init__(self, stream: str, modbus: int) -> None:
        port = str(free_port())
        words = (["serve", stream, port], ["watch", port, str(BROWSERS)])
        with ExitStack() as undo:
            self._both = [undo.enter_context(child(*VIEWERS, *w, hear=True)) for w in words]
            for one in self._both:
                if next(lines(one, "the page's server, or a browser"), "") != "ready":
                    raise CannotRun("the page's server, or the browsers, ended before their time; they say why above")
            self._undo = undo.pop_all()

    def turn(self, on: bool) -> None:
        """On or off."""
        for one in self._both:
            one.send_signal(signal.SIGUSR1 if on else signal.SIGUSR2)

    def end(self) -> tuple[int, int]:
        """Messages and bytes that the browsers received."""
        server, browsers = self._both
        counts = two_counts(browsers, "the browsers")
        server.terminate()
        ended(server, "the page's server")
        return counts

    def kill(self) -> None:
        """Whatever has become of them."""
        self._undo.close()


class Hanging:
    """Taps that ask for all and read nothing."""

    def __init__(self, stream: str, modbus: int) -> None:
        self._stream, self._undo = stream, ExitStack()

    def turn(self, on: bool) -> None:
        """On, or killed as a crash would."""
        self.kill()
        if on:
            self._undo.enter_context(child(*HANGING, self._stream))

    def end(self) -> tuple[int, int]:
        """They have read nothing."""
        self.kill()
        return 0, 0

    def kill(self) -> None:
        """Whatever has become of them."""
        self._undo.close()


KINDS: Final[dict[str, Callable[[str, int], Beside]]] = {"readers": Readers, "browsers": Browsers, "hanging": Hanging}


def hang(stream: str) -> None:
    """Want everything and read nothing, until killed."""
    taps = [socket.socket(socket.AF_UNIX) for _ in range(TAPS)]
    for tap in taps:
        tap.connect(stream)
        tap.sendall(framed({"want": list(TOPICS)}))
    while True:
        time.sleep(1.0)


if __name__ == "__main__":
    hang(sys.argv[1])
