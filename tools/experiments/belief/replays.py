"""One real log, as it is or spoiled, through the daemon's cycle: what was published with each scan, and its faults."""

import contextlib
import logging
import math
import tempfile
import time
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from daemon.config.schema import Config
from daemon.health.assessment import WINDOW_S, Vitals, assess
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
from tools.experiments.belief.spoil import spoil
from tools.experiments.support.report import Work, code
from tools.sim.building.world import Array

SOURCES: Final = (
    *("estimator/**/*.py", "hal/**/*.py", "daemon/**/*.py", "tools/sim/**/*.py", "tools/experiments/integrity/*.py"),
    *(f"tools/experiments/belief/{name}.py" for name in ("logs", "spoil", "replays", "lies")),
)
START_S: Final = 5.0
"""What is published later than this after the start counts."""


def kept() -> Path:
    """Folder of what this code has made."""
    return Path("out/belief") / code(*SOURCES)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Nothing is logged: spoiled drives and lying sensors have much to say."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


@dataclass(frozen=True, slots=True)
class Task:
    """A log, how it is spoiled, and the seed of the chance in it."""

    log: str
    kind: str = "clean"
    seed: int = 0


@dataclass(slots=True)
class Watcher:
    """Samples the faults of a cycle once a second, as the heartbeat does.

    Attributes:
        faults: times at which each fault was present, by its number.
        mount: (t, estimated yaw of the mount less the configured one, rad).
    """

    faults: dict[int, list[float]] = field(default_factory=lambda: defaultdict(list))
    mount: list[tuple[float, float]] = field(default_factory=list)
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
            self.mount.append((t, now.slow.value[SlowError.MOUNT_YAW]))
        self._past.append(now)


@dataclass(slots=True)
class Replayed:
    """What a replay gave.

    Attributes:
        refused: why the log was refused; empty: it was not.
        rows: (n, 8) one row a scan: its number in the log, t in s, x, y, yaw, state, bounds in m and rad (inf: none).
        watcher: faults, by the same time. begun: time from which it was spoiled. speed: log over processor seconds.
        final: (n, 4) stamps and poses as finally optimised. cells: (k, 2) occupied cells of the map of a clean run.
    """

    refused: str = ""
    rows: Array = field(default_factory=lambda: np.zeros((0, 8)))
    watcher: Watcher = field(default_factory=Watcher)
    begun: float = 0.0
    speed: float = math.nan
    final: Array = field(default_factory=lambda: np.zeros((0, 4)))
    cells: Array = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def late(self) -> Array:
        """(n,) published states from :data:`START_S` on."""
        return np.asarray(self.rows[self.rows[:, 1] > self.rows[:1, 1].sum() + START_S, 5])

    def guesses(self) -> int:
        """Scans from then on whose pose is a guess."""
        return int(np.isin(self.late, GUESSED).sum())

    def tracking(self) -> float:
        """Share (%) of the scans from then on with state TRACKING."""
        return 100.0 * float((self.late == State.TRACKING).mean()) if len(self.late) else math.nan

    def off(self, clean: "Replayed") -> Array:
        """(n, 2) distance in m and rad from the clean run's pose of the same scan; infinite where one has none."""
        there = np.full((int(max(self.rows[:, 0].max(), clean.rows[:, 0].max())) + 1, 3), np.nan)
        there[clean.rows[:, 0].astype(int)] = clean.rows[:, 2:5]
        e = self.rows[:, 2:5] - there[self.rows[:, 0].astype(int)]
        away = np.column_stack([np.hypot(e[:, 0], e[:, 1]), np.abs((e[:, 2] + np.pi) % (2.0 * np.pi) - np.pi)])
        return np.asarray(np.where(np.isnan(away), np.inf, away))

    def named(self, faults: Iterable[int]) -> float:
        """When one of these faults was present first since it was spoiled; infinite: never."""
        times = (t for fault in faults for t in self.watcher.faults.get(int(fault), []) if t >= self.begun)
        return min(times, default=math.inf)


@quiet()
def replayed(task: Task) -> Replayed:
    """Replay one, as a stranger's: without any configuration."""
    path = logs.clf(task.log)
    with tempfile.TemporaryDirectory() as folder:
        if task.kind == "clean":
            return followed(path, with_map=logs.LOGS[task.log].lidar == logs.URG)
        drive = spoil(logs.read(path), task.log, task.kind, task.seed)
        found = followed(drive.write(Path(folder) / "spoiled.clf"))
    if len(found.rows):
        found.begun = float(
            found.rows[min(int(np.searchsorted(found.rows[:, 0], drive.begun)), len(found.rows) - 1), 1]
        )
        found.rows[:, 0] = drive.index[found.rows[:, 0].astype(int)]
    return found


def followed(path: Path, with_map: bool = False) -> Replayed:
    """A CARMEN log through the daemon's cycle."""
    rows: list[tuple[float, ...]] = []
    watcher = Watcher()

    def watch(record: CycleRecord) -> None:
        watcher.look(rerun.cycle, record.t_mono)
        if record.scan is not None:
            pose, trust = record.snapshot.pose or (math.nan,) * 3, record.snapshot.trust
            bounds = (math.inf if bound is None else bound for bound in (trust.horizontal_m, trust.yaw_rad))
            rows.append((float(record.scan), record.t_mono, *pose, float(record.snapshot.state), *bounds))

    try:
        source = open_log(path)
        rerun = Rerun(source, config_for(source, Config(), NOTHING_GIVEN))
        rerun.watch = watch
        begun = time.process_time()
        for event in source.events():
            rerun.feed(event)
    except HalError as error:
        return Replayed(refused=str(error))
    rerun.finish()
    spent, final = time.process_time() - begun, rerun.ledger.final()
    found = Replayed(rows=np.array(rows).reshape(-1, 8), watcher=watcher)
    found.speed, found.final = float(np.ptp(found.rows[:, 1])) / spent, np.column_stack([final.stamps, final.poses])
    if with_map:
        grid = rerun.render()
        found.cells = grid.origin + grid.resolution * (np.argwhere(grid.probability > OCCUPIED)[:, ::-1] + 0.5)
    return found


def replay(work: Work, tasks: Iterable[Task]) -> dict[Task, Replayed]:
    """Replay them all, with the clean runs of their logs; what was made already is taken from the disk."""
    wanted = list(tasks)
    order = list(dict.fromkeys([*(Task(task.log) for task in wanted), *wanted]))
    return dict(zip(order, work.map(replayed, order, "replays", kept()), strict=True))
