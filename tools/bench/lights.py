"""The `lights` filter: time of one update with 16 links in use, kernels alone and the whole call."""

import statistics
import time
from collections.abc import Iterator
from typing import Final

import numpy as np

from estimator.cdma.epoch import BlockFlag, LightEpoch
from estimator.light_filter import light_filter, measurement_update
from estimator.light_filter.lambertian import expected
from estimator.light_filter.link_association import sights
from estimator.light_filter.link_gating import table, view_of
from estimator.light_filter.survey import Lamp, Receiver, Survey
from estimator.measurements import Array, Odometry
from estimator.numerics import se2
from estimator.result import Fix
from tools.ci.figures import Figure, bounded

COMMAND: Final = "python -m tools.bench lights"
LAMPS: Final = tuple(Lamp(k + 1, k, 3.0 + 1.2 * (k % 4), 3.0 + 1.2 * (k // 4), 2.9) for k in range(16))
"""Sixteen lamps so close that all of them are in view from below their middle."""
SURVEY: Final = Survey(LAMPS, Receiver())
EPOCH_S: Final = 0.05


def drive(seconds: float) -> Iterator[tuple[Odometry, LightEpoch]]:
    """A round drive of 0.4 m radius at 0.3 m/s, one odometry increment per epoch, 0.2 % of noise."""
    rng = np.random.default_rng(0)
    before = _circle(0.0)
    for k in range(1, round(seconds / EPOCH_S)):
        t = k * EPOCH_S
        pose = _circle(t)
        strength = expected(LAMPS, SURVEY, pose).amplitude * (1.0 + 0.002 * rng.standard_normal(16))
        epoch = LightEpoch(
            t - EPOCH_S, t, np.arange(16), strength, np.full(16, 2.5e-19), np.zeros(16, np.int64), (None,) * 16,
            BlockFlag.NONE, 1e-9, 0.0,
        )  # fmt: skip
        yield Odometry(t - EPOCH_S, t, se2.between(before, pose)), epoch
        before = pose


def _circle(t: float) -> Array:
    a = 0.3 * t / 0.4
    return np.array((4.8 + 0.4 * np.cos(a), 4.8 + 0.4 * np.sin(a), se2.wrap(a + 0.5 * np.pi)))


def run() -> list[Figure]:
    """Drive until all is settled, then time every update.

    Raises:
        RuntimeError: the filter has not found its place; its figures would mean nothing.
    """
    filter_ = light_filter.new_lights(SURVEY)
    whole, kernels, used = [], [], []
    for k, (odometry, epoch) in enumerate(drive(60.0)):
        light_filter.predict(filter_, odometry)
        if k * EPOCH_S > 30.0:
            count, seconds = _kernels(filter_, epoch)
            used.append(count)
            kernels.append(seconds)
        begin = time.perf_counter()
        result = light_filter.update(filter_, epoch)
        if k * EPOCH_S > 30.0:
            whole.append(time.perf_counter() - begin)
    if result.fix is not Fix.GOOD:
        raise RuntimeError(f"the filter says {result.fix}")
    links = statistics.median(used)
    return [
        Figure("links in one update", links, "", command=COMMAND),
        Figure("elements of the state", filter_.tracks[0].n, "", command=COMMAND),
        bounded("EKF update (Eq. 5-7, compiled), median", 1e6 * statistics.median(kernels), "us", "<= 50", COMMAND),
        Figure("EKF update, best", 1e6 * min(kernels), "us", command=COMMAND),
        Figure("whole call with choice of lamps, gates and result, median", 1e6 * statistics.median(whole), "us",
               command=COMMAND),
    ]  # fmt: skip


def _kernels(filter_: light_filter.Lights, epoch: LightEpoch) -> tuple[int, float]:
    """Links, and seconds to compare them with the state and to take them in, on copies."""
    track = filter_.tracks[0]
    kept, rows = table(filter_, track, sights(filter_, epoch, float(track.x[0]), float(track.x[1])))
    out = np.zeros((len(kept), measurement_update.OUT_COLUMNS))
    view = view_of(filter_, np.zeros(3))

    times = []
    for _ in range(5):
        x, around, P = track.x.copy(), track.x.copy(), track.P.copy()
        begin = time.perf_counter()
        measurement_update.linearise(x, P, rows, track.lamps, view, out)
        measurement_update.absorb(x, P, track.n, around, rows, out)
        times.append(time.perf_counter() - begin)
    return len(kept), min(times)
