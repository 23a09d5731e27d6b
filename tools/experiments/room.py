"""The paper's room with all effects on: how well odometry and lamps alone keep position and heading.

10 x 10 m, 16 lamps of Table 1, walls of reflectance 0.5, diffuse floor that varies by half, emission tables that are
not Lambertian, lamps and receiver that lean, people and columns in the way, wheels whose dead reckoning ends 1.5 m off
after 160 m. Nothing starts from the truth: the filter begins by itself and is scored from 30 s on (60 s where gains are
15 % off). Position is scored where the robot is at least 1 m from the walls, and everywhere.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from estimator.calibration.calibrate import calibrate_lamps
from estimator.calibration.observations import Rows
from estimator.calibration.parameters import Priors
from estimator.calibration.residual_map_fit import learn
from estimator.light_filter import light_filter
from estimator.light_filter.filter_state import LightsSettings
from estimator.light_filter.residual_lookup import ResidualCorrections
from estimator.measurements import LightEpoch, Odometry
from estimator.result import Fix
from tools.ci.figures import Figure, bounded
from tools.experiments.support.report import COMMAND, Picture, Report, Table, Work
from tools.sim.ceiling.ceiling import Effects
from tools.sim.light.link_drive import ROOM_BODY, LightRun, room_run
from tools.sim.robot.drive import Drive, Route

Array = npt.NDArray[np.float64]

SEEDS: Final = (1, 2, 3, 4, 5, 6)
HALF_M: Final = 5.0
TEACH_ROUTE: Final = Route(
    tuple((sign * x, y) for y in (-4.4, -3.2, -2.0, -0.8, 0.4, 1.6, 2.8, 4.0) for sign, x in ((-1, 4.3), (1, 4.3)))
    + tuple((x, sign * 4.3) for x in (3.4, 2.0, 0.6, -0.8, -2.2, -3.6) for sign in (1, -1)),
    1.0,
)
"""Another drive than the one that is scored: up and down, then across."""
TEACH_SIGMA_M: Final = 0.01
"""What laser SLAM knows its own pose by."""


@dataclass(frozen=True, slots=True)
class Case:
    """One condition.

    Attributes:
        effects: of the ceiling. odometry: whether the wheels are read. taught: calibrated, with a residual map, from
            an earlier drive. from_s: when scoring begins.
    """

    name: str
    effects: Effects
    odometry: bool = True
    taught: bool = False
    from_s: float = 30.0


CASES: Final = (
    Case("gains 5 % off", Effects()),
    Case("gains 15 % off", Effects(gain_spread=0.15), from_s=60.0),
    Case("ageing 10 %", Effects(ageing=0.10)),
    Case("no odometry", Effects(), odometry=False),
    Case("residual map", Effects(), taught=True),
)


@dataclass(frozen=True, slots=True)
class Score:
    """What one run came to; lengths in cm, angles in degrees.

    Attributes:
        start_s: first GOOD. rmse, p95: at least 1 m from walls; rmse_all, p95_all: everywhere. heading: RMS.
        nees: mean, 3 degrees of freedom. covered: share of positions inside the 95 % ellipse. good: share of GOOD.
    """

    start_s: float
    rmse: float
    p95: float
    rmse_all: float
    p95_all: float
    heading: float
    nees: float
    covered: float
    good: float


def trace(run: LightRun, case: Case, settings: LightsSettings, seconds: float) -> Array:
    """(n, 10) rows: t, error x, y, yaw, true x, y, GOOD or not, NEES of pose, NIS of position, sigma of position."""
    survey, corrections = run.survey, None
    if case.taught:
        survey, corrections = taught(run)
    filter_ = light_filter.new_lights(survey, settings, corrections)
    rows = []
    for record in run.records():
        if record.t_end > seconds:
            break
        if isinstance(record, Odometry):
            if case.odometry:
                light_filter.predict(filter_, record)
            continue
        result = light_filter.update(filter_, replace(record, lamps=(None,) * len(record.ids)))
        true = run.truth(np.array([result.t_pose]))[0]
        off = result.T_map_base - true
        off[2] = (off[2] + np.pi) % (2.0 * np.pi) - np.pi
        P = result.covariance + 1e-12 * np.eye(3)
        nees, nis = float(off @ np.linalg.solve(P, off)), float(off[:2] @ np.linalg.solve(P[:2, :2], off[:2]))
        good, sigma = float(result.fix is Fix.GOOD), float(np.sqrt(P[0, 0] + P[1, 1]))
        rows.append((result.t_pose, *off, *true[:2], good, nees, nis, sigma))
    return np.array(rows)


def taught(run: LightRun) -> tuple[Any, ResidualCorrections]:
    """Calibration and residual map of the same ceiling from another drive, poses by laser."""
    drive = Drive(TEACH_ROUTE, ROOM_BODY, 2.0, 1)
    other = replace(run, drive=drive, seconds=drive.lap_s)
    rng = np.random.default_rng((run.seed, 11))
    index = {lamp.code: k for k, lamp in enumerate(run.survey.lamps)}
    parts = [rows_of(epoch, other, index, rng) for n, epoch in enumerate(other.light()) if n % 3 == 0]
    pose, lamp, amplitude, sigma, t = (np.concatenate(field) for field in zip(*parts, strict=True))
    rows = Rows(pose, lamp.astype(np.int64), amplitude, sigma, t)
    found = calibrate_lamps(run.survey, rows, Priors(lever=0.0))
    survey = replace(found.survey, lamps=tuple(replace(lamp, sigma_ln=0.03) for lamp in found.survey.lamps))
    return survey, ResidualCorrections(learn(found.survey, found.rows.chosen(found.used)), survey.receiver)


def rows_of(
    epoch: LightEpoch, run: LightRun, index: dict[int, int], rng: np.random.Generator
) -> tuple[Array, Array, Array, Array, Array]:
    """Pose, lamp, strength, noise and instant of an epoch's links."""
    t = 0.5 * (epoch.t_begin + epoch.t_end)
    some = epoch.amplitude > 20.0 * np.sqrt(epoch.variance)
    n = int(some.sum())
    pose = run.truth(np.array([t]))[0] + np.array((TEACH_SIGMA_M, TEACH_SIGMA_M, 0.003)) * rng.standard_normal(3)
    lamp = np.array([index[code] for code in epoch.ids[some].tolist()], dtype=np.float64)
    sigma = np.sqrt(epoch.variance[some]) / epoch.amplitude[some]
    return np.tile(pose, (n, 1)), lamp, epoch.amplitude[some], sigma, np.full(n, t)


