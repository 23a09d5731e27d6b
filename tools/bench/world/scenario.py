"""What a bench computer plays, as a file: the world, the drive, faults, and what is expected of the robot computer.

::

    title = "The lidar's cable is pulled for 4 s"

    [world]                   # all keys may be left out
    building = "bench"        # or one of the simulator's
    lidar = "bench"           # or a model of hal.fake
    seed = 1
    people = false
    lamps = false             # coded lamps overhead
    odometry = true
    speed = 0.6               # m/s

    [drive]
    seconds = 40.0            # from setting off; it stands still for `dwell` s first, and before each further lap
    dwell = 2.0
    settle = 120.0            # longest wait for a place before it

    [[fault]]                 # an order to `lidar`, `adc` or `robot` as docs/fake-devices.md has it
    what = "hangup"
    where = "lidar"
    when = 15.0               # since it set off
    for = 4.0

    [[expect]]
    what = "state"            # one of KINDS
    is = ["TRACKING"]
    from = 19.0
    within = 3.0
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

from daemon.health.faults import Fault
from tools.bench.world import orders, room
from tools.clients.read_modbus import STATES
from tools.sim.building.buildings import BUILDINGS
from tools.sim.light.scene import Lights
from tools.sim.robot.drive import Body
from tools.sim.scene import Scenario as SceneScenario
from tools.sim.scene import SimulatedScene

CODES: Final = frozenset(map(int, Fault))
BUILT_IN: Final = Path(__file__).parent / "scenarios"
KINDS: Final = {
    "error": "never further from the truth than `at_most` m and `sigmas` of the published sigma, and never longer than "
    "`gap` s without a new pose (left out: 1 s)",
    "state": "one of the states `is` within `within` s after `from`",
    "never": "none of the states `is`",
    "share": "the states `is` for at least `at_least` of the time",
    "fault": "one of the faults `is` (codes) within `within` s after `from`",
    "clear": "no fault at all within `within` s after `from`",
    "age": "half of the poses that are read are no older than `at_most` s",
    "answers": "it answers for at least `at_least` of the time",
    "lamps": "the lamps received are in the building, the strongest one truly so for `at_least` of the time",
}

GAP_S: Final = 1.0
"""So long there may be no new pose where an error is judged: five periods of the slowest lidar here. Without a laser
wheels carry the pose on, with a new one every 1.5 periods; where there are no wheels either, a file has to say more."""


class ScenarioError(ValueError):
    """A scenario that cannot be played; the text begins with the file and the place in it."""


@dataclass(frozen=True, slots=True)
class WorldPart:
    """``[world]``."""

    building: str = room.BENCH
    lidar: str = room.BENCH
    seed: int = 1
    people: bool = False
    lamps: bool = False
    odometry: bool = True
    speed: float = 0.6


@dataclass(frozen=True, slots=True)
class DrivePart:
    """``[drive]``."""

    seconds: float = 40.0
    dwell: float = 2.0
    settle: float = 120.0


@dataclass(frozen=True, slots=True)
class Expectation:
    """``[[expect]]``: see :data:`KINDS`. Times in s since the robot set off; ``until`` 0: to the end; ``gap`` in s."""

    what: str
    is_: tuple[str | int, ...] = ()
    from_: float = 0.0
    until: float = 0.0
    within: float = 0.0
    at_most: float = 0.0
    at_least: float = 0.0
    sigmas: float = 0.0
    gap: float = 0.0

    def __str__(self) -> str:
        wanted = " or ".join(map(str, self.is_))
        times = f"from {self.from_:g} s" if self.from_ else "", f"until {self.until:g} s" if self.until else ""
        return " ".join(filter(None, (self.what, wanted, *times, ", ".join(self._bounds()))))

    @property
    def subject(self) -> str:
        """What it is about and when, not how good it must be: ``state-TRACKING-from-16``."""
        times = f"from-{self.from_:g}" if self.from_ else "", f"until-{self.until:g}" if self.until else ""
        return "-".join(filter(None, (self.what, *map(str, self.is_), *times)))

    @property
    def whole(self) -> str:
        """With how good it must be: ``state-TRACKING-from-16-within-s-10``."""
        return "-".join([self.subject, *(bound.replace(" ", "-") for bound in self._bounds())])

    def _bounds(self) -> list[str]:
        numbers = {"at most": self.at_most, "at least": self.at_least, "sigmas": self.sigmas}
        numbers |= {"within s": self.within, "gap s": self.gap}
        return [f"{name} {value:g}" for name, value in numbers.items() if value]


def named(expect: Sequence[Expectation]) -> list[str]:
    """Their names in a report: by what they are about, so that another one between them renames none of them.

    A bound is part of the name only where two differ in nothing else: what is measured can be compared with a run in
    which more was allowed.
    """
    subjects = [one.subject for one in expect]
    return [one.whole if subjects.count(one.subject) > 1 else one.subject for one in expect]


@dataclass(frozen=True, slots=True)
class Scenario:
    """A file, ``text``. ``faults``: tables as :func:`hal.fake.faults.orders.read_fault` takes them."""

    name: str
    title: str
    world: WorldPart = field(default_factory=WorldPart)
    drive: DrivePart = field(default_factory=DrivePart)
    faults: tuple[Mapping[str, Any], ...] = ()
    expect: tuple[Expectation, ...] = ()
    text: str = ""

    @property
    def names(self) -> list[str]:
        """How the results of what is expected are called."""
        return [f"{self.name}.{name}" for name in named(self.expect)]

    def scene(self, held: bool) -> SimulatedScene:
        """The world of it; a robot that is ``held`` waits to be released."""
        world = self.world
        made = SceneScenario(
            lidar=room.model(world.lidar), seed=world.seed, people=world.people, dwell_s=self.drive.dwell,
            body=Body(speed=world.speed), lights=Lights() if world.lamps else None,
        )  # fmt: skip
        return SimulatedScene(made, room.place(world.building), held=held)


def find(name: str) -> Path:
    """A file, or one of those that come with the bench, by name.

    Raises:
        ScenarioError: there is neither.
    """
    path = Path(name)
    if path.suffix == ".toml" or path.exists():
        return path
    there = sorted(one.stem for one in BUILT_IN.glob("*.toml"))
    if name not in there:
        raise ScenarioError(f"{name}: no such file, and no scenario of that name; there are {', '.join(there)}")
    return BUILT_IN / f"{name}.toml"


def load(path: Path) -> Scenario:
    """Read and check a file.

    Raises:
        ScenarioError: it cannot be read, or something in it is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8")
        tree = tomllib.loads(text)
    except OSError as error:
        raise ScenarioError(f"{path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: not TOML: {error}") from error
    try:
        return replace(_scenario(path.stem, tree), text=text)
    except ValueError as error:
        raise ScenarioError(f"{path}: {error}") from error


