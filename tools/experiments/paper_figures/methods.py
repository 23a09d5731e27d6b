"""The methods beside each other on recordings, as `lumiloop replay --method` runs them.

A simulated recording, in virtual time: the paper's room and its 16 lamps, a lidar, wheels, and light as words of the
converter. Its truth is known, so the errors of the published poses are given. Method `pic` has no light and starts at
the true pose. The real logs have no light: Intel with relations found by hand (`tools.relations`), exp1 and exp2
without truth, so the mean distance between points of the map is given (`python -m tools.bench crispness`).
"""

import os
import statistics
import tempfile
from dataclasses import replace as changed
from pathlib import Path
from typing import Final

from daemon.config.schema import Config
from daemon.replay.log_replay import Outcome, replay
from daemon.replay.sources import open_log
from estimator.paper import METHODS
from tools.bench import crispness
from tools.ci.figures import Figure
from tools.experiments.support.report import COMMAND, Cell, Report, Table, Work
from tools.experiments.support.trajectory import Errors, Track, errors, started
from tools.relations import SPLIT_S, evaluate, read_relations
from tools.sim import harness
from tools.sim.building.buildings import building
from tools.sim.light.link_drive import ROOM_BODY, ROOM_ROUTE
from tools.sim.light.scene import Lights
from tools.sim.scene import Scenario, SimulatedScene

SECONDS: Final = 180.0
FROM_S: Final = 10.0
"""Light has told heading by then."""
SEED: Final = 1
UNLIT: Final = ("pic",)
INTEL: Final = "intel/intel"
LOGS: Final = {name: crispness.LOGS[name] for name in ("exp1", "exp2")}

Rows = list[tuple[Cell, ...]]
Task = tuple[str, str, float]
"""Which recording, the folder of real logs, and seconds of the simulated one."""


def drive() -> SimulatedScene:
    """Up and down the paper's room and across it, under its lamps, among people."""
    place = changed(building("paper_room"), route=ROOM_ROUTE)
    return SimulatedScene(Scenario(laps=1, body=ROOM_BODY, lights=Lights(), seed=SEED), place)


def simulated(seconds: float) -> Rows:
    """Errors of the published poses on a simulated recording: a row for each method."""
    scene, rows = drive(), Rows()
    with tempfile.TemporaryDirectory() as folder:
        harness.run(seconds, scene=scene, record=Path(folder))
        for name in METHODS:
            outcome = replay(open_log(Path(folder)), Config(), method=name)
            live = judged(outcome, scene, name, min(FROM_S, 0.5 * seconds))
            lengths = [100.0 * value for value in (live.rmse, live.largest, live.end)]
            rows.append((name, *lengths, live.heading, _ms(outcome)))
    return rows


def judged(outcome: Outcome, scene: SimulatedScene, name: str, begin: float) -> Errors:
    """Of the published poses from ``begin`` on; in the frame of the survey, or from the true start without light."""
    online = outcome.rerun.ledger.online()
    track = Track(online.stamps, online.poses, scene.truth(online.stamps))
    return errors((started(track) if name in UNLIT else track).since(float(online.stamps[0]) + begin))


def intel(log: Path) -> Rows:
    """Mean errors of relations, within and beyond 30 s: a row for each method."""
    relations, rows = read_relations(log.with_suffix(".relations")), Rows()
    for name in METHODS:
        outcome = replay(open_log(log.with_suffix(".clf.gz")), Config(), method=name)
        final = outcome.rerun.ledger.final()
        found = evaluate(final.stamps, final.poses, relations)
        near, far = found.within(SPLIT_S), found.beyond(SPLIT_S)
        means = [100.0 * near.translation_m.mean(), near.rotation_deg.mean()]
        means += [100.0 * far.translation_m.mean(), far.rotation_deg.mean()]
        rows.append((name, *(float(mean) for mean in means), outcome.rerun.ledger.matched, _ms(outcome)))
    return rows


def maps(source: Path) -> Rows:
    """Mean distance between points of the map, mm: a row for each method."""
    rows = Rows()
    for name in METHODS:
        found = crispness.load(source, name)
        rows.append((name, 1e3 * crispness.crispness(found, found.ours)))
    return rows


def _ms(outcome: Outcome) -> float:
    return 1e3 * statistics.median(outcome.rerun.timing.steps)


def trial(task: Task) -> Rows:
    """One recording."""
    which, data, seconds = task
    if which == "simulated":
        return simulated(seconds)
    return intel(Path(data) / INTEL) if which == "intel" else maps(Path(data) / LOGS[which])


def figure_of(name: str, row: tuple[Cell, ...]) -> Figure:
    """The first number of a row."""
    what, unit = HEADS[name][1].rsplit(", ", 1)
    return Figure(f"{name}, {row[0]}: {what}", float(row[1]), unit, command=f"{COMMAND} methods")


def run(quick: bool, work: Work) -> Report:
    """All recordings; with ``quick`` twenty seconds of the simulated one."""
    data, seconds = os.environ.get("LUMILOOP_DATA", ""), 20.0 if quick else SECONDS
    names = ["simulated", *(("intel", *LOGS) if data and not quick else ())]
    rows = dict(zip(names, work.map(trial, [(name, data, seconds) for name in names], "methods"), strict=True))
    tables = [
        Table(HEADS[name][0].format(seconds=seconds), ("method", *HEADS[name][1:]), tuple(rows[name])) for name in names
    ]
    figures = [figure_of(name, row) for name in names for row in rows[name]]
    notes = NOTES if len(names) > 1 else (*NOTES, "without LUMILOOP_DATA the real logs are left out")
    return Report(tuple(figures), tuple(tables), (), (SEED,), notes)


HEADS: Final = {
    "simulated": (
        "simulated recording with lamps, {seconds:.0f} s, published poses from 10 s on",
        *("rmse, cm", "largest, cm", "at the end, cm", "heading rms, deg", "ms a step, median"),
    ),
    "intel": (
        "Intel, loops closed, poses at the end: mean errors of relations",
        *("within 30 s, cm", "deg", "beyond 30 s, cm", "deg", "scans matched", "ms a step, median"),
    ),
    "exp1": ("exp1 (URG-04LX, 46 m): map, T_odom_base", "mean nearest distance, mm"),
    "exp2": ("exp2 (URG-04LX, 44 m): map, T_odom_base", "mean nearest distance, mm"),
}
NOTES: Final = (
    "keyframes, submaps, loops and pose graph are the same in all methods; scans are matched and light is used by each "
    "in its own way",
    "lumiloop and paper are told nothing of the start; pic has no light and is put at the true start",
    "on logs without light the paper's T1 is the prediction and has no weight",
)
