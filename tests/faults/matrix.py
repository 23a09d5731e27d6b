"""The fault matrix: what is done to a device, when, what must be seen of it, and whether it was (cells.toml)."""

from __future__ import annotations

import asyncio
import logging
import math
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final

from daemon.health.faults import Fault
from daemon.runtime.heartbeat import OVER_S
from daemon.snapshot import State
from tests.faults.house import ROBOT, House, Line, Sight, live, surveyed, tracking
from tools.sim.scene import Scenario

TABLE: Final = Path(__file__).with_name("cells.toml")
DEVICES: Final = ("lidar", "adc", "odometry")
WORDS: Final = ("ok", "off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent")
TIMES: Final = ("start", "run", "stop")

FAULT_S: Final = 8.0
"""How long a fault lasts."""
CALM_S: Final = 3.0
"""TRACKING before it."""
STOP_AFTER_S: Final = 6.0
"""A stop comes this long after the fault; the fault ends a second after the next start."""
PATIENCE_S: Final = 40.0
STOP_S: Final = 3.0
"""Seconds a stop may take."""
FIRST: Final = {"back": 20.0}
"""What holds at start and stop unless said otherwise: the place has to be found in the stored map first."""
ERROR_M: Final = 0.10
SIGMAS: Final = 3.0


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell: see cells.toml for what its fields mean."""

    device: str
    word: str
    time: str
    order: str = ""
    codes: tuple[int, ...] = ()
    also: tuple[int, ...] = ()
    noticed: float = 2.2
    silent: float = 0.0
    states: tuple[str, ...] = ("TRACKING",)
    back: float = 0.0
    gone: float = 12.0
    widened: str = ""
    defect: str = ""

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.device} {self.word} at {self.time}"

    @property
    def toml(self) -> str:
        """The order; empty for ``ok``."""
        more = f"; {self.order}" if self.order else ""
        return "" if self.word == "ok" else f"where = '{self.device}'; what = '{self.word}'{more}"


def cells(path: Path = TABLE) -> tuple[Cell, ...]:
    """All of them, in the order of the table; raises ValueError for a key that means nothing and for a gap."""
    tree = tomllib.loads(path.read_text())
    known = {one.name for one in fields(Cell)} | set(TIMES)
    made = []
    for device in DEVICES:
        for word in WORDS:
            table = dict(tree.get(device, {}).pop(word, {})) if word != "ok" else {}
            if word != "ok" and not table:
                raise ValueError(f"{path.name}: [{device}.{word}] is missing")
            special = {time: table.pop(time, {}) for time in TIMES}
            for time in TIMES:
                values = {**table, **({} if time == "run" else FIRST), **special[time]}
                if unknown := set(values) - known:
                    raise ValueError(f"{path.name}: [{device}.{word}] has unknown {', '.join(sorted(unknown))}")
                made.append(Cell(device, word, time, **{key: _value(value) for key, value in values.items()}))
    return tuple(made)


def _value(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


@dataclass(slots=True)
class Outcome:
    """What happened in a cell. Times in seconds of the loop.

    Attributes:
        t_on, t_off: when the fault came and went. t_again: when a second daemon was started; infinite: there was none.
        sights: published from ``t_on`` on. lines: of the log since then.
        stop_s: seconds that the stops took. laser: it was on after one, though the sensor could be reached.
        ended: why the daemon ended by itself.
    """

    t_on: float = 0.0
    t_off: float = 0.0
    t_again: float = math.inf
    sights: list[Sight] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    stop_s: list[float] = field(default_factory=list)
    laser: bool = False
    ended: str = ""

    @property
    def noticed(self) -> dict[int, float]:
        """Seconds after the fault came at which each fault code was first named."""
        first: dict[int, float] = {}
        for sight in self.sights:
            for fault in sight.faults:
                first.setdefault(int(fault), sight.t - self.t_on)
        return first

    @property
    def shown(self) -> dict[str, float]:
        """Seconds after the fault came at which each state was first said."""
        first: dict[str, float] = {}
        for sight in self.sights:
            first.setdefault(sight.snapshot.state.name, sight.t - self.t_on)
        return first

    def silent(self, device: str) -> float | None:
        """Seconds after the fault came at which the device was first shown as not delivering."""
        ok = f"{device}_ok"
        return next((s.t - self.t_on for s in self.sights if getattr(s.snapshot, ok) is False), None)

    @property
    def back(self) -> float | None:
        """Seconds after the fault from which TRACKING was said without a break; None: not at the end."""
        return self._since(tracking)

    @property
    def gone(self) -> float | None:
        """Seconds after the fault from which no fault was named; None: one was at the end."""
        return self._since(lambda sight: not sight.faults)

    def _since(self, so: Any) -> float | None:
        begun = None
        for sight in self.sights:
            if not so(sight):
                begun = None
            elif begun is None:
                begun = max(0.0, sight.t - self.t_off)
        return begun

    def spells(self) -> list[tuple[list[Sight], list[Line]]]:
        """What each daemon has published and logged."""
        first = [s for s in self.sights if s.t < self.t_again], [line for line in self.lines if line.t < self.t_again]
        if math.isinf(self.t_again):
            return [first]
        sights = [sight for sight in self.sights if sight.t >= self.t_again]
        return [first, (sights, [line for line in self.lines if line.t >= self.t_again])]

    def placed(self, cell: Cell) -> list[Sight]:
        """Where the pose is judged: everywhere; after a start from the first TRACKING on: before, it is looked for."""
        judged: list[Sight] = []
        for number, (sights, _) in enumerate(self.spells()):
            at = next((k for k, sight in enumerate(sights) if tracking(sight)), len(sights))
            judged += sights[0 if number == 0 and cell.time != "start" else at :]
        return judged

    def lost(self, cell: Cell) -> str:
        """What came to nothing: scans, blocks of light, or the time without odometry."""
        spells = [[sight.snapshot for sight in sights] for sights, _ in self.spells() if sights]
        if cell.device == "lidar":
            return f"{sum(self._rose([s.missed for s in one]) for one in spells)} scans"
        if cell.device == "adc":
            return f"{sum(self._rose([s.light.blocks_lost if s.light else 0 for s in one]) for one in spells)} blocks"
        gone = sum(not (s.odometry_ok or s.odometry_ok is None) for one in spells for s in one)
        return f"{gone / max(1, sum(map(len, spells))):.0%} of the time"

    @staticmethod
    def _rose(counts: list[int]) -> int:
        return max(counts) - counts[0]

    def error_m(self, cell: Cell) -> float:
        """The largest error of a pose."""
        return max((sight.error_m or 0.0 for sight in self.placed(cell)), default=0.0)

    def sigmas(self, cell: Cell) -> float:
        """The largest error in its one-sigma."""
        return max((sight.sigmas or 0.0 for sight in self.placed(cell)), default=0.0)


def play(cell: Cell, scenario: Scenario = ROBOT) -> Outcome:
    """Let a cell happen."""
    out = Outcome()

    async def story(house: House) -> None:
        await {"start": _start, "run": _run, "stop": _stop}[cell.time](cell, house, out)

    live(story, scenario, surveyed())
    return out


async def _start(cell: Cell, house: House, out: Outcome) -> None:
    house.order(cell.toml)
    out.t_on = house.loop.time()
    house.start()
    await asyncio.sleep(FAULT_S)
    house.faults.clear()
    await _recover(house, out)
    await _end(house, out)
    _take(house, out)


async def _run(cell: Cell, house: House, out: Outcome) -> None:
    await _calm(house)
    house.order(cell.toml)
    out.t_on = house.loop.time()
    await asyncio.sleep(FAULT_S)
    house.faults.clear()
    await _recover(house, out)
    await _end(house, out)
    _take(house, out)


async def _stop(cell: Cell, house: House, out: Outcome) -> None:
    await _calm(house)
    house.order(cell.toml)
    out.t_on = house.loop.time()
    await asyncio.sleep(STOP_AFTER_S)
    await _end(house, out, reached=cell.device != "lidar" or cell.word not in ("off", "garbage"))
    await asyncio.sleep(0.5)
    out.t_again = house.loop.time()
    house.start()
    await asyncio.sleep(1.0)
    house.faults.clear()
    await _recover(house, out)
    await _end(house, out)
    _take(house, out)


async def _calm(house: House) -> None:
    house.start()
    if not await house.until(lambda: bool(house.sights) and tracking(house.sights[-1]), PATIENCE_S):
        raise AssertionError(f"not TRACKING within {PATIENCE_S} s before there was any fault; {house.ended}")
    await asyncio.sleep(CALM_S)


async def _recover(house: House, out: Outcome) -> None:
    """Until all has been well for a while, or patience ends."""
    out.t_off = house.loop.time()
    well = 0.0

    def so() -> bool:
        nonlocal well
        sight = house.sights[-1]
        if sight.t <= out.t_off or not tracking(sight) or sight.faults:
            well = house.loop.time()
        return house.loop.time() - max(well, out.t_off) > OVER_S + 1.5

    await house.until(so, PATIENCE_S)


async def _end(house: House, out: Outcome, reached: bool = True) -> None:
    """Stop it; ``reached``: the lidar hears what it is told."""
    out.ended = out.ended or house.ended
    if not house.ended:
        out.stop_s.append(await house.stop())
        out.laser = out.laser or (reached and house.lidar.laser)


def _take(house: House, out: Outcome) -> None:
    out.sights = [sight for sight in house.sights if sight.t >= out.t_on]
    out.lines = [line for line in house.lines if line.t >= out.t_on]


def objections(cell: Cell, out: Outcome) -> list[str]:
    """Everything that speaks against "survived"."""
    return [*_alive(cell, out), *_named(cell, out), *_said(cell, out), *_placed(cell, out)]


def _alive(cell: Cell, out: Outcome) -> Iterator[str]:
    if out.ended:
        yield out.ended
    if slow := [f"{took:.1f} s" for took in out.stop_s if took > STOP_S]:
        yield f"a stop took {', '.join(slow)}"
    if out.laser:
        yield "the laser was left on"
    if out.back is None:
        yield f"no TRACKING {PATIENCE_S:.0f} s after the fault"
    elif out.back > cell.back:
        yield f"TRACKING {out.back:.1f} s after the fault, {cell.back} s allowed"


def _named(cell: Cell, out: Outcome) -> Iterator[str]:
    """The fault by its number, in time, and no other; the device as it is."""
    noticed = out.noticed
    for code in cell.codes:
        if code not in noticed:
            yield f"fault {code} was never named"
        elif noticed[code] > cell.noticed:
            yield f"fault {code} was named after {noticed[code]:.2f} s, {cell.noticed} s allowed"
    if strange := sorted(set(noticed) - {*cell.codes, *cell.also}):
        yield f"strange faults were named: {', '.join(Fault(code).name for code in strange)}"
    if cell.silent:
        silent = out.silent(cell.device)
        if silent is None or silent > cell.silent:
            yield f"silence was shown after {silent} s, {cell.silent} s allowed"
    if out.gone is None:
        yield "a fault is still named at the end"
    elif out.gone > cell.gone:
        yield f"the last fault was named {out.gone:.1f} s after it was over, {cell.gone} s allowed"


DISTURBANCES: Final = "daemon.integrity.light_disturbance"
"""Logger of what disturbs the light without being a fault."""


def _said(cell: Cell, out: Outcome) -> Iterator[str]:
    """One line each way for every fault that a daemon has named; it may stop before one is over."""
    for number, (sights, lines) in enumerate(out.spells()):
        named = {int(fault) for sight in sights for fault in sight.faults}
        warnings = [line for line in lines if line.level >= logging.WARNING and line.name != DISTURBANCES]
        come = [_code(line) for line in warnings]
        gone = [_code(line) for line in lines if line.text.startswith("over: ")]
        stopped = cell.time == "stop" and number == 0
        if len(come) != len(set(come)) or not named <= set(come) <= {*cell.codes, *cell.also}:
            yield f"lines say that {come} have come, {sorted(named)} were named: {_told(lines, out)}"
        if len(gone) != len(set(gone)) or not set(gone) <= set(come) or (set(gone) != set(come) and not stopped):
            yield f"lines say that {gone} have gone, {come} had come: {_told(lines, out)}"
    if failed := [line.text for line in out.lines if line.level >= logging.ERROR]:
        yield f"errors: {failed}"


def _code(line: Line) -> int:
    """The fault that a line of the log tells of; 0: none."""
    found = re.match(r"(?:over: )?fault (\d+): ", line.text)
    return int(found[1]) if found else 0


def _told(lines: list[Line], out: Outcome) -> str:
    told = [line for line in lines if line.level >= logging.WARNING or line.text.startswith("over: ")]
    return "; ".join(f"{line.t - out.t_on:+.1f} s {line.text[:120]}" for line in told)


def _placed(cell: Cell, out: Outcome) -> Iterator[str]:
    """The pose, and what is said of it."""
    during = {s.snapshot.state for s in out.sights if s.t < out.t_off} if cell.time == "run" else set()
    if wrong := sorted(state.name for state in during if state.name not in cell.states):
        yield f"said {', '.join(wrong)} while it lasted"
    if (error := out.error_m(cell)) > ERROR_M:
        yield f"the pose was {error:.3f} m off"
    if (sigmas := out.sigmas(cell)) > SIGMAS:
        yield f"the pose was {sigmas:.1f} sigma off"
    lies = [s.error_m for s in out.sights if s.snapshot.state is State.TRACKING and (s.error_m or 0.0) > ERROR_M]
    if lies:
        yield f"TRACKING was said of a pose {max(e or 0.0 for e in lies):.3f} m off"