def _scenario(name: str, tree: dict[str, Any]) -> Scenario:
    unknown = sorted(set(tree) - {"title", "world", "drive", "fault", "expect"})
    if unknown:
        raise ValueError(f"{unknown[0]}: a scenario holds title, [world], [drive], [[fault]], [[expect]]")
    world = _part("world", tree.get("world", {}), WorldPart())
    drive = _part("drive", tree.get("drive", {}), DrivePart())
    if world.building not in (room.BENCH, *BUILDINGS):
        raise ValueError(f"world.building: there are {room.BENCH}, {', '.join(sorted(BUILDINGS))}")
    room.model(world.lidar)
    if not (0.05 <= world.speed <= 3.0 and 1.0 <= drive.seconds <= 86_400.0 and drive.dwell >= 0.0):
        raise ValueError("world.speed is 0.05 to 3 m/s, drive.seconds 1 to 86400, drive.dwell not negative")
    tables, wanted = tree.get("fault", []), tree.get("expect", [])
    if not all(isinstance(one, list) and all(isinstance(row, dict) for row in one) for one in (tables, wanted)):
        raise ValueError("fault, expect: expected [[fault]] and [[expect]] tables")
    if not wanted:
        raise ValueError("expect: a scenario that expects nothing cannot fail")
    expect = tuple(_expectation(f"expect[{k}]", table, world) for k, table in enumerate(wanted))
    _told_apart(expect)
    orders.check(tables, room.model(world.lidar), world.lamps)
    _in_time(drive.seconds, tables, expect)
    return Scenario(name, str(tree.get("title", name)), world, drive, tuple(tables), expect)