def score(rows: Array, from_s: float) -> Score:
    """What a trace amounts to."""
    good = rows[rows[:, 6] > 0.0]
    part = rows[rows[:, 0] >= from_s]
    way = np.hypot(part[:, 1], part[:, 2])
    inner = way[np.abs(part[:, 4:6]).max(axis=1) < HALF_M - 1.0]
    return Score(
        start_s=float(good[0, 0]) if len(good) else float("inf"),
        rmse=100.0 * float(np.sqrt(np.mean(inner**2))),
        p95=100.0 * float(np.percentile(inner, 95)),
        rmse_all=100.0 * float(np.sqrt(np.mean(way**2))),
        p95_all=100.0 * float(np.percentile(way, 95)),
        heading=float(np.degrees(np.sqrt(np.mean(part[:, 3] ** 2)))),
        nees=float(np.mean(part[:, 7])),
        covered=float(np.mean(part[:, 8] < 5.991)),
        good=float(np.mean(part[:, 6])),
    )


def trial(task: tuple[Case, int, float]) -> tuple[Score, Array]:
    """One run of one case."""
    case, seed, seconds = task
    run = room_run(case.effects, seed)
    rows = trace(run, case, LightsSettings(), min(seconds, run.seconds))
    return score(rows, min(case.from_s, 0.5 * seconds)), rows


