"""Lamps located by a drive: 16 lamps over the paper's room, one drive of 160 m, every effect of the simulator on.

The robot knows nothing of the lamps but that they hang 2.9 m up (and, in a second run, not even that). Its poses are
those of a laser SLAM: the true ones with slow errors of 1 cm and 0.25 degrees (rms). Places are compared with where the
lamps truly hang, in the same frame; no alignment is done.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from estimator.calibration.lamp_mapping import Heard, Surveyed
from estimator.calibration.lamp_mapping import survey as survey_by_drive
from estimator.calibration.observations import Rows
from tools.ci.figures import bounded
from tools.experiments.support.report import COMMAND, Picture, Report, Table, Work
from tools.sim.light.link_drive import LightRun, room_run

Array = npt.NDArray[np.float64]

SEEDS: Final = (0, 1, 2, 3, 4, 5)
SLAM_M: Final = 0.01
SLAM_RAD: Final = np.radians(0.25)
PERIODS_S: Final = (11.0, 23.0, 47.0, 90.0)
HEIGHT_M: Final = 2.9


def heard(run: LightRun, seed: int, every: int = 1) -> Heard:
    """What the decoder reported along the drive, with the poses of a laser SLAM; ``every``-th epoch only."""
    parts = []
    for epoch in list(run.light())[::every]:
        good = (epoch.flags == 0) & (epoch.amplitude > 0.0)
        t = np.full(int(good.sum()), 0.5 * (epoch.t_begin + epoch.t_end))
        sigma = np.sqrt(epoch.variance[good]) / epoch.amplitude[good]
        parts.append(np.column_stack((t, epoch.ids[good], epoch.amplitude[good], sigma)))
    t, code, amplitude, sigma = np.concatenate(parts).T
    phase = np.random.default_rng((seed, 5)).uniform(0.0, 2.0 * np.pi, (3, len(PERIODS_S)))
    waves = np.sin(2.0 * np.pi * t[:, None, None] / np.array(PERIODS_S) + phase).sum(axis=2)
    error = np.sqrt(2.0 / len(PERIODS_S)) * waves * np.array((SLAM_M, SLAM_M, SLAM_RAD))
    rows = Rows(run.truth(t) + error, code.astype(np.int64), amplitude, sigma, t)
    return Heard(rows, np.full(len(t), -1, dtype=np.int64))


def trial(job: tuple[int, float | None, int]) -> Array:
    """(lamps, 7): true x, y, z; found x, y, z; one sigma of the place (m)."""
    seed, height, every = job
    run = room_run(seed=seed)
    result = survey_by_drive(heard(run, seed, every), run.survey.receiver, run.survey.depth, height)
    return compared(run, result)


def compared(run: LightRun, result: Surveyed) -> Array:
    """See :func:`trial`; raises ValueError unless exactly the lamps of the room were found."""
    truth = {fixture.code: run.ceiling.placed[k] for k, fixture in enumerate(run.ceiling.fixtures)}
    found = {lamp.code: (lamp.x, lamp.y, lamp.z) for lamp in result.found.survey.lamps}
    if set(found) != set(truth) or len(result.found.survey.lamps) != len(truth):
        raise ValueError(f"{len(found)} codes found, {len(truth)} lamps hang there")
    sigma = {
        lamp.code: float(np.hypot(*s[:2])) for lamp, s in zip(result.found.survey.lamps, result.sigma, strict=True)
    }
    return np.array([(*truth[code], *found[code], sigma[code]) for code in sorted(truth)])


def run(quick: bool, work: Work) -> Report:
    """All seeds with the height given, and without."""
    seeds, every = (SEEDS[:1], 10) if quick else (SEEDS, 1)
    jobs = [(seed, height, every) for height in (HEIGHT_M, None) for seed in seeds]
    results = work.map(trial, jobs, "drives")
    rows = tuple(_row(job, result) for job, result in zip(jobs, results, strict=True))
    given, free = (np.concatenate(results[i : i + len(seeds)]) for i in (0, len(seeds)))
    figures = [
        bounded(
            f"lamps located, height {name}, median of all", float(np.median(distance(table))), "m", target, _COMMAND
        )
        for name, table, target in (("given", given, "<= 0.05"), ("free", free, "<= 0.05"))
    ]
    figures += [
        bounded("height found, largest error", float(np.abs(free[:, 5] - free[:, 2]).max()), "m", "<= 0.15", _COMMAND)
    ]
    head = ("drive", "median cm", "p90 cm", "largest cm", "error / sigma", "height error cm")
    return Report(
        figures=tuple(figures),
        tables=(Table("16 lamps located by a drive of 160 m", head, rows),),
        pictures=(Picture("survey", lambda canvas: _draw(canvas, results[0]), (6.0, 6.0)),),
        seeds=tuple(seeds),
        notes=("Lamps at walls are found worst: light by way of the wall shifts what is received of them.",),
    )


_COMMAND: Final = f"{COMMAND} survey"


def distance(table: Array) -> Array:
    """(n,) how far beside the truth each lamp was found, in the plane, m."""
    apart: Array = np.hypot(table[:, 3] - table[:, 0], table[:, 4] - table[:, 1])
    return apart


def _row(job: tuple[int, float | None, int], table: Array) -> tuple[str | float, ...]:
    e = 100.0 * distance(table)
    share = float(np.sqrt(np.mean((0.01 * e / table[:, 6]) ** 2)))
    height = float(100.0 * np.mean(table[:, 5] - table[:, 2]))
    name = f"seed {job[0]}, height {'given' if job[1] else 'free'}"
    return (name, float(np.median(e)), float(np.percentile(e, 90)), float(e.max()), share, height)


def _draw(canvas: Any, table: Array) -> None:
    axes = canvas.add_subplot()
    axes.plot(table[:, 0], table[:, 1], "k+", markersize=12, label="true position of a lamp")
    axes.plot(table[:, 3], table[:, 4], "o", fillstyle="none", label="found position, and its error")
    for row in table:
        off = f"{100.0 * float(np.hypot(row[3] - row[0], row[4] - row[1])):.1f} cm"
        axes.annotate(off, row[:2], (0, -12), textcoords="offset points", fontsize=7, ha="center", va="top")
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.margins(0.08)
    canvas.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
