"""The robots of a fleet and their latest messages. Pure: messages in, members out.

Any client of the router can invent names, maps and texts: the memory for each is bounded, and present members are never
displaced.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from taps.fleet import messages
from taps.fleet.messages import Cells, LoopMessage, MapHead, PoseMessage, StateMessage, Unreadable, printable
from taps.stream.tiles import UNSEEN

FARTHEST: Final = 1e6
"""Largest displayed number, m or rad."""
GONE_S: Final = 3600.0
"""A robot that is absent and silent for this long is removed."""
MOST_ROBOTS: Final = 256
MOST_INSTANCES: Final = 16
"""Most publishers, and waiting claimants, per name; there should be one."""
MOST_MAPS: Final = 128 << 20
"""Most bytes of all robots' maps together, deflated."""


Chart = tuple[MapHead, Cells]
"""A map, and its cells (rows, columns) from below."""


def number(value: object) -> float | None:
    """The value as a finite number in range; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < FARTHEST:
        return None
    return float(value)


@dataclass(frozen=True, slots=True)
class MapKept:
    """A valid map as received; ``seen``: number of known cells."""

    head: MapHead
    content: bytes
    attachment: bytes
    seen: int


@dataclass(slots=True)
class Member:
    """One robot.

    Attributes:
        publishers, waiting: claimants that publish, or wait for the name (`messages.instance_of`).
        t_message: arrival of its last pose or state, on this computer's clock. t_present: when its presence was last
            checked and found. loop: the latest.
        problem: of its latest invalid message.
    """

    name: str
    publishers: set[str] = field(default_factory=set)
    waiting: set[str] = field(default_factory=set)
    pose: PoseMessage | None = None
    state: StateMessage | None = None
    loop: LoopMessage | None = None
    map: MapKept | None = None
    t_message: float = -math.inf
    t_present: float = -math.inf
    problem: str = ""

    @property
    def present(self) -> bool:
        """Whether any claimant of its name is present."""
        return bool(self.publishers or self.waiting)

    @property
    def t_last(self) -> float:
        """Time of the last sign of it."""
        return max(self.t_message, self.t_present)

    @property
    def place(self) -> tuple[float, float, float] | None:
        """Its pose x, y (m), theta (rad); the last one if it is lost."""
        at = self.pose.agvPosition if self.pose is not None else None
        if at is None:
            return None
        x, y, theta = (number(at.get(name)) for name in ("x", "y", "theta"))
        return None if x is None or y is None or theta is None else (x, y, theta)

    @property
    def map_id(self) -> str:
        """The map of its pose."""
        at = self.pose.agvPosition if self.pose is not None else None
        return "" if at is None else str(at.get("mapId", ""))

    @property
    def localised(self) -> bool:
        """Whether it publishes a valid pose."""
        at = self.pose.agvPosition if self.pose is not None else None
        up = self.state is None or self.state.up
        return bool(self.publishers) and up and at is not None and at.get("positionInitialized") is True


class Roster:
    """All robots seen recently."""

    def __init__(self) -> None:
        self.members: dict[str, Member] = {}
        self._full = False
        self._drawn: tuple[MapKept, Chart] | None = None

    def receive(self, key: str, content: bytes, attachment: bytes, now: float) -> None:
        """Store a message; an invalid one is stored as a problem of its robot."""
        words = key.split("/")
        if len(words) != 3 or words[0] != messages.ROOT or words[2] not in messages.TOPICS:
            return
        if (member := self._member(words[1])) is None:
            return
        try:
            match words[2]:
                case "pose":
                    member.pose, member.t_message = messages.read(content, PoseMessage), now
                case "state":
                    member.state, member.t_message = messages.read(content, StateMessage), now
                case "loops":
                    member.loop = messages.read(content, LoopMessage)
                case "map":
                    self._keep_map(member, content, attachment)
            member.problem = ""
        except Unreadable as error:
            member.problem = f"{words[2]}: {error}"

    def token(self, key: str, present: bool) -> str:
        """Process a liveliness token that appears or vanishes; returns the robot of a new publisher, else ""."""
        words = key.split("/")
        if len(words) != 4 or words[0] != messages.ROOT or words[2] not in ("alive", "waiting"):
            return ""
        member = self._member(words[1]) if present else self.members.get(words[1])
        if member is None:
            return ""
        instances = member.publishers if words[2] == "alive" else member.waiting
        if not present:
            instances.discard(words[3])
        elif len(instances) < MOST_INSTANCES:
            instances.add(words[3])
        return member.name if present and words[2] == "alive" else ""

    def drop_absent(self, now: float, router: bool) -> None:
        """Remove long absent robots; without a router none counts as absent.

        Call it after each display: the note about a full roster appears once.
        """
        for member in list(self.members.values()):
            if member.present or not router:
                member.t_present = now
            elif now - member.t_last > GONE_S:
                del self.members[member.name]
        self._full = False

    def without_router(self) -> None:
        """The router is lost: no presence is known."""
        for member in self.members.values():
            member.publishers.clear()
            member.waiting.clear()

    def sorted(self) -> list[Member]:
        """Members in order of their names."""
        return [self.members[name] for name in sorted(self.members)]

    def problems(self) -> list[str]:
        """Problems for the user, one line each."""
        found = []
        for member in self.sorted():
            hosts = [messages.host_of(one) for one in sorted(member.publishers | member.waiting)]
            if len(hosts) > 1:
                found.append(
                    f"{member.name}: {len(hosts)} robots have this name, on {', '.join(hosts)}; only the "
                    "first one is shown, so give each its own `name`"
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
                found.append(
                    f"{', '.join(behind)}: the newest {kind}, {newest}, is missing; run `lumiloop fleet fetch` there"
                )
        if self._full:
            found.append(f"more than {MOST_ROBOTS} robots are in the fleet; later ones are not shown")
        return [printable(line) for line in found]

    def chart(self) -> Chart | None:
        """The map with most robots, from the robot with most of it."""
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
        """Replace a member's map.

        Raises:
            Unreadable: invalid, or too large.
        """
        others = sum(len(one.map.content) for one in self.members.values() if one.map is not None and one is not member)
        if others + len(content) > MOST_MAPS:
            raise Unreadable(f"its map has {len(content)} bytes; the limit of all maps together is {MOST_MAPS}")
        head, cells = messages.read_map(content, attachment)
        member.map = MapKept(head, content, attachment, int((cells != UNSEEN).sum()))

    def _member(self, name: str) -> Member | None:
        """The robot of that name, added if necessary; in a full roster it replaces the longest absent one."""
        if (member := self.members.get(name)) is not None or len(name) > messages.LONGEST_NAME:
            return member
        if len(self.members) >= MOST_ROBOTS:
            gone = min(
                (one for one in self.members.values() if not one.present), key=lambda one: one.t_last, default=None
            )
            if gone is None:
                self._full = True
                return None
            del self.members[gone.name]
        self.members[name] = member = Member(name)
        return member
