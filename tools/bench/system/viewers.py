"""What twenty browsers that watch `lumiloop view` change about how late cycles begin.

The daemon of `tools.bench.system.latency`, fed 40 times a second, with SCHED_FIFO where it may be had. Stretches of ten
seconds come in pairs: *alone*, nobody listens to the stream; *loaded*, the page's server does, and hands on to twenty
clients that take every message. Server and clients are processes of their own, on the same cores, and are there all
the time. What else runs on the computer changes slowly, so the two of a pair follow each other, and every other pair is
the other way round (A B B A): what grows evenly cancels. The first second after a change, in which browsers come or go,
counts for neither.

``python -m tools.bench.system.viewers --turns 30`` takes eleven minutes: the spread of the pairs says what the
difference is worth.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from daemon.devices.light_setup import Lights
from daemon.runtime.warmup import load
from estimator.cdma.air_interface import PROFILE_A
from tools.bench.support.children import CannotRun, child, ended, lines, two_counts
from tools.bench.support.drive import EndlessDrive
from tools.bench.support.paced import SETTLE_S
from tools.bench.system.latency import DAEMON, long_form, prepared
from tools.ci.figures import Figure, bounded

COMMAND: Final = "python -m tools.bench viewers"
STRETCH_S: Final = 10.0
TURNS: Final = 6
LEAST_HZ: Final = 15.0
"""Messages a second to each browser; with fewer, nothing was watched that would cost anything (a page has 25)."""
CHANGE_S: Final = 1.0
BROWSERS: Final = 20


def free_port() -> int:
    """A port that is free on loopback just now."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Others(Protocol):
    """What is there in every other stretch."""

    def turn(self, on: bool) -> None:
        """On or off."""

    def end(self) -> tuple[int, int]:
        """Messages and bytes that they were told."""

    def kill(self) -> None:
        """Whatever has become of them."""


class Page:
    """The page's server and the browsers, on and off."""

    def __init__(self, stream: str) -> None:
        port = str(free_port())
        words = (["serve", stream, port], ["watch", port, str(BROWSERS)])
        module = [sys.executable, "-m", "tools.bench.support.viewers"]
        with ExitStack() as undo:
            self._both = [undo.enter_context(child(*module, *w, hear=True)) for w in words]
            for one in self._both:
                if next(lines(one, "the page's server, or a browser"), "") != "ready":
                    raise CannotRun("the page's server, or the browsers, ended before their time; they say why above")
            self._undo = undo.pop_all()

    def turn(self, on: bool) -> None:
        """On or off."""
        for one in self._both:
            one.send_signal(signal.SIGUSR1 if on else signal.SIGUSR2)

    def end(self) -> tuple[int, int]:
        """Messages and bytes that the browsers were told."""
        server, browsers = self._both
        told = two_counts(browsers, "the browsers")
        server.terminate()
        ended(server, "the page's server")
        return told

    def kill(self) -> None:
        """Whatever has become of them."""
        self._undo.close()


def paced(folder: Path, turns: int, make: Callable[[str], Others] = Page) -> dict[str, Any]:
    """One run of the daemon: what it told, with the counts of what was ``make``-d of its stream's path."""
    drive, stream = prepared(folder, SETTLE_S + 2 * turns * STRETCH_S), str(folder / "stream")
    wanted = {
        "drive": str(drive), "stream": stream, "modbus": free_port(), "fifo": os.geteuid() == 0, "turns": turns,
        "receiver": "127.0.0.1:9", "stretch_s": STRETCH_S, "solve": False,
        "change_s": CHANGE_S,
    }  # fmt: skip
    with ExitStack() as undo:
        page = make(stream)
        undo.callback(page.kill)
        daemon = undo.enter_context(child(*DAEMON, json.dumps(wanted), hear=True))
        on = False
        for line in lines(daemon, "the daemon"):
            if line.startswith("told "):
                messages, size = page.end()
                if ended(daemon, "the daemon"):
                    break
                told: dict[str, Any] = json.loads(line[5:])
                return told | {"messages": messages, "size": size}
            if (wanted_on := line.strip() == "loaded") != on:
                on = wanted_on
                page.turn(on)
    raise CannotRun("the daemon ended before its time; its log says why")


def compared(told: dict[str, Any], other: str, command: str) -> list[Figure]:
    """What is later, and what takes longer, in the stretches that are ``other``."""
    rows = []
    for what in ("late", "cycle"):
        alone, loaded = (1e-3 * np.array(told[what][stretch]) for stretch in ("alone", "loaded"))
        words = {"late": "cycles begin late", "cycle": "a cycle takes"}[what]
        for q in (50.0, 99.0):
            rows.append(Figure(f"{words}, p{q:g}, alone", float(np.percentile(alone, q)), "ms", command=command))
            rows.append(Figure(f"{words}, p{q:g}, {other}", float(np.percentile(loaded, q)), "ms", command=command))
        more = float(np.percentile(loaded, 99) - np.percentile(alone, 99))
        rows.append(bounded(f"{words}, p99, {other} over alone", more, "ms", "<= 0.5", command))
        pairs = by_pair(told, what)
        name = f"{words}, p99, {other} over alone, of {len(pairs)} pairs"
        rows.append(bounded(f"{name}, median", float(np.median(pairs)), "ms", "<= 0.5", command))
        for q, end in ((25.0, "lower quarter"), (75.0, "upper quarter")):
            rows.append(Figure(f"{name}, {end}", float(np.percentile(pairs, q)), "ms", command=command))
    counted = float(sum(len(stretch) for stretch in told["late"].values()))
    rows.append(Figure(f"cycles, alone and {other}", counted, "", command=command))
    rows.append(Figure("scans missed", float(told["missed"]), "", command=command))
    return rows


def figures(told: dict[str, Any], turns: int) -> list[Figure]:
    """All rows."""
    rows = compared(told, "watched", COMMAND)
    watched_s = turns * STRETCH_S * BROWSERS
    rows.append(Figure("kB a second to each browser", 1e-3 * told["size"] / watched_s, "", command=COMMAND))
    each = told["messages"] / watched_s
    return [*rows, bounded("messages a second to each browser", each, "", f">= {LEAST_HZ:g}", COMMAND)]


def by_pair(told: dict[str, Any], what: str) -> list[float]:
    """What p99 is higher by, watched, in each pair of stretches, ms."""
    found = []
    for number in sorted(set(told["pair"]["alone"]) & set(told["pair"]["loaded"])):
        alone, loaded = (
            np.percentile(1e-3 * np.array(told[what][stretch])[np.array(told["pair"][stretch]) == number], 99)
            for stretch in ("alone", "loaded")
        )
        found.append(float(loaded - alone))
    return found


def run(turns: int = TURNS) -> list[Figure]:
    """Some 130 s."""
    load(Lights(EndlessDrive().survey, PROFILE_A))
    with tempfile.TemporaryDirectory() as name:
        return figures(paced(Path(name), turns), turns)


if __name__ == "__main__":
    long_form("viewers", "python -m tools.bench.system.viewers", "watched", run)
