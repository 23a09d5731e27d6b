"""Rows on open real logs: clean, perturbed and spoiled drives, wrong wheels, turned mounts, references and speed."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from daemon.health.faults import Fault
from tools.ci.figures import Figure, bounded
from tools.experiments.belief import logs, spoil, walls
from tools.experiments.belief.replays import Replayed, Task, replay
from tools.experiments.support.report import COMMAND, Cell, Report, Table, Work
from tools.experiments.support.trajectory import Track, errors, fitted
from tools.relations import evaluate, read_relations, read_tum
from tools.sim.building.world import Array

SEEDS, PLACES = 20, 3
"""Perturbed replays of a log; and how often a kind that has chance in it is drawn."""
BASES: Final = ("exp1", "exp2", "wean2")
"""Logs that are spoiled: two of a lidar of four metres, one of a SICK; their wheels are right."""
ONCE: Final = frozenset({"whole seconds", "zero stamps", "way +20 %", "turn +20 %", *spoil.MOUNTS, *spoil.OFFSETS})
"""Kinds in which nothing is drawn by chance."""
END_M, NAMED_M, LEARNED_M = 0.3, 5.0, 20.0
"""Limits: distance of the end from the clean run; way until wrong wheels are named, until a mount is known."""
NAMES_WHEELS: Final = (Fault.ODOMETRY_JUMPS, Fault.ODOMETRY_DISAGREES, Fault.ODOMETRY_SCALE)


def figure(row: str, name: str, value: float, unit: str, target: str = "") -> Figure:
    """A figure of a row, with the command that makes it."""
    command = f"{COMMAND} belief --rows {row}"
    return bounded(name, value, unit, target, command) if target else Figure(name, float(value), unit, command=command)


@dataclass(frozen=True, slots=True)
class Judged:
    """A drive against the clean run of its log, from where it was spoiled on.

    Attributes:
        end: distance of the last pose, m. worst, turned: largest distance, m and deg; scans without a pose do not
            count. wheels, mount: way until a fault has named them, m; infinite: none has.
        yaw: error of the estimated mount yaw after :data:`LEARNED_M`, deg; infinite: no estimate.
        beyond, bounded: scans beyond their bound, and with one.
    """

    task: Task
    run: Replayed
    end: float = math.inf
    worst: float = math.inf
    turned: float = math.inf
    wheels: float = math.inf
    mount: float = math.inf
    yaw: float = math.inf
    beyond: int = 0
    bounded: int = 0

    @property
    def right(self) -> bool:
        """Whether the pose stayed within 0.3 m and 3 deg."""
        return self.worst <= 0.3 and self.turned <= 3.0


def judged(task: Task, run: Replayed, clean: Replayed, drive: logs.Drive) -> Judged:
    """``drive``: the log as it was."""
    if not len(run.rows):
        return Judged(task, run)
    since = run.rows[:, 1] >= run.begun
    rows, off = run.rows[since], run.off(clean)[since]
    way = drive.way[rows[:, 0].astype(int)]

    def way_at(t: float) -> float:
        return float(np.interp(t, rows[:, 1], way - way[0])) if t <= rows[-1, 1] else math.inf

    turned = spoil.MOUNTS.get(task.kind, (0, False))[0]
    yaw = spoil.beams_of(drive, turned) * float(drive.bearings[1] - drive.bearings[0])
    known = [abs(value - yaw) for t, value in run.watcher.mount if t >= run.begun and way_at(t) <= LEARNED_M]
    there = off[np.isfinite(off[:, 0])]
    with_bound = np.isfinite(rows[:, 6]) & np.isfinite(off[:, 0])
    return Judged(
        task, run, float(off[-1, 0]), float(there[:, 0].max()), math.degrees(float(there[:, 1].max())),
        way_at(run.named(NAMES_WHEELS)), way_at(run.named((Fault.LIDAR_TURNED,))),
        math.degrees(known[-1]) if known else math.inf,
        int((with_bound & ((off > rows[:, 6:8]).any(axis=1))).sum()), int(with_bound.sum()),
    )  # fmt: skip


def drives(work: Work, kinds: Iterable[str]) -> dict[str, list[Judged]]:
    """Drives of some kinds, on each of :data:`BASES`, as often as ``work`` asks for."""
    bases, seeds = logs.present(BASES), range(work.trials or PLACES)
    of = {kind: [Task(name, kind, k) for name in bases for k in seeds[: 1 if kind in ONCE else None]] for kind in kinds}
    found = replay(work, [task for tasks in of.values() for task in tasks])
    read = {name: logs.read(logs.clf(name)) for name in bases}
    return {
        kind: [judged(task, found[task], found[Task(task.log)], read[task.log]) for task in tasks]
        for kind, tasks in of.items()
    }


def total(found: dict[str, list[Judged]], value: Callable[[Judged], float]) -> float:
    """Sum over all drives."""
    return sum(value(one) for some in found.values() for one in some)


def clean(work: Work) -> Report:
    """Every real log as it is."""
    found = replay(work, map(Task, logs.present()))
    table = [
        (task.log, logs.LOGS[task.log].lidar, "yes" if logs.LOGS[task.log].wheels else "no", len(run.rows),
         run.guesses(), run.tracking())
        for task, run in found.items()
    ]  # fmt: skip
    rolling, carried = ([row for row in table if row[2] == has] for has in ("yes", "no"))
    low = min(rolling, key=lambda row: row[5])
    steady = sum(row[5] >= 98.0 for row in rolling)
    head = ("log", "lidar", "wheels", "scans", "guesses after 5 s", "TRACKING after 5 s, %")
    figures = (
        figure("clean", "clean drives with wheels: guesses after 5 s", sum(row[4] for row in rolling), "", "<= 0"),
        figure("clean", f"clean drives with wheels: least TRACKING ({low[0]})", low[5], "%", ">= 98"),
        figure("clean", f"clean drives with wheels: TRACKING of 98 % or more, of {len(rolling)}", steady, ""),
        figure("clean", "drives without wheels: guesses after 5 s", sum(row[4] for row in carried), ""),
    )
    return Report(figures, (Table("Clean drives", head, tuple(table)),))


def perturbed(work: Work) -> Report:
    """Every real log with wheels, many times, with differences in stamps, ranges and beams that do not matter."""
    names, seeds = [name for name in logs.present() if logs.LOGS[name].wheels], range(work.trials or SEEDS)
    found = replay(work, (Task(name, "perturbed", seed) for seed in seeds for name in names))
    table = []
    for name in names:
        runs = [found[Task(name, "perturbed", seed)] for seed in seeds]
        guesses = [run.guesses() for run in runs]
        ends = np.array([run.rows[-1, 2:4] for run in (*runs, found[Task(name)])])
        spread = 100.0 * float(np.hypot(*(ends - np.median(ends, axis=0)).T).max())
        table.append((name, logs.LOGS[name].lidar, sum(map(bool, guesses)), max(guesses), spread))
    figures = [
        figure("perturbed", f"perturbed replays with guesses after 5 s, of {len(names) * len(seeds)}",
               sum(row[2] for row in table), "", "<= 0"),
    ]  # fmt: skip
    for lidar, some, limit in (
        ("other lidars", [row for row in table if row[1] != logs.URG], "<= 5"),
        (logs.URG, [row for row in table if row[1] == logs.URG], "<= 15"),
    ):
        worst = max((row[4] for row in some), default=0.0)
        figures.append(figure("perturbed", f"spread of the end pose, worst log, {lidar}", worst, "cm", limit))
    head = ("log", "lidar", "replays with guesses", "guesses, most", "spread of the end, cm")
    note = "spread: largest distance of an end from the median end of the replays of one log, the clean one among them"
    return Report(tuple(figures), (Table("Perturbed replays", head, tuple(table)),), seeds=tuple(seeds), notes=(note,))


def spoiled(work: Work) -> Report:
    """Drives whose wheels are right, spoiled as in the field."""
    found = drives(work, spoil.SPOILED)
    table = []
    for kind, some in found.items():
        whole = [one for one in some if not one.run.refused]
        share = float(np.mean([one.run.tracking() for one in whole])) if whole else math.nan
        end = max((one.end for one in whole), default=math.nan)
        table.append((kind, len(some), len(some) - len(whole), sum(one.run.guesses() for one in whole), end, share))
    ended = sum(row[1] - row[2] for row in table)
    far = total(found, lambda one: not one.run.refused and one.end > END_M)
    figures = (
        figure("spoiled", "spoiled drives: guesses after 5 s", sum(row[3] for row in table), "", "<= 0"),
        figure("spoiled", f"spoiled drives that end over 0.3 m from the clean run, of {ended}", far, "", "<= 0"),
    )
    head = ("kind", "drives", "refused", "guesses after 5 s", "end from the clean run, worst, m", "TRACKING, %")
    note = "zero stamps hold no time: the right answer is to refuse the log, with the reason"
    return Report(figures, (Table(f"Spoiled drives of {', '.join(BASES)}", head, tuple(table)),), notes=(note,))


def wheels(work: Work) -> Report:
    """Wheels that are wrong while the laser is good."""
    found = drives(work, spoil.WHEELS)
    table = []
    for kind, some in found.items():
        named = max((one.wheels for one in some if not one.right), default=0.0)
        bad = sum(not one.right and one.wheels > NAMED_M for one in some)
        worst = max(one.worst for one in some), max(one.turned for one in some)
        table.append((kind, len(some), *worst, named if math.isfinite(named) else "never", bad))
    count, beyond, cycles = (total(found, value) for value in (lambda _: 1, lambda o: o.beyond, lambda o: o.bounded))
    figures = (
        figure("wheels", f"wheels wrong, neither right to 0.3 m / 3 deg nor named within 5 m, of {count}",
               sum(row[5] for row in table), "", "<= 0"),
        figure("wheels", f"wheels wrong: scans beyond their bound, of {cycles}", beyond, ""),
    )  # fmt: skip
    head = ("wheels", "drives", "from the clean run, worst, m", "worst, deg", "named after, where not right, worst, m",
            "neither right nor named")  # fmt: skip
    return Report(figures, (Table(f"Wheels wrong on {', '.join(BASES)}", head, tuple(table)),))


def mount(work: Work) -> Report:
    """A lidar mount that is turned or displaced against the configured one."""
    found = drives(work, (*spoil.MOUNTS, *spoil.OFFSETS))
    table: list[tuple[Cell, ...]] = []
    for one in (one for some in found.values() for one in some):
        yaw, named = (value if math.isfinite(value) else "none" for value in (one.yaw, one.mount))
        table.append((one.task.kind, one.task.log, one.worst, one.turned, yaw, named))
    turns = {kind: some for kind, some in found.items() if kind in spoil.MOUNTS}
    late, unnamed = total(turns, lambda one: one.yaw > 0.5), total(turns, lambda one: one.mount > LEARNED_M)
    count, beyond, cycles = (
        total(turns, lambda _: 1),
        total(found, lambda o: o.beyond),
        total(found, lambda o: o.bounded),
    )
    figures = (
        figure("mount", f"mount turned: yaw not known to 0.5 deg within 20 m, of {count}", late, "", "<= 0"),
        figure("mount", f"mount turned: not named within 20 m, of {count}", unnamed, "", "<= 0"),
        figure("mount", f"mount wrong: scans beyond their bound, of {cycles}", beyond, "", "<= 0"),
    )
    head = ("mount", "log", "from the clean run, worst, m", "worst, deg", "yaw off after 20 m, deg", "named after, m")
    note = "bounds are held against the clean run, which itself is right to centimetres only"
    return Report(figures, (Table("Mounts turned and displaced", head, tuple(table)),), notes=(note,))


def reference(work: Work) -> Report:
    """Real logs against what is known of them: relations found by hand, a corrected trajectory, straight walls."""
    root, names = logs.folder(), logs.present(("intel", "fhw", "exp1", "exp2", "test_lab"))
    found = replay(work, map(Task, names))
    figures: list[Figure] = []
    if "intel" in names and (root / "intel/intel.relations").is_file():
        figures += _intel(found[Task("intel")], read_relations(root / "intel/intel.relations"))
    if "fhw" in names and (root / "keyscans/fhw.ref.tum.gz").is_file():
        off = _ate(found[Task("fhw")].final, *read_tum(root / "keyscans/fhw.ref.tum.gz"))
        figures.append(figure("reference", "fhw, absolute trajectory error", off, "m", "<= 0.3"))
    table = []
    for name in (name for name in names if logs.LOGS[name].lidar == logs.URG):
        single, scans = walls.of_scans(logs.read(logs.clf(name)))
        whole = walls.between(found[Task(name)].cells)
        table.append((name, whole, single, scans, abs(whole - single)))
    if table:
        worst = max(row[4] for row in table)
        figures.append(figure("reference", "angle of the two longest walls, map from scans", worst, "deg", "<= 2"))
    head = ("log", "in the map, deg", "in single scans, median, deg", "scans", "difference, deg")
    return Report(tuple(figures), (Table("Angle of the two longest walls", head, tuple(table)),))


def _intel(run: Replayed, relations: Array) -> list[Figure]:
    stamps = run.final[:, 0]
    online = np.interp(run.rows[:, 0], np.arange(len(stamps)), stamps), run.rows[:, 2:5]
    final = evaluate(stamps, run.final[:, 1:], relations)
    parts = (("final", final, 0.0200, 0.385), ("final, within 30 s", final.within(30.0), 0.0155, 0.382),
             ("online", evaluate(*online, relations), 0.06, 0.5))  # fmt: skip
    return [
        figure("reference", f"Intel relations, {name}", float(values.mean()), unit, f"<= {limit}")
        for name, off, m, deg in parts
        for values, unit, limit in ((off.translation_m, "m", m), (off.rotation_deg, "deg", deg))
    ]


def _ate(final: Array, stamps: Array, poses: Array) -> float:
    """RMS distance (m) from a reference after the best rigid fit, at its stamps."""
    final = final[np.argsort(final[:, 0], kind="stable")]
    nearest = np.abs(final[:, :1] - stamps[None, :]).argmin(axis=0)
    near = np.abs(final[nearest, 0] - stamps) < 0.15
    return errors(fitted(Track(stamps[near], final[nearest[near], 1:], poses[near]))).rmse


def speed(work: Work) -> Report:
    """Log seconds per second of processor time."""
    found = replay(work, map(Task, logs.present()))
    table = [(task.log, logs.LOGS[task.log].lidar, len(run.rows), run.speed) for task, run in found.items()]
    slowest = min(table, key=lambda row: row[3])
    figures = [figure("speed", f"replay, slowest log ({slowest[0]})", slowest[3], "x real time", ">= 20")]
    figures += [
        figure("speed", "replay of Intel", row[3], "x real time", ">= 150") for row in table if row[0] == "intel"
    ]
    return Report(tuple(figures), (Table("Replay", ("log", "lidar", "scans", "x real time"), tuple(table)),))
