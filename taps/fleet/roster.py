"""Who is in the fleet and how: what robots have told, in order. Pure: messages in, rows out.

Whoever reaches the router may make up names, maps and words: of each there is room for so much, and who is there keeps
the place that it has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from taps.fleet import messages
from taps.fleet.messages import Cells, LoopTold, MapHead, PoseTold, StateTold, Unreadable, printable
from taps.stream.tiles import UNSEEN

FARTHEST: Final = 1e6
"""No number that is shown is larger, in m or rad."""
GONE_S: Final = 3600.0
"""Who has not been there, nor been heard, for so long leaves."""
MOST_ROBOTS: Final = 256
MOST_INSTANCES: Final = 16
"""So many speak for one name, and wait for it; there should be one."""
MOST_MAPS: Final = 128 << 20
"""Bytes of all robots' maps together, as they were told: deflated."""


Chart = tuple[MapHead, Cells]
"""A map, and its cells (rows, columns) from below."""


def number(told: object) -> float | None:
    """A finite number; None where it is none."""
    if isinstance(told, bool) or not isinstance(told, (int, float)) or not abs(told) < FARTHEST:
        return None
    return float(told)


@dataclass(frozen=True, slots=True)
class MapKept:
    """A map as it was told, which can be read; ``seen``: cells of it that are known."""

    head: MapHead
    content: bytes
    attachment: bytes
    seen: int


@dataclass(slots=True)
class Member:
    """One robot.

    Attributes:
        speakers, waiting: instances that speak for it, or wait for the name (`messages.instance_of`).
        t_heard: when it told its pose or state last, by our own clock. t_there: when it was there last, as far as that
            has been looked at. loops: so far, as far as heard.
        problem: the latest message of it that could not be read.
    """

    name: str
    speakers: set[str] = field(default_factory=set)
    waiting: set[str] = field(default_factory=set)
    pose: PoseTold | None = None
    state: StateTold | None = None
    loop: LoopTold | None = None
    map: MapKept | None = None
    t_heard: float = -math.inf
    t_there: float = -math.inf
    problem: str = ""

    @property
    def there(self) -> bool:
        """Whether anybody speaks for it, or would."""
        return bool(self.speakers or self.waiting)

    @property
    def t_last(self) -> float:
        """When there was a sign of it last."""
        return max(self.t_heard, self.t_there)

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
    """All robots that have been heard of, but for those that have been gone for long."""

    def __init__(self) -> None:
        self.members: dict[str, Member] = {}
        self._full = False
        self._drawn: tuple[MapKept, Chart] | None = None

    def take(self, key: str, content: bytes, attachment: bytes, now: float) -> None:
        """A message; one that cannot be read is kept as a problem of its robot."""
        words = key.split("/")
        if len(words) != 3 or words[0] != messages.ROOT or words[2] not in messages.TOPICS:
            return
        if (member := self._member(words[1])) is None:
            return
        try:
            match words[2]:
                case "pose":
                    member.pose, member.t_heard = messages.read(content, PoseTold), now
                case "state":
                    member.state, member.t_heard = messages.read(content, StateTold), now
                case "loops":
                    member.loop = messages.read(content, LoopTold)
                case "map":
                    self._keep_map(member, content, attachment)
            member.problem = ""
        except Unreadable as error:
            member.problem = f"{words[2]}: {error}"

    def token(self, key: str, there: bool) -> str:
        """A liveliness token comes or goes; the robot's name where somebody begins to speak for it, else empty."""
        words = key.split("/")
        if len(words) != 4 or words[0] != messages.ROOT or words[2] not in ("alive", "waiting"):
            return ""
        member = self._member(words[1]) if there else self.members.get(words[1])
        if member is None:
            return ""
        instances = member.speakers if words[2] == "alive" else member.waiting
        if not there:
            instances.discard(words[3])
        elif len(instances) < MOST_INSTANCES:
            instances.add(words[3])
        return member.name if there and words[2] == "alive" else ""

    def forget(self, now: float, router: bool) -> None:
        """Who has been gone for long leaves; without a router nobody is known to have gone.

        To be called now and then, after what is known was shown: that there was no room is told once.
        """
        for member in list(self.members.values()):
            if member.there or not router:
                member.t_there = now
            elif now - member.t_last > GONE_S:
                del self.members[member.name]
        self._full = False

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
        if self._full:
            found.append(f"more than {MOST_ROBOTS} robots are there: those that came later are not shown")
        return [printable(line) for line in found]

    def chart(self) -> Chart | None:
        """The map that most robots are in, as the robot tells it that has seen most of it."""
        count: dict[str, int] = {}
        for member in self.members.values():
            count[member.map_id] = count.get(member.map_id, 0) + 1
        maps = [member.map for member in self.sorted() if member.map is not None]
        best = max(maps, key=lambda kept: (count.get(f"{kept.head.map_id:08x}", 0), kept.seen), default=None)
        if best is None:
            self._drawn = None
        elif self._drawn is None or self._drawn[0] is not best:
            self._drawn = best, messages.read_map(best.content, best.attachment)
        return None if self._drawn is None else self._drawn[1]

    def _keep_map(self, member: Member, content: bytes, attachment: bytes) -> None:
        """In the place of its older one.

        Raises:
            Unreadable: it is none, or there is no room for it.
        """
        others = sum(len(one.map.content) for one in self.members.values() if one.map is not None and one is not member)
        if others + len(content) > MOST_MAPS:
            raise Unreadable(f"no room for its {len(content)} bytes: all robots' maps together have {MOST_MAPS}")
        head, cells = messages.read_map(content, attachment)
        member.map = MapKept(head, content, attachment, int((cells != UNSEEN).sum()))

    def _member(self, name: str) -> Member | None:
        """The robot of that name, a new one if need be: in the place of who has been gone longest, if all are taken."""
        if (member := self.members.get(name)) is not None or len(name) > messages.LONGEST_NAME:
            return member
        if len(self.members) >= MOST_ROBOTS:
            gone = min(
                (one for one in self.members.values() if not one.there), key=lambda one: one.t_last, default=None
            )
            if gone is None:
                self._full = True
                return None
            del self.members[gone.name]
        self.members[name] = member = Member(name)
        return member