def run(quick: bool, work: Work) -> Report:
    """All cases over all seeds; with ``quick`` one seed of one case for 15 s."""
    seeds, seconds = (SEEDS[:1], 15.0) if quick else (SEEDS, float("inf"))
    cases = CASES[:1] if quick else CASES
    done = work.map(trial, [(case, seed, seconds) for case in cases for seed in seeds], "room")
    rows, figures = [], []
    for n, case in enumerate(cases):
        scores = [item[0] for item in done[n * len(seeds) : (n + 1) * len(seeds)]]
        rows += [row_of(f"{case.name}, seed {seed}", one) for seed, one in zip(seeds, scores, strict=True)]
        figures += figures_of(case, scores)
    return Report(
        tuple(figures),
        (Table("Paper's room, odometry and lamps; cm, degrees", HEAD, tuple(rows)),),
        (Picture("room", lambda canvas: draw(canvas, done[0][1])),),
        tuple(seeds),
        ("position within 1 m of the walls is in the columns 'all'; dead reckoning alone ends 1.5 m off",),
    )


HEAD: Final = ("case", "start s", "rmse", "p95", "rmse all", "p95 all", "heading", "NEES", "in ellipse", "GOOD")


def row_of(name: str, one: Score) -> tuple[str | float, ...]:
    """A line of the table."""
    return (
        name, one.start_s, one.rmse, one.p95, one.rmse_all, one.p95_all, one.heading, one.nees, one.covered, one.good,
    )  # fmt: skip


def figures_of(case: Case, scores: list[Score]) -> list[Figure]:
    """Worst over the seeds for errors, mean over them for consistency."""
    command, name = f"{COMMAND} room", f"room, {case.name}: "
    worst = {key: max(getattr(s, key) for s in scores) for key in ("rmse", "p95", "rmse_all", "heading", "start_s")}
    nees, covered = (float(np.mean([getattr(s, key) for s in scores])) for key in ("nees", "covered"))
    if not case.odometry or case.taught:
        return [
            Figure(name + "RMSE, worst seed", worst["rmse"], "cm", command=command),
            Figure(name + "RMSE everywhere, worst seed", worst["rmse_all"], "cm", command=command),
            Figure(name + "mean NEES", nees, "", command=command),
        ]
    bound = "<= 6" if "ageing" in case.name else "<= 5"
    out = [bounded(name + "RMSE, worst seed", worst["rmse"], "cm", bound, command)]
    if "ageing" not in case.name:
        out += [bounded(name + "p95, worst seed", worst["p95"], "cm", "<= 9", command)]
    return [
        *out,
        Figure(name + "RMSE everywhere, worst seed", worst["rmse_all"], "cm", command=command),
        bounded(name + "heading RMS, worst seed", worst["heading"], "deg", "<= 1.5", command),
        bounded(name + "mean NEES (3)", nees, "", "<= 5", command),
        bounded(name + "mean NEES (3), not too careful", nees, "", ">= 2", command),
        bounded(name + "in 95 % ellipse, mean", covered, "", ">= 0.9", command),
        Figure(name + "time to GOOD, worst seed", worst["start_s"], "s", command=command),
    ]


def draw(canvas: Any, rows: Array) -> None:
    """Error and two sigma over time."""
    axes = canvas.subplots()
    t, way = rows[:, 0], 100.0 * np.hypot(rows[:, 1], rows[:, 2])
    axes.plot(t, way, lw=0.8, label="position error")
    axes.plot(t, 200.0 * rows[:, 9], lw=0.8, label="published 2 sigma")
    axes.set(
        xlabel="time, s",
        ylabel="position error, cm",
        ylim=(0, 30),
        title="The paper's room: odometry and lamps, no laser",
    )
    axes.legend()
