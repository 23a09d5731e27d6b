"""Who is in the fleet and how: what robots have told, in order. Pure: messages in, rows out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from taps.fleet import messages
from taps.fleet.messages import Cells, LoopTold, MapHead, PoseTold, StateTold, Unreadable, printable
from taps.tiles import UNSEEN

FARTHEST: Final = 1e6
"""No number that is shown is larger, in m or rad."""


def number(told: object) -> float | None:
    """A finite number; None where it is none."""
    if isinstance(told, bool) or not isinstance(told, (int, float)) or not abs(told) < FARTHEST:
        return None
    return float(told)


@dataclass(slots=True)
class Member:
    """One robot.

    Attributes:
        speakers, waiting: instances that speak for it, or wait for the name (`messages.instance_of`).
        t_heard: when it told its pose or state last, by our own clock. loops: so far, as far as heard.
        problem: the latest message of it that could not be read.
    """

    name: str
    speakers: set[str] = field(default_factory=set)
    waiting: set[str] = field(default_factory=set)
    pose: PoseTold | None = None
    state: StateTold | None = None
    loop: LoopTold | None = None
    map: tuple[MapHead, Cells] | None = None
    t_heard: float = -math.inf
    problem: str = ""

    @property
    def place(self) -> tuple[float, float, float] | None:
        """Where it is: x, y (m), theta (rad); where it was last, if it is lost."""
        at = self.pose.agvPosition if self.pose is not None else None
        if at is None:
            return None
        x, y, theta = (number(at.get(name)) for name in ("x", "y", "theta"))
        return None if x is None or y is None or theta is None else (x, y, theta)

    @property
    def map_id(self) -> str:
        """The map in which its place is meant."""
        at = self.pose.agvPosition if self.pose is not None else None
        return "" if at is None else str(at.get("mapId", ""))

    @property
    def localised(self) -> bool:
        """Whether it knows its place, and tells it."""
        at = self.pose.agvPosition if self.pose is not None else None
        up = self.state is None or self.state.up
        return bool(self.speakers) and up and at is not None and at.get("positionInitialized") is True


class Roster:
    """All robots that have been heard of."""

    def __init__(self) -> None:
        self.members: dict[str, Member] = {}

    def take(self, key: str, content: bytes, attachment: bytes, now: float) -> None:
        """A message; one that cannot be read is kept as a problem of its robot."""
        words = key.split("/")
        if len(words) != 3 or words[0] != messages.ROOT or words[2] not in messages.TOPICS:
            return
        member = self._member(words[1])
        try:
            match words[2]:
                case "pose":
                    member.pose, member.t_heard = messages.read(content, PoseTold), now
                case "state":
                    member.state, member.t_heard = messages.read(content, StateTold), now
                case "loops":
                    member.loop = messages.read(content, LoopTold)
                case "map":
                    member.map = messages.read_map(content, attachment)
            member.problem = ""
        except Unreadable as error:
            member.problem = f"{words[2]}: {error}"

    def token(self, key: str, there: bool) -> str:
        """A liveliness token comes or goes; the robot's name where somebody begins to speak for it, else empty."""
        words = key.split("/")
        if len(words) != 4 or words[0] != messages.ROOT or words[2] not in ("alive", "waiting"):
            return ""
        member = self._member(words[1])
        instances = member.speakers if words[2] == "alive" else member.waiting
        (instances.add if there else instances.discard)(words[3])
        return member.name if there and words[2] == "alive" else ""

    def without_router(self) -> None:
        """Nobody can be seen any more."""
        for member in self.members.values():
            member.speakers.clear()
            member.waiting.clear()

    def sorted(self) -> list[Member]:
        """By name."""
        return [self.members[name] for name in sorted(self.members)]

    def problems(self) -> list[str]:
        """What a person should know, a line each."""
        found = []
        for member in self.sorted():
            hosts = [messages.host_of(one) for one in sorted(member.speakers | member.waiting)]
            if len(hosts) > 1:
                found.append(
                    f"{member.name}: {len(hosts)} robots have this name, on {', '.join(hosts)}; the first one is "
                    "shown: give each a `name` of its own"
                )
            if member.problem:
                found.append(f"{member.name}: {member.problem}")
        for kind in ("survey", "map"):
            versions = {
                one.name: one.state.held[kind].version
                for one in self.sorted()
                if one.state is not None and kind in one.state.held
            }
            newest = max(versions.values(), default=0)
            if behind := [name for name, version in versions.items() if version < newest]:
                found.append(f"{', '.join(behind)}: not the newest {kind}, {newest}: `lumiloop fleet fetch` there")
        return [printable(line) for line in found]

    def chart(self) -> tuple[MapHead, Cells] | None:
        """The map that most robots are in, as the robot tells it that has seen most of it."""
        count: dict[str, int] = {}
        for member in self.members.values():
            count[member.map_id] = count.get(member.map_id, 0) + 1
        best: tuple[tuple[int, int], tuple[MapHead, Cells]] | None = None
        for member in self.sorted():
            if member.map is not None:
                head, cells = member.map
                rank = count.get(f"{head.map_id:08x}", 0), int((cells != UNSEEN).sum())
                if best is None or rank > best[0]:
                    best = rank, member.map
        return None if best is None else best[1]

    def _member(self, name: str) -> Member:
        return self.members.setdefault(name, Member(name))
