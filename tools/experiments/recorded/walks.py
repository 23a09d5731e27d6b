"""Public walks under five lamps: strengths once a second straight into the filter, with turn and lean by the IMU.

No odometry: a constant-velocity model with the gyro. Lamps, receiver and delay of the strengths are calibrated on
`circle_level`; the others are followed with that. `circle_level` itself is done two-fold: calibrated on one half of its
time, scored on the other. No run is told where it starts; heading is found from the motion. How far the robot leans
comes from its accelerometer, against its mean at rest (it is level there), a second to either side of the epoch.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from estimator.calibration.calibrate import calibrate_lamps
from estimator.calibration.observations import Rows, model
from estimator.calibration.parameters import Priors
from estimator.cdma.epoch import BlockFlag, LightEpoch
from estimator.light_filter import light_filter
from estimator.light_filter.filter_state import LightsSettings, ModelErrors, MotionErrors
from estimator.light_filter.lambertian import pack_lamps, pack_receiver
from estimator.light_filter.survey import Lamp, Receiver, Survey
from estimator.measurements import Imu
from estimator.result import Fix
from tools.ci.figures import Figure, bounded
from tools.experiments.recorded.vlp import Walk, walk
from tools.experiments.support.report import COMMAND, Picture, Report, Table, Work

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

RECEIVER_Z: Final = 0.31
PRIORS: Final = Priors(gain=3.0, order=0.05, slope=0.01, rx_slope=0.0, rx_order=0.25, lever=0.0, floor=0.01)
"""One circle does not tell the orders of lamps and which way they lean: those stay near what the recorders say."""
LAGS_S: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Delays of the strengths that are tried; the one that calibrates best is taken."""
NOISE: Final = 0.1
"""One sigma of a strength, recorders' unit, as their files say."""
IMU_S: Final = 0.05
LEAN_S: Final = 2.0
REST: Final = 0.1
"""m/s, standard deviation of specific force over a second: below it the robot stands (0.02 at rest, 0.5 driving)."""
SETTINGS: Final = LightsSettings(
    motion=MotionErrors(speed=0.4, acceleration=0.3, sideways=0.03, gyro=0.003, gyro_bias=0.005),
    model=ModelErrors(ln=0.035, floor=0.5, lean=0.05, white=0.02, edge=0.0, fade_m=1.0, common=0.1, tilt=0.02),
    rim_rad=0.2,
)
"""Of a hand-built room without data sheets: the model fits it to 4 % along the path, not to 2 %."""


@dataclass(frozen=True, slots=True)
class Known:
    """What calibration gives. unit: A per recorders' unit. lag: s. scale: of ln strength that is left over."""

    survey: Survey
    unit: float
    lag: float
    scale: float


def nominal(data: Walk) -> Survey:
    """What the recorders say of lamps and receiver."""
    at = zip(data.lamps.tolist(), data.orders.tolist(), strict=True)
    lamps = tuple(Lamp(k + 1, k, *xyz, order=order, sigma_ln=1.0) for k, (xyz, order) in enumerate(at))
    return Survey(lamps, Receiver(z=RECEIVER_Z, half_fov_rad=math.radians(85.0)), floor=0.01)


def places(data: Walk, t: Array) -> Array:
    """(n, 2) true places at (n,) times."""
    return np.column_stack([np.interp(t, data.t, data.truth[:, axis]) for axis in (0, 1)])


def rows_of(data: Walk, which: Mask, unit: float, lag: float) -> Rows:
    """Strengths with the true places of ``lag`` seconds before; only the receiver's place is known, not its heading."""
    K, at = data.rss.shape[1], np.flatnonzero(which)
    pose = np.zeros((len(at) * K, 3))
    pose[:, :2] = np.repeat(places(data, data.t[at] - lag), K, axis=0)
    rss = np.maximum(data.rss[at].ravel(), 0.05)
    lamp = np.tile(np.arange(K), len(at)).astype(np.int64)
    return Rows(pose, lamp, unit * rss, NOISE / rss, np.repeat(data.t[at] - data.t[0], K))


def known(data: Walk, which: Mask) -> Known:
    """Calibrate on some of a walk's instants."""
    survey = nominal(data)
    rows = rows_of(data, which, 1.0, 0.0)
    out, _ = model(pack_lamps(survey.lamps, survey.depth), pack_receiver(survey.receiver), rows.pose, rows.lamp, 0.01)
    unit = float(np.exp(np.median(np.log(out[:, 0] / rows.amplitude))))
    tried = [(calibrate_lamps(survey, rows_of(data, which, unit, lag), PRIORS), lag) for lag in LAGS_S]
    best, lag = min(tried, key=lambda one: float(np.mean(np.minimum((one[0].after / 0.1) ** 2, 4.0))))
    lamps = tuple(replace(lamp, sigma_ln=0.05) for lamp in best.survey.lamps)
    return Known(replace(best.survey, lamps=lamps), unit, lag, best.scale)


def lean(data: Walk, t: Array) -> Array:
    """(n, 2) slopes against those at rest before the robot sets off; zero where it stands."""
    slopes = data.imu.lean(t, LEAN_S)
    begin = data.imu.lean(data.t[:10], LEAN_S).mean(axis=0)
    return np.where(moving(data, t)[:, None], slopes - begin, 0.0)


def moving(data: Walk, t: Array) -> Mask:
    """Whether the robot moves at (n,) times, by the accelerometer alone."""
    out = np.zeros(len(t), bool)
    step = float(np.median(np.diff(data.imu.t)))
    for i, now in enumerate(t.tolist()):
        low, high = np.searchsorted(data.imu.t, (now - 0.5, now + 0.5))
        part = data.imu.velocity[low : max(int(high), int(low) + 2), :2] / step
        out[i] = bool(np.hypot(*part.std(axis=0)) > REST)
    return out


