"""What happens to the sensors in the demo: at set times, or by a key, one of them is switched off and on again."""

from __future__ import annotations

import contextlib
import select
import socket
import sys
import termios
import tty
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from daemon.publish.snapshot import State

KEYS: Final = {"p": "adc", "l": "lidar"}
NAMES: Final = {"adc": "photodiode", "lidar": "lidar"}
SHORTEST_S: Final = 45.0
"""A shorter demo has no time for it."""
_ANSWER_S: Final = 2.0


class OrderRefused(Exception):
    """The simulator does not do what it was told; the text says why."""


@dataclass(slots=True)
class Act:
    """One sensor is off from ``begin`` to ``end``, seconds since the robot drove off.

    Attributes:
        seen: s after ``begin`` until the state was not TRACKING any more. back: s after ``end`` until it was again.
    """

    device: str
    begin: float
    end: float
    state: str = "to come"
    seen: float | None = None
    back: float | None = None

    @property
    def figures(self) -> dict[str, Any]:
        """For the summary."""
        return {
            "sensor": NAMES[self.device], "off_from_s": round(self.begin, 2), "off_until_s": round(self.end, 2),
            "degraded_after_s": self.seen, "tracking_again_after_s": self.back,
        }  # fmt: skip


def programme(seconds: float) -> list[Act]:
    """First the photodiode, then the lidar, with time to recover from each; nothing in a short or an endless demo."""
    if seconds < SHORTEST_S:
        return []
    return [
        Act("adc", 0.35 * seconds, 0.46 * seconds),
        Act("lidar", 0.62 * seconds, 0.73 * seconds),
    ]


@dataclass(slots=True)
class Stage:
    """Carries out acts over the simulator's control socket."""

    control: Path
    acts: list[Act] = field(default_factory=list)

    def play(self, t: float, state: int) -> list[str]:
        """What has to be done ``t`` seconds after the start; returns what to tell the viewer."""
        told = []
        for act in self.acts:
            if act.state == "to come" and t >= act.begin:
                self._order(f"order off where={act.device}")
                act.state = "off"
                told.append(f"the {NAMES[act.device]} is switched off")
            if act.state == "off" and t >= act.end:
                self._order(f"clear off {act.device}")
                act.state = "on again"
                told.append(f"the {NAMES[act.device]} is switched on again")
            _note(act, t, state == State.TRACKING)
        return told

    def press(self, key: str, t: float) -> None:
        """A key was pressed: the sensor it stands for goes off, or comes back."""
        device = KEYS.get(key.lower())
        if device is None:
            return
        running = [act for act in self.acts if act.device == device and act.state == "off"]
        if running:
            running[-1].end = t
        else:
            self.acts.append(Act(device, t, float("inf")))

    def _order(self, line: str) -> None:
        try:
            with socket.socket(socket.AF_UNIX) as sock:
                sock.settimeout(_ANSWER_S)
                sock.connect(str(self.control))
                sock.sendall(f"{line}\n".encode())
                answer = ""
                with sock.makefile() as lines:
                    while not answer.startswith(("ok", "refused")) and (read := lines.readline()):
                        answer = read
        except OSError as error:
            raise OrderRefused(f"the simulator does not take orders: {error}") from error
        if not answer.startswith("ok"):
            raise OrderRefused(f"the simulator refused `{line}`: {answer.strip()}")


def _note(act: Act, t: float, tracking: bool) -> None:
    if act.state == "off" and act.seen is None and not tracking:
        act.seen = round(t - act.begin, 2)
    if act.state == "on again" and act.back is None and tracking:
        act.back = round(t - act.end, 2)


def complaint(acts: list[Act]) -> str:
    """What is wrong with how the programme went; empty when nothing is. An act cut short is not judged."""
    for act in acts:
        if act.state != "on again":
            continue
        if act.seen is None:
            return f"the {NAMES[act.device]} was off for {act.end - act.begin:.0f} s and the state stayed TRACKING"
        if act.back is None:
            return f"{NAMES[act.device]} on again, but the state has not become TRACKING since"
    return ""


@contextlib.contextmanager
def keyboard() -> Iterator[None]:
    """Keys are read one by one while this lasts; nothing changes where the input is no terminal."""
    if not sys.stdin.isatty():
        yield
        return
    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def pressed() -> str:
    """The key that was pressed since, empty if none or if there is no terminal."""
    if not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0.0)[0]:
        return ""
    return sys.stdin.read(1)