def _told_apart(expect: Sequence[Expectation]) -> None:
    """Refuse two that say the same: one's result would stand for the other's."""
    names = named(expect)
    for k, name in enumerate(names):
        if (first := names.index(name)) < k:
            raise ValueError(f"expect[{k}]: the same as expect[{first}] ({name}); leave one of them out")


def _in_time(seconds: float, faults: Sequence[Mapping[str, Any]], expect: Sequence[Expectation]) -> None:
    """Refuse what would never come: it could not fail either."""
    times = [(f"[[fault]] number {k}: when", table.get("when", 0.0)) for k, table in enumerate(faults, 1)]
    times += [(f"expect[{k}].from", one.from_) for k, one in enumerate(expect)]
    for path, t in times:
        if t >= seconds:
            raise ValueError(f"{path}: {t:g} s is not before the end of the drive (drive.seconds = {seconds:g})")
    for k, table in enumerate(faults, 1):
        if (until := table.get("when", 0.0) + table.get("for", 0.0)) > seconds:
            raise ValueError(
                f"[[fault]] number {k}: it lasts until {until:g} s, beyond the end of the drive (drive.seconds = "
                f"{seconds:g}); leave `for` away where it is to last until then"
            )
    for k, one in enumerate(expect):
        if one.until > seconds or one.from_ + one.within > seconds:
            raise ValueError(
                f"expect[{k}]: `until`, and `from` with `within`, end with the drive at the latest "
                f"(drive.seconds = {seconds:g})"
            )
        if one.until and one.until <= one.from_:
            raise ValueError(f"expect[{k}].until: {one.until:g} s is not after its `from`, {one.from_:g}")


def _part(path: str, table: Any, default: Any) -> Any:
    """A table of plain values as the dataclass of ``default``."""
    if not isinstance(table, dict):
        raise ValueError(f"{path}: expected a table")
    known = {one.name: getattr(default, one.name) for one in fields(default)}
    for key, value in table.items():
        if key not in known:
            raise ValueError(f"{path}.{key}: known are {', '.join(known)}")
        known[key] = _like(f"{path}.{key}", value, known[key])
    return type(default)(**known)


def _like(path: str, value: Any, default: Any) -> Any:
    if type(default) is float and type(value) is int:
        value = float(value)
    if type(value) is not type(default):
        raise ValueError(f"{path}: expected a {type(default).__name__}, got {value!r}")
    return value


def _expectation(path: str, table: dict[str, Any], world: WorldPart) -> Expectation:
    what = table.get("what")
    if what not in KINDS:
        raise ValueError(f"{path}.what: {what!r} is none of {', '.join(KINDS)}")
    values: dict[str, Any] = {"what": what}
    numbers = ("from", "until", "within", "at_most", "at_least", "sigmas", "gap")
    for key, value in table.items():
        if key in numbers:
            values[f"{key}_" if key == "from" else key] = _like(f"{path}.{key}", value, 0.0)
        elif key == "is":
            values["is_"] = tuple(value if isinstance(value, list) else [value])
        elif key != "what":
            raise ValueError(f"{path}.{key}: known are what, is, {', '.join(numbers)}")
    made = Expectation(**values)
    needed = {"error": made.at_most, "age": made.at_most, "share": made.at_least, "answers": made.at_least}
    needed |= {"state": made.within, "fault": made.within, "clear": made.within, "lamps": made.at_least}
    for key in numbers:
        if (value := values.get(f"{key}_" if key == "from" else key, 0.0)) < 0.0:
            raise ValueError(f"{path}.{key}: {value:g} is negative")
    if needed.get(what, 1.0) <= 0.0:
        raise ValueError(f"{path}: {KINDS[what]}; the number is missing, or 0")
    kind = int if what == "fault" else str
    if what in ("state", "never", "share", "fault") and not made.is_:
        raise ValueError(f"{path}.is: {KINDS[what]}")
    if not all(type(one) is kind and (kind is int or one in STATES) for one in made.is_):
        raise ValueError(f"{path}.is: states are {', '.join(STATES)}; faults are numbers")
    strange = [one for one in made.is_ if what == "fault" and one not in CODES]
    if strange:
        raise ValueError(f"{path}.is: there is no fault {strange[0]}; there are {', '.join(map(str, sorted(CODES)))}")
    if what == "lamps" and not world.lamps:
        raise ValueError(f"{path}: lamps are expected, but [world] has lamps = false")
    return made