def follow(data: Walk, what: Known, which: Mask, with_lean: bool = True) -> Array:
    """(n, 8) rows: t, estimated x, y, true x, y, sigma (m), GOOD or not, heading known or not."""
    filter_ = light_filter.new_lights(what.survey, SETTINGS)
    times = data.t[which]
    slopes = lean(data, times - what.lag) if with_lean else np.zeros((len(times), 2))
    rows, t0 = [], float(times[0] - 1.0)
    now = t0
    for k, t in enumerate(times.tolist()):
        true_t = t - what.lag
        while now + IMU_S <= true_t:
            turn = np.diff(data.imu.yaw(np.array((now, now + IMU_S))))[0]
            light_filter.predict(filter_, Imu(now, now + IMU_S, float(turn)))
            now += IMU_S
        light_filter.lean(filter_, *slopes[k].tolist())
        result = light_filter.update(filter_, epoch(data, what, int(np.flatnonzero(data.t == t)[0])))
        true = places(data, np.array([result.t_pose]))[0]
        sigma = math.sqrt(float(result.covariance[0, 0] + result.covariance[1, 1]))
        done = result.fix not in (Fix.NONE, Fix.LOST)
        good = result.fix in (Fix.GOOD, Fix.HELD)
        rows.append((result.t_pose, *result.T_map_base[:2], *true, sigma, float(done), float(good)))
    return np.array(rows)


def epoch(data: Walk, what: Known, k: int) -> LightEpoch:
    """One second's strengths as the decoder would report them."""
    t, n = float(data.t[k]) - what.lag, data.rss.shape[1]
    amplitude = what.unit * np.maximum(data.rss[k], 0.01)
    return LightEpoch(
        t - 0.025, t + 0.025, np.arange(n), amplitude, np.full(n, (what.unit * NOISE) ** 2), np.zeros(n, np.int64),
        (None,) * n, BlockFlag.NONE, what.unit * NOISE, None,
    )  # fmt: skip


def errors(rows: Array) -> Array:
    """(m,) cm, wherever there is a fix."""
    some = rows[rows[:, 6] > 0.0]
    return np.asarray(100.0 * np.hypot(some[:, 1] - some[:, 3], some[:, 2] - some[:, 4]))


def two_fold(data: Walk) -> Array:
    """Each half followed with what the other half taught."""
    first = np.arange(len(data.t)) < len(data.t) // 2
    return np.vstack([follow(data, known(data, ~part), part) for part in (first, ~first)])


def run(quick: bool, work: Work) -> Report:
    """All three walks; with ``quick`` the two-fold one is left out."""
    level = walk("circle_level")
    what = known(level, np.ones(len(level.t), bool))
    traces = {}
    for name in ("circle_inclined10", "square_blocked"):
        data = walk(name)
        traces[name] = follow(data, what, np.ones(len(data.t), bool))
    inclined = walk("circle_inclined10")
    traces["circle_inclined10, lean not used"] = follow(inclined, what, np.ones(len(inclined.t), bool), False)
    if not quick:
        traces["circle_level, two-fold"] = two_fold(level)
    rows = tuple(row_of(name, rows) for name, rows in traces.items())
    command = f"{COMMAND} walks"
    figures = [
        bounded("walk inclined: mean error", float(errors(traces["circle_inclined10"]).mean()), "cm", "<= 12", command),
        bounded(
            "walk blocked: p90 error",
            float(np.percentile(errors(traces["square_blocked"]), 90)),
            "cm",
            "<= 20",
            command,
        ),
    ]
    if not quick:
        mean = float(errors(traces["circle_level, two-fold"]).mean())
        figures += [bounded("walk level, two-fold: mean error", mean, "cm", "<= 8", command)]
    figures += [Figure("walks: what calibration leaves over", 100.0 * what.scale, "% of strength", command=command)]
    notes = (
        "the settings of filter and calibration were chosen with these three walks in view; there are no others",
        f"strengths lag behind the truth by {what.lag:g} s (found by the calibration)",
    )
    return Report(
        tuple(figures),
        (Table("Public walks, strengths at 1 Hz, cm", HEAD, rows),),
        (Picture("walks", lambda canvas: draw(canvas, traces)),),
        (),
        notes,
    )


HEAD: Final = ("walk", "instants", "with a fix", "mean", "median", "p90", "max", "mean 2 sigma")


def row_of(name: str, rows: Array) -> tuple[str | float | int, ...]:
    """A line of the table."""
    e = errors(rows)
    sigma = 200.0 * float(rows[rows[:, 6] > 0.0, 5].mean())
    parts = (float(e.mean()), float(np.median(e)), float(np.percentile(e, 90)), float(e.max()), sigma)
    return (name, len(rows), float(rows[:, 6].mean()), *parts)


def draw(canvas: Any, traces: dict[str, Array]) -> None:
    """True and estimated paths."""
    axes = canvas.subplots(1, len(traces), squeeze=False)[0]
    for one, (name, rows) in zip(axes, traces.items(), strict=True):
        some = rows[rows[:, 6] > 0.0]
        one.plot(rows[:, 3], rows[:, 4], "k-", lw=0.8, label="true path")
        one.plot(some[:, 1], some[:, 2], "r.-", lw=0.5, ms=3, label="estimated path, one fix a second")
        one.set_title(name, fontsize=7)
        one.set(aspect="equal", xlabel="x, m")
    axes[0].set_ylabel("y, m")
    canvas.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
