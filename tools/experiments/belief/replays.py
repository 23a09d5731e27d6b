"""One real log, as it is or spoiled, through the daemon's cycle: what was published with each scan, and its faults."""

from __future__ import annotations

import logging
import math
import tempfile
import time
from collections import defaultdict, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from daemon.config.schema import Config
from daemon.health.assessment import Vitals, assess
from daemon.maps.map_server import OCCUPIED
from daemon.replay.recorded_inputs import NOTHING_GIVEN, config_for
from daemon.replay.runner import Rerun
from daemon.replay.sources import open_log
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import CycleRecord
from daemon.runtime.vitals import ProcessFacts, vitals
from daemon.snapshot import GUESSED, State
from estimator import SlowError
from hal.errors import HalError
from tools.experiments.belief import logs
from tools.experiments.belief.spoil import KINDS, rng_of
from tools.experiments.support.report import Work, code
from tools.sim.building.world import Array

MADE_BY: Final = ("logs", "spoil", "replays", "lies")
SOURCES: Final = (
    *("estimator/**/*.py", "hal/**/*.py", "daemon/**/*.py", "tools/sim/**/*.py", "tools/experiments/integrity/*.py"),
    *(f"tools/experiments/belief/{name}.py" for name in MADE_BY),
)
START_S: Final = 5.0
"""Time from the start from which no pose may be a guess."""
WINDOW_S: Final = 10.0
"""Faults that are rates are judged over this time, as in the daemon."""


def kept() -> Path:
    """Folder of what this code has made."""
    return Path("out/belief") / code(*SOURCES)


@dataclass(frozen=True, slots=True)
class Task:
    """A log, how it is spoiled, and by which chance."""

    log: str
    kind: str = "clean"
    seed: int = 0


@dataclass(slots=True)
class Watcher:
    """Samples the faults of a cycle once a second, as the heartbeat does.

    Attributes:
        faults: seconds at which each fault was present, by its number.
        mount: (t, yaw of the mount less the configured one in rad, its sigma, 1 if it is reported).
    """

    faults: dict[int, list[float]] = field(default_factory=lambda: defaultdict(list))
    mount: list[tuple[float, float, float, float]] = field(default_factory=list)
    _past: deque[Vitals] = field(default_factory=deque)

    def look(self, cycle: Cycle, t: float) -> None:
        """Judge the present facts, where a second has passed."""
        if self._past and t - self._past[-1].t_mono < 1.0:
            return
        now = vitals(cycle.facts(), set(), ProcessFacts())
        while len(self._past) > 1 and t - self._past[1].t_mono >= WINDOW_S:
            self._past.popleft()
        for fault in assess(now, self._past[0] if self._past else now):
            self.faults[int(fault)].append(t)
        if now.slow is not None:
            at = SlowError.MOUNT_YAW
            self.mount.append((t, now.slow.value[at], now.slow.sigma[at], float(now.slow.mount)))
        self._past.append(now)


@dataclass(slots=True)
class Replayed:
    """What a replay gave.

    Attributes:
        refused: why the log was refused; empty: it was not.
        rows: (n, 8) one row a scan: its number in the log, t in s, x, y, yaw, state, bounds in m and rad (inf: none).
        faults, mount: see :class:`Watcher`, by the same time.
        begun: time from which it was spoiled. speed: log seconds per processor second.
        final: (n, 4) stamps and poses as finally optimised; of a clean run. cells: (k, 2) occupied cells of its map.
    """

    refused: str = ""
    rows: Array = field(default_factory=lambda: np.zeros((0, 8)))
    faults: dict[int, list[float]] = field(default_factory=dict)
    mount: list[tuple[float, float, float, float]] = field(default_factory=list)
    begun: float = 0.0
    speed: float = math.nan
    final: Array | None = None
    cells: Array | None = None

    @property
    def late(self) -> Array:
        """(n,) published states from :data:`START_S` on."""
        return self.rows[self.rows[:, 1] > self.rows[:1, 1].sum() + START_S, 5]

    def guesses(self) -> int:
        """Scans whose pose is a guess, from :data:`START_S` on."""
        return int(np.isin(self.late, [float(state) for state in GUESSED]).sum())

    def tracking(self) -> float:
        """Share of the scans with state TRACKING, from :data:`START_S` on."""
        return float((self.late == State.TRACKING).mean()) if len(self.late) else 0.0

    def off(self, clean: Replayed) -> Array:
        """(n, 2) distance in m and rad from the clean run's pose of the same scan; NaN where one has none."""
        there = dict(zip(clean.rows[:, 0].tolist(), clean.rows[:, 2:5], strict=True))
        nothing = np.full(3, np.nan)
        other = np.array([there.get(number, nothing) for number in self.rows[:, 0].tolist()]).reshape(-1, 3)
        away = np.hypot(*(self.rows[:, 2:4] - other[:, :2]).T)
        return np.column_stack([away, np.abs(logs.wrapped(self.rows[:, 4] - other[:, 2]))])

    def end(self, clean: Replayed) -> float:
        """Distance of the last pose from the clean run's, m; infinite without one."""
        if not len(self.rows):
            return math.inf
        last = self.off(clean)[-1, 0]
        return float(last) if math.isfinite(last) else math.inf

    def named(self, faults: Iterable[int], since: float) -> float:
        """When one of these faults was present first, from an instant on; infinite: never."""
        return min((t for fault in faults for t in self.faults.get(int(fault), []) if t >= since), default=math.inf)


