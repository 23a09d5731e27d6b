"""Single positions under a simulated ceiling: what is received at many places, and how far solvers are off there."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.light_filter.survey import Survey
from estimator.paper.lateration import Prior, Received, SolverSettings, locate
from tools.sim.ceiling.ceiling import Ceiling, Photodiode
from tools.sim.ceiling.links import EPOCH_S, Reception
from tools.sim.ceiling.records import survey

Array = npt.NDArray[np.float64]

CENTRED: Final = Photodiode(x=0.0, y=0.0)
"""On the robot's axis: single positions know no heading, so a lever arm could not be taken off."""


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """One place: ``xy`` (2,) truly, and what is received there of the lamps that shine on the receiver directly."""

    xy: Array
    received: Received


def spots(ceiling: Ceiling, sheet: Survey, at: Array, rng: np.random.Generator, beyond: bool = False) -> list[Spot]:
    """What one epoch of the decoder gives at places ``at`` (n, 2); ``beyond``: also of lamps out of view."""
    poses = np.column_stack((at, np.zeros(len(at))))
    t = np.zeros(len(at))
    amplitude = ceiling.amplitudes(poses, t)
    bare = replace(ceiling.effects, bounces=0, floor=0.0)
    straight = replace(ceiling, effects=bare).amplitudes(poses, t)
    reception = Reception()
    noise = np.array([reception.sample_noise(float(row.sum()) / ceiling.depth) for row in amplitude])
    sigma = noise / np.sqrt(EPOCH_S * reception.rate_hz * reception.efficiency)
    measured = amplitude + sigma[:, None] * rng.standard_normal(amplitude.shape)
    made = []
    for xy, row, direct, s in zip(at, measured, straight, sigma, strict=True):
        heard = (row > 8.0 * s) & (np.ones_like(row, dtype=bool) if beyond else direct > 0.0)
        which = np.flatnonzero(heard)
        lamps = tuple(sheet.lamps[i] for i in which)
        made.append(Spot(xy, Received(lamps, row[which], np.full(len(which), s * s))))
    return made


def sheet_of(ceiling: Ceiling, sigma_ln: float) -> Survey:
    """The survey that the plan gives, with that much trust in each lamp's power."""
    plain = survey(ceiling)
    return replace(plain, lamps=tuple(replace(lamp, sigma_ln=sigma_ln) for lamp in plain.lamps))


def error(spot: Spot, sheet: Survey, method: SolverSettings, prior: Prior | None = None) -> float:
    """Distance from the truth, m; NaN where there is no place at all (fewer than two links)."""
    found = locate(spot.received, sheet, method, prior)
    return float(np.hypot(*(found.places[0].xy - spot.xy))) if found.places else float("nan")


def grid(x: tuple[float, float], y: tuple[float, float], pitch: float) -> Array:
    """(n, 2) places, half a pitch from the sides."""
    nx, ny = (max(round((b - a) / pitch), 1) for a, b in (x, y))
    gx, gy = np.meshgrid(
        x[0] + (np.arange(nx) + 0.5) * (x[1] - x[0]) / nx, y[0] + (np.arange(ny) + 0.5) * (y[1] - y[0]) / ny
    )
    return np.column_stack((gx.ravel(), gy.ravel()))
