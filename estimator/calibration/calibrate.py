"""Calibration from a drive: what each lamp really sends and how the receiver looks, with uncertainties.

In go poses of the robot and the strengths received there; out comes the survey with gains, Lambert orders, slopes, the
diffuse share, the receiver's order, lean and lever arm. What the drive cannot tell keeps its value and is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.calibration.observations import Rows, joined, thinned
from estimator.calibration.parameters import COMMONS, OWNS, Common, Own, Priors, Problem, linear, problem, survey_at
from estimator.calibration.robust_solver import Solution, solve
from estimator.light_filter.survey import Survey
from estimator.numerics.arrays import Array

TOLD: Final = 0.7
"""A parameter is told by the drive if its sigma fell below this part of its prior's."""
PRIORS: Final = Priors()
FEWEST_ROWS: Final = 30
FEWEST_OF_A_LAMP: Final = 6

_UNITS: Final = {"gain": "ln", "floor": "", "order": "", "slope": "m/m", "frame_yaw": "rad"}


class TooLittle(ValueError):
    """The drive does not hold enough to calibrate anything; the text says what is missing."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter.

    Attributes:
        lamp_id: of whose lamp, None for one common to all. name: as in the survey. unit: of all values.
        before, after: value. sigma: one sigma afterwards; prior: one sigma before. told: whether the drive told it.
    """

    lamp_id: int | None
    name: str
    unit: str
    before: float
    after: float
    sigma: float
    prior: float

    @property
    def told(self) -> bool:
        """Whether the drive says more about it than was known before."""
        return self.sigma < TOLD * self.prior


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """A calibration.

    Attributes:
        survey: with the new values. estimates: every parameter that was free.
        rows: what was used (thinned). used: (n,) which of them were not left out.
        before, after: (n,) residuals ln(received / expected). T_survey_drive: (x, y, yaw) of the drive's frame.
        scale: one sigma of ln strength that the model leaves unexplained. untouched: lamp IDs with too few strengths.
        covariance: (p, p) of all parameters, in the order of `estimator.calibration.parameters`.
    """

    survey: Survey
    estimates: tuple[Estimate, ...]
    rows: Rows
    used: npt.NDArray[np.bool_]
    before: Array
    after: Array
    T_survey_drive: Array
    scale: float
    untouched: tuple[int, ...]
    covariance: Array
    converged: bool

    def rms(self) -> tuple[float, float]:
        """RMS of ln strength over the rows used, before and after."""
        first, last = (float(np.sqrt(np.mean(r[self.used] ** 2))) for r in (self.before, self.after))
        return first, last


def calibrate_lamps(survey: Survey, rows: Rows, priors: Priors = PRIORS, start: Array | None = None) -> Calibrated:
    """Fit a survey to a drive.

    Args:
        survey: as known before; ``rows.lamp`` counts its lamps.
        rows: strengths with poses; thinned here.
        priors: how well the survey was known.
        start: (x, y, yaw) of the drive's frame in the survey's, where priors let that be found.

    Raises:
        TooLittle: fewer than 30 strengths in plain view, or no lamp with six.
    """
    return _fitted(survey, thinned(rows), priors, start)


def calibrate_from(survey: Survey, parts: Sequence[Rows], priors: Priors) -> Calibrated:
    """The same from rows that are thinned already, in parts; raises `TooLittle`."""
    return _fitted(survey, joined(parts), priors, None)


def _fitted(survey: Survey, rows: Rows, priors: Priors, start: Array | None) -> Calibrated:
    task = problem(survey, priors)
    if start is not None:
        task.before[Common.FRAME_X : Common.FRAME_YAW + 1] = start
    begin = linear(task, rows, task.before)
    if len(rows) < FEWEST_ROWS or int(begin.seen.sum()) < FEWEST_ROWS:
        raise TooLittle(f"only {int(begin.seen.sum())} places with a lamp in plain view; at least {FEWEST_ROWS} needed")
    counts = np.bincount(rows.lamp[begin.seen], minlength=len(survey.lamps))
    if counts.max() < FEWEST_OF_A_LAMP:
        raise TooLittle(f"no lamp was seen from {FEWEST_OF_A_LAMP} places; drive under the lamps, 0.5 m apart")
    found = solve(task, rows)
    return _calibrated(task, rows, begin.residual, found)


def _calibrated(task: Problem, rows: Rows, before: Array, found: Solution) -> Calibrated:
    counts = np.bincount(rows.lamp[found.used], minlength=len(task.lamps))
    untouched = tuple(lamp.lamp_id for lamp, n in zip(task.survey.lamps, counts, strict=True) if n < FEWEST_OF_A_LAMP)
    return Calibrated(
        survey=survey_at(task, found.theta, sigma_power(task, found)),
        estimates=estimates(task, found),
        rows=rows,
        used=found.used,
        before=before,
        after=found.residual,
        T_survey_drive=found.theta[Common.FRAME_X : Common.FRAME_YAW + 1].copy(),
        scale=found.scale,
        untouched=untouched,
        covariance=found.covariance,
        converged=found.converged,
    )


def sigma_power(task: Problem, found: Solution) -> Array:
    """(K,) one sigma of ln power of each lamp, the common part included; the prior's for a lamp taken as given."""
    P, common = found.covariance, int(Common.GAIN)
    own = np.array([task.own(k).start + int(Own.GAIN) for k in range(len(task.lamps))], dtype=np.int64)
    variance = P[own, own] + P[common, common] + 2.0 * P[own, common]
    prior = np.array([lamp.sigma_ln for lamp in task.survey.lamps])
    result: Array = np.where(task.prior[own] > 0.0, np.sqrt(np.maximum(variance, 1e-6)), prior)
    return result


def estimates(task: Problem, found: Solution) -> tuple[Estimate, ...]:
    """Every free parameter, common ones first."""
    names: list[tuple[int | None, str]] = [(None, c.name.lower()) for c in Common]
    names += [(lamp.lamp_id, o.name.lower()) for lamp in task.survey.lamps for o in Own]
    assert len(names) == COMMONS + OWNS * len(task.lamps)
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    columns = (v.tolist() for v in (task.before, found.theta, sigma, task.prior))
    rows = list(zip(names, *columns, strict=True))
    some = [rows[k] for k in task.free.tolist()]
    return tuple(Estimate(lamp, name, _unit(name), b, a, s, prior) for (lamp, name), b, a, s, prior in some)


def _unit(name: str) -> str:
    for part, unit in _UNITS.items():
        if part in name:
            return unit
    return "m"