def log_of(task: Task, folder: Path) -> tuple[Path, logs.Drive | None]:
    """The log of a task as a file; with its arrays where it is spoiled."""
    path = logs.clf(task.log)
    if task.kind == "clean":
        return path, None
    drive = logs.read(path)
    KINDS[task.kind](drive, rng_of(task.log, task.kind, task.seed))
    return drive.write(folder / "spoiled.clf"), drive


def replayed(task: Task) -> Replayed:
    """Replay one."""
    logging.disable(logging.CRITICAL)  # what spoiled drives have to say
    with tempfile.TemporaryDirectory() as folder:
        path, drive = log_of(task, Path(folder))
        return followed(path, drive, with_map=task.kind == "clean" and logs.LOGS[task.log].urg)


def followed(path: Path, drive: logs.Drive | None, with_map: bool = False) -> Replayed:
    """A CARMEN log through the daemon's cycle, without any configuration; ``drive``: its arrays, where spoiled."""
    try:
        source = open_log(path)
        rerun = Rerun(source, config_for(source, Config(), NOTHING_GIVEN))
    except HalError as error:
        return Replayed(refused=str(error))
    rows: list[tuple[float, ...]] = []
    watcher = Watcher()

    def watch(record: CycleRecord) -> None:
        snapshot = record.snapshot
        watcher.look(rerun.cycle, record.t_mono)
        if record.scan is not None:
            pose, trust = snapshot.pose or (math.nan,) * 3, snapshot.trust
            bounds = (math.inf if bound is None else bound for bound in (trust.horizontal_m, trust.yaw_rad))
            rows.append((float(record.scan), record.t_mono, *pose, float(snapshot.state), *bounds))

    rerun.watch = watch
    begun = time.process_time()
    try:
        for event in source.events():
            rerun.feed(event)
    except HalError as error:
        return Replayed(refused=str(error))
    rerun.finish()
    spent = time.process_time() - begun
    table = np.array(rows).reshape(-1, 8)
    found = Replayed(rows=table, faults=dict(watcher.faults), mount=watcher.mount)
    found.speed = float(np.ptp(table[:, 1])) / spent if len(table) else math.nan
    if drive is not None:
        found.begun = (
            float(table[np.searchsorted(table[:, 0], min(drive.begun, len(table) - 1)), 1]) if len(table) else 0.0
        )
        table[:, 0] = drive.index[table[:, 0].astype(int)]
    else:
        final = rerun.ledger.final()
        found.final = np.column_stack([final.stamps, final.poses])
    if with_map:
        grid = rerun.render()
        at = np.argwhere(grid.probability > OCCUPIED)[:, ::-1]
        found.cells = grid.origin + grid.resolution * (at + 0.5)
    return found


def replay(work: Work, tasks: Iterable[Task], label: str = "replays") -> dict[Task, Replayed]:
    """Replay them all, with the clean runs of their logs; what was made already is taken from the disk."""
    wanted = dict.fromkeys(tasks)
    whole = [*dict.fromkeys(Task(task.log) for task in wanted), *wanted]
    order = list(dict.fromkeys(whole))
    return dict(zip(order, work.map(replayed, order, label, kept()), strict=True))
