"""What happens in the demo, at set times or by a key: a sensor goes off and on again, or the robot is carried away."""

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

from daemon.snapshot import State

ROBOT: Final = "robot"
KEYS: Final = {"p": "adc", "l": "lidar", "c": ROBOT}
NAMES: Final = {"adc": "photodiode", "lidar": "lidar", ROBOT: "robot"}
AHEAD_S, TAKES_S = 32.0, 2.0
"""How much further along its tour the robot is put down when it is carried away, and how long that takes, s."""
SHORTEST_S: Final = 45.0
"""A shorter demo has no time for it."""
_ANSWER_S: Final = 2.0


AWAY: Final = "the robot is lifted and moved to another position"
RIGHT_M: Final = 0.2
"""A pose that is off by less is right."""
CARRY: Final = f"carry where={ROBOT} ahead={AHEAD_S:g} takes={TAKES_S:g}"


class OrderRefused(Exception):
    """The simulator does not do what it was told; the text says why."""


@dataclass(slots=True)
class Act:
    """One sensor is off, or the robot in the air, from ``begin`` to ``end``, seconds since the robot drove off.

    Attributes:
        tracked: whether the state was TRACKING when it began; where it was not, it could not be lost either.
        seen: s after ``begin`` until the state was not TRACKING any more. back: s after ``end`` until it was again.
        right: s after ``end`` until the pose was right and stayed so. jumps: of the map pose, before and by now.
    """

    device: str
    begin: float
    end: float
    state: str = "to come"
    tracked: bool = False
    seen: float | None = None
    back: float | None = None
    right: float | None = None
    jumps: tuple[int, int] = (0, 0)

    @property
    def words(self) -> str:
        """What became of the state, for people."""
        began, ended = ("lifted", "put down") if self.device == ROBOT else ("off", "on again")
        name = f"{NAMES[self.device]} {began}"
        if self.state == "to come":
            return f"{name}: not reached"
        lost = f"TRACKING lost after {self.seen:.1f} s" if self.seen is not None else "TRACKING was not lost"
        told = f"{name}: {lost if self.tracked else 'the state was not TRACKING before'}"
        if self.state == "off":
            return f"{told}; not {ended} by the end"
        if self.device != ROBOT and self.tracked and self.seen is None:
            return told
        back = "not TRACKING since" if self.back is None else f"TRACKING after {self.back:.1f} s"
        if self.device != ROBOT:
            return f"{told}; {ended}: {back}"
        right = "the pose is not right since" if self.right is None else f"pose right after {self.right:.1f} s"
        return f"{told}; {ended}: {right}, {back}"

    @property
    def figures(self) -> dict[str, Any]:
        """For the summary."""
        if self.device == ROBOT:
            return {
                "what": NAMES[self.device], "lifted_s": round(self.begin, 2), "put_down_s": round(self.end, 2),
                "tracking_before": self.tracked, "not_tracking_after_s": self.seen, "right_again_after_s": self.right,
                "tracking_again_after_s": self.back, "jumps": list(self.jumps),
            }  # fmt: skip
        return {
            "what": NAMES[self.device], "off_from_s": round(self.begin, 2), "off_until_s": round(self.end, 2),
            "tracking_before": self.tracked, "degraded_after_s": self.seen, "tracking_again_after_s": self.back,
        }  # fmt: skip


def programme(seconds: float, kidnap: bool = False) -> list[Act]:
    """First the photodiode, then the lidar, with time to recover from each; nothing in a short or an endless demo.

    With ``kidnap`` the robot is carried away instead, once it has seen something of the room.
    """
    if seconds < SHORTEST_S:
        return []
    if kidnap:
        begin = 0.45 * seconds
        return [Act(ROBOT, begin, begin + TAKES_S)]
    return [
        Act("adc", 0.35 * seconds, 0.46 * seconds),
        Act("lidar", 0.62 * seconds, 0.73 * seconds),
    ]


@dataclass(slots=True)
class Stage:
    """Carries out acts over the simulator's control socket."""

    control: Path
    acts: list[Act] = field(default_factory=list)

    def play(self, t: float, state: int, off_m: float | None = None, jumps: int = 0) -> list[str]:
        """What has to be done ``t`` seconds after the start; returns what to tell the viewer.

        ``state``, ``off_m``, ``jumps``: as published, the error against the truth of the same instant.
        """
        told = []
        for act in self.acts:
            carried = act.device == ROBOT
            if act.state == "to come" and t >= act.begin:
                self._order(f"order {CARRY}" if carried else f"order off where={act.device}")
                act.state, act.tracked = "off", state == State.TRACKING
                told.append(AWAY if carried else f"the {NAMES[act.device]} is switched off")
            if act.state == "off" and t >= act.end:
                if not carried:
                    self._order(f"clear off {act.device}")
                act.state = "on again"
                told.append("the robot is put down" if carried else f"the {NAMES[act.device]} is switched on again")
            _note(act, t, state == State.TRACKING)
            if carried:
                told += _follow(act, t, off_m, jumps)
        return told

    def press(self, key: str, t: float) -> None:
        """A key was pressed: the sensor it stands for goes off, or comes back."""
        device = KEYS.get(key.lower())
        if device is None:
            return
        if device == ROBOT:
            if all(act.state == "on again" for act in self.acts if act.device == ROBOT):
                self.acts.append(Act(ROBOT, t, t + TAKES_S))
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
            raise OrderRefused(f"the simulator accepts no commands: {error}") from error
        if not answer.startswith("ok"):
            raise OrderRefused(f"the simulator refused `{line}`: {answer.strip()}")


def _note(act: Act, t: float, tracking: bool) -> None:
    unseen = act.tracked and act.seen is None and act.state == ("off" if act.device != ROBOT else act.state)
    if t >= act.begin and unseen and not tracking:
        act.seen = round(t - act.begin, 2)
    lost = act.seen is not None or not act.tracked
    if act.state == "on again" and act.back is None and tracking and (lost or act.device != ROBOT):
        act.back = round(t - act.end, 2)


def _follow(act: Act, t: float, off_m: float | None, jumps: int) -> list[str]:
    """Watch the pose of a robot that was carried away; returns what to tell the viewer."""
    if act.state == "to come":
        act.jumps = jumps, jumps
        return []
    act.jumps = act.jumps[0], jumps
    if act.state == "off" or off_m is None:
        return []
    if off_m > RIGHT_M:
        act.right = None
    elif act.right is None:
        act.right = round(t - act.end, 2)
        return [f"the pose is right again {act.right:.1f} s after it was put down; map jumps {jumps}"]
    return []


def complaint(acts: list[Act]) -> str:
    """What is wrong with how the programme went; empty when nothing is. An act cut short is not judged."""
    for act in acts:
        if act.state != "on again":
            continue
        stayed = act.tracked and act.seen is None
        if stayed and act.device == ROBOT:
            return "the robot was moved by hand, but the state stayed TRACKING"
        if act.back is None and act.device == ROBOT:
            return "the robot was put down again, but the state has not become TRACKING since"
        if act.right is None and act.device == ROBOT:
            return "the robot was put down again, and its pose is not right since"
        if stayed:
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
