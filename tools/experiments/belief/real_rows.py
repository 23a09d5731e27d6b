"""Rows on open real logs: clean, perturbed and spoiled drives, wrong wheels, turned mounts, references and speed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from daemon.health.faults import Fault
from tools.ci.figures import Figure, bounded
from tools.experiments.belief import logs, walls
from tools.experiments.belief.replays import Replayed, Task, replay
from tools.experiments.belief.spoil import MOUNTS, OFFSETS, SPOILED, WHEELS
from tools.experiments.support.report import COMMAND, Report, Skipped, Table, Work
from tools.experiments.support.trajectory import Track, errors, fitted
from tools.relations import evaluate, read_relations, read_tum
from tools.sim.building.world import Array

SEEDS, PLACEMENTS, DRAWS = 20, 3, 3
"""Perturbed replays of a log; where in a drive something is spoiled, and wheels are wrong."""
BASES: Final = ("exp1", "exp2", "wean2")
"""Logs that are spoiled: two of a lidar of four metres, one of a SICK; their wheels are right."""
ONCE: Final = frozenset({"stamps repeat", "whole seconds", "zero stamps"})
"""Kinds in which nothing is drawn by chance."""
SLOW_LIDARS: Final = frozenset({"5 Hz", "3.3 Hz", "2 Hz", "1 Hz"})
END_M, NEAR_M, NEAR_RAD, SAID_M, LEARNED_M = 0.3, 0.3, math.radians(3.0), 5.0, 20.0
"""Limits: of the end; of the distance from the clean run; the way until a fault is named, a mount yaw estimated."""
NAMES_WHEELS: Final = (Fault.ODOMETRY_JUMPS, Fault.ODOMETRY_DISAGREES, Fault.ODOMETRY_SCALE)


def figure(row: str, name: str, value: float, unit: str, target: str = "") -> Figure:
    """A figure of a row, with the command that makes it."""
    command = f"{COMMAND} belief --rows {row}"
    return bounded(name, value, unit, target, command) if target else Figure(name, float(value), unit, command=command)


def clean(work: Work) -> Report:
    """Every real log as it is."""
    names = logs.present()
    found = replay(work, map(Task, names), "clean drives")
    table = []
    for name in names:
        one, log = found[Task(name)], logs.LOGS[name]
        wheels = "yes" if log.wheels else "no"
        table.append((name, log.lidar, wheels, len(one.rows), one.guesses(), 100.0 * one.tracking()))
    with_wheels = [row for row in table if row[2] == "yes"]
    low = min(with_wheels, key=lambda row: row[5])
    return Report(
        (
            figure("clean", "clean drives with wheels: guesses after 5 s", sum(r[4] for r in with_wheels), "", "<= 0"),
            figure("clean", f"clean drives with wheels: least share of TRACKING ({low[0]})", low[5], "%", ">= 98"),
            figure("clean", "clean drives with wheels: TRACKING of 98 % or more",
                   sum(r[5] >= 98.0 for r in with_wheels), f"of {len(with_wheels)}"),
            figure("clean", "drives without wheels: guesses after 5 s", sum(r[4] for r in table if r[2] == "no"), ""),
        ),
        (Table("Clean drives", ("log", "lidar", "wheels", "scans", "guesses after 5 s", "TRACKING, %"), tuple(table)),),
    )  # fmt: skip


def perturbed(work: Work) -> Report:
    """Every real log again and again, with stamps, ranges and beams that differ by nothing that matters."""
    names, seeds = logs.present(wheels_only=True), range(work.trials or SEEDS)
    found = replay(work, (Task(name, "perturbed", seed) for seed in seeds for name in names), "perturbed replays")
    table = []
    for name in names:
        runs = [found[Task(name, "perturbed", seed)] for seed in seeds]
        guesses = [run.guesses() for run in runs]
        ends = np.array([run.rows[-1, 2:4] for run in runs])
        spread = float(np.hypot(*(ends - np.median(ends, axis=0)).T).max())
        lost = sum(count > 0 for count in guesses)
        table.append((name, logs.LOGS[name].lidar, len(runs), lost, max(guesses), 100.0 * spread))
    short = max((row[5] for row in table if logs.LOGS[row[0]].urg), default=0.0)
    far = max((row[5] for row in table if not logs.LOGS[row[0]].urg), default=0.0)
    head = ("log", "lidar", "replays", "with guesses", "guesses, most", "spread of the end, cm")
    return Report(
        (
            figure("perturbed", f"perturbed replays with guesses after 5 s, of {len(names) * len(seeds)}",
                   sum(row[3] for row in table), "", "<= 0"),
            figure("perturbed", "spread of the end pose, worst log", far, "cm", "<= 5"),
            figure("perturbed", "spread of the end pose, worst log of a URG-04LX", short, "cm", "<= 15"),
        ),
        (Table("Perturbed replays", head, tuple(table)),),
        seeds=tuple(seeds),
        notes=("the spread is the largest distance of an end from the median end of the replays of one log",),
    )  # fmt: skip


def spoiled(work: Work) -> Report:
    """Drives whose wheels are right, spoiled as in the field."""
    bases = [name for name in logs.present() if name in BASES]
    if not bases:
        raise Skipped(f"none of {', '.join(BASES)} is there")
    seeds = range(work.trials or PLACEMENTS)
    tasks = [
        Task(name, kind, seed) for kind in SPOILED for name in bases for seed in seeds[: 1 if kind in ONCE else None]
    ]
    found = replay(work, tasks, "spoiled drives")
    table, guesses, far, runs_of = [], 0, 0, 0
    for kind in SPOILED:
        runs = [(task, found[task]) for task in tasks if task.kind == kind]
        whole = [(task, run) for task, run in runs if not run.refused]
        ends = [run.end(found[Task(task.log)]) for task, run in whole]
        lost = sum(run.guesses() for _, run in whole)
        share = 100.0 * float(np.mean([run.tracking() for _, run in whole])) if whole else math.nan
        table.append((kind, len(runs), len(runs) - len(whole), lost, float(np.max(ends, initial=0.0)), share))
        guesses, far, runs_of = guesses + lost, far + sum(end > END_M for end in ends), runs_of + len(ends)
    head = ("kind", "drives", "refused", "guesses after 5 s", "end from the clean run, worst, m", "TRACKING, %")
    return Report(
        (
            figure("spoiled", "spoiled drives: guesses after 5 s", guesses, "", "<= 0"),
            figure(
                "spoiled", f"spoiled drives that end beyond {END_M} m from the clean run, of {runs_of}", far, "", "<= 0"
            ),
            figure(
                "spoiled", "spoiled drives: worst end, from the clean run", max(row[4] for row in table), "m", "<= 0.3"
            ),
        ),
        (Table(f"Spoiled drives ({', '.join(bases)})", head, tuple(table)),),
        seeds=tuple(seeds),
        notes=("zero stamps hold no time: the right answer is to refuse the log, with the reason",),
    )


@dataclass(frozen=True, slots=True)
class After:
    """A drive from where something is wrong.

    Attributes:
        off: (n, 2) distance from the clean run, m and rad. way: (n,) metres since then. t: (n,) s.
        held: (n,) within the bounds that were published, true without one. bounded: (n,) there is one.
    """

    off: Array
    way: Array
    t: Array
    held: Array
    bounded: Array

    @classmethod
    def of(cls, run: Replayed, whole: Replayed, way: Array) -> After:
        """``way``: (scans,) path length by the odometry of the clean log, m."""
        rows = run.rows[run.rows[:, 1] >= run.begun]
        off = run.off(whole)[run.rows[:, 1] >= run.begun]
        driven = way[rows[:, 0].astype(int)]
        held = ~((off[:, 0] > rows[:, 6]) | (off[:, 1] > rows[:, 7]))
        return cls(off, driven - driven[0], rows[:, 1], held, np.isfinite(rows[:, 6]))

    def way_at(self, t: float) -> float:
        """Metres since then at a time; infinite beyond the end."""
        return float(np.interp(t, self.t, self.way)) if t <= self.t[-1] else math.inf

    def worst(self) -> tuple[float, float]:
        """Largest distance from the clean run, m and deg."""
        return float(np.nanmax(self.off[:, 0])), math.degrees(float(np.nanmax(self.off[:, 1])))


def wheels(work: Work) -> Report:
    """Wheels that are wrong while the laser is good."""
    bases, seeds = [name for name in logs.present() if name in BASES], range(work.trials or DRAWS)
    tasks = [
        Task(name, kind, seed) for kind in WHEELS for name in bases for seed in seeds[: 1 if "%" in kind else None]
    ]
    found = replay(work, tasks, "wheels wrong")
    ways = {name: logs.read(logs.clf(name)).way for name in bases}
    table, bad, beyond, cycles = [], 0, 0, 0
    for kind in WHEELS:
        worst_m = worst_deg = said_m = 0.0
        unsaid, drives = 0, [task for task in tasks if task.kind == kind]
        for task in drives:
            run = found[task]
            after = After.of(run, found[Task(task.log)], ways[task.log])
            metres, degrees = after.worst()
            said = after.way_at(run.named(NAMES_WHEELS, run.begun))
            right = metres <= NEAR_M and math.radians(degrees) <= NEAR_RAD
            worst_m, worst_deg = max(worst_m, metres), max(worst_deg, degrees)
            said_m = max(said_m, 0.0 if right else said)
            unsaid += not right and said > SAID_M
            beyond, cycles = beyond + int((~after.held).sum()), cycles + int(after.bounded.sum())
        table.append((kind, len(drives), worst_m, worst_deg, said_m, unsaid))
        bad += unsaid
    head = ("wheels", "drives", "from the clean run, worst, m", "worst, deg",
            "named after, where not right, worst, m", "neither right nor named")  # fmt: skip
    return Report(
        (
            figure(
                "wheels",
                f"wheels wrong, neither right to 0.3 m / 3 deg nor named within 5 m, of {len(tasks)}",
                bad,
                "",
                "<= 0",
            ),
            figure("wheels", f"wheels wrong: scans beyond their bound, of {cycles}", beyond, ""),
        ),
        (Table(f"Wheels wrong ({', '.join(bases)})", head, tuple(table)),),
        seeds=tuple(seeds),
    )


def mount(work: Work) -> Report:
    """A lidar mount that is turned or displaced against the configured one."""
    bases = [name for name in logs.present() if name in BASES]
    tasks = [Task(name, kind) for kind in (*MOUNTS, *OFFSETS) for name in bases]
    found = replay(work, tasks, "mounts")
    table, late, unnamed, beyond, cycles = [], 0, 0, 0, 0
    read = {name: logs.read(logs.clf(name)) for name in bases}
    for task in tasks:
        run, drive = found[task], read[task.log]
        after = After.of(run, found[Task(task.log)], drive.way)
        metres, degrees = after.worst()
        wide = float(drive.bearings[1] - drive.bearings[0])
        turned = round(math.radians(MOUNTS[task.kind][0]) / wide) * wide if task.kind in MOUNTS else 0.0
        by_then = [one for one in run.mount if one[0] >= run.begun and after.way_at(one[0]) <= LEARNED_M]
        off = math.degrees(abs(by_then[-1][1] - turned)) if by_then else math.inf
        named = after.way_at(run.named((Fault.LIDAR_TURNED,), run.begun))
        if task.kind in MOUNTS:
            late, unnamed = late + (off > 0.5), unnamed + (named > LEARNED_M)
        beyond, cycles = beyond + int((~after.held).sum()), cycles + int(after.bounded.sum())
        said = off if math.isfinite(off) else "no estimate"
        table.append((task.kind, task.log, metres, degrees, said, named if math.isfinite(named) else "not named"))
    turns = len(MOUNTS) * len(bases)
    head = ("mount", "log", "from the clean run, worst, m", "worst, deg", "yaw off after 20 m, deg", "named after, m")
    return Report(
        (
            figure("mount", f"mount turned: yaw not known to 0.5 deg within 20 m, of {turns}", late, "", "<= 0"),
            figure("mount", f"mount turned: not named within 20 m, of {turns}", unnamed, "", "<= 0"),
            figure("mount", f"mount wrong: scans beyond their bound, of {cycles}", beyond, "", "<= 0"),
        ),
        (Table("Mounts turned and displaced", head, tuple(table)),),
        notes=("the bound is held against the clean run, which itself is right to centimetres only",),
    )


def reference(work: Work) -> Report:
    """Real logs against what is known of them: relations found by hand, a corrected trajectory, straight walls."""
    names, root = logs.present(), logs.folder()
    found = replay(work, map(Task, names), "clean drives")
    figures: list[Figure] = []
    relations = root / "intel" / "intel.relations"
    if "intel" in names and relations.is_file():
        figures += _intel(found[Task("intel")], read_relations(relations))
    corrected = root / "keyscans" / "fhw.ref.tum.gz"
    if "fhw" in names and corrected.is_file():
        figures.append(
            figure("reference", "fhw, ATE", _ate(found[Task("fhw")].final, *read_tum(corrected)), "m", "<= 0.3")
        )
    table = []
    for name in (name for name in names if logs.LOGS[name].urg and logs.LOGS[name].wheels):
        single, scans = walls.of_scans(logs.read(logs.clf(name)))
        whole = walls.of_map(found[Task(name)].cells)
        table.append((name, whole, single, scans, abs(whole - single)))
    if table:
        figures.append(figure("reference", "URG-04LX maps: angle of the two longest walls, from that of single scans",
                              max(row[4] for row in table), "deg", "<= 2"))  # fmt: skip
    head = ("log", "angle in the map, deg", "in single scans, median, deg", "scans", "difference, deg")
    return Report(tuple(figures), (Table("Walls of the URG-04LX maps", head, tuple(table)),))


def _intel(run: Replayed, relations: Array) -> list[Figure]:
    assert run.final is not None
    stamps = run.final[:, 0]
    online = np.interp(run.rows[:, 0], np.arange(len(stamps)), stamps)
    made = []
    for name, errors_, limits in (
        ("Intel, final", evaluate(stamps, run.final[:, 1:], relations), ("<= 0.0200", "<= 0.385")),
        (
            "Intel, final, within 30 s",
            evaluate(stamps, run.final[:, 1:], relations).within(30.0),
            ("<= 0.0155", "<= 0.382"),
        ),
        ("Intel, online", evaluate(online, run.rows[:, 2:5], relations), ("<= 0.06", "<= 0.5")),
    ):
        made += [
            figure("reference", f"{name}: relations, translation", float(errors_.translation_m.mean()), "m", limits[0]),
            figure("reference", f"{name}: relations, rotation", float(errors_.rotation_deg.mean()), "deg", limits[1]),
        ]
    return made


def _ate(final: Array | None, stamps: Array, poses: Array) -> float:
    """RMS distance (m) from a reference after the best rigid fit, at its stamps."""
    assert final is not None
    order = np.argsort(final[:, 0], kind="stable")
    t, made = final[order, 0], final[order, 1:]
    nearest = np.clip(np.searchsorted(t, stamps), 1, len(t) - 1)
    nearest -= stamps - t[nearest - 1] < t[nearest] - stamps
    near = np.abs(t[nearest] - stamps) < 0.15
    return errors(fitted(Track(stamps[near], made[nearest[near]], poses[near]))).rmse


def speed(work: Work) -> Report:
    """Log seconds per second of processor time."""
    names = logs.present()
    found = replay(work, map(Task, names), "clean drives")
    table = tuple((name, logs.LOGS[name].lidar, len(found[Task(name)].rows), found[Task(name)].speed) for name in names)
    slowest = min(table, key=lambda row: row[3])
    figures = [figure("speed", f"replay, slowest log ({slowest[0]})", slowest[3], "x real time", ">= 20")]
    figures += [
        figure("speed", "replay of Intel", row[3], "x real time", ">= 150") for row in table if row[0] == "intel"
    ]
    return Report(tuple(figures), (Table("Replay", ("log", "lidar", "scans", "x real time"), table),))
