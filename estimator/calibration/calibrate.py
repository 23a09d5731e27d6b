"""Calibration of lamps and receiver from a drive: fits the lamp survey to RSS received at known poses.

Input: poses of the robot and the RSS received there. Output: the survey with gain, Lambert order and tilt of each lamp
and the diffuse floor. It also has the receiver's order, tilt and lever arm. All come with sigmas. A parameter that the
drive does not determine keeps its value and is named.
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
"""A drive determines a parameter if it reduces the sigma below this share of the prior sigma."""
PRIORS: Final = Priors()
FEWEST_ROWS: Final = 30
"""Observations in plain view without which nothing is calibrated."""
FEWEST_OF_A_LAMP: Final = 6
"""Observations without which a lamp is not calibrated."""

_UNITS: Final = {"gain": "ln", "floor": "", "order": "", "slope": "m/m", "frame_yaw": "rad"}


class TooLittle(ValueError):
    """The drive holds too little to calibrate anything; the message names what is missing."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimate of one parameter, before and after the fit.

    Attributes:
        lamp_id: lamp of the parameter, None for a parameter common to all. name: as in the survey. unit: of all values.
        before, after: value. sigma: one sigma after the fit. prior: one sigma before it.
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
        """Whether the drive determined this parameter, that is, reduced its sigma below `TOLD` times the prior."""
        return self.sigma < TOLD * self.prior


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """Result of a calibration.

    Attributes:
        survey: with the new values. estimates: every free parameter.
        rows: observations after thinning. used: (n,) observations that were not rejected.
        before, after: (n,) residuals ln(received / expected). T_survey_drive: (x, y, yaw) of the drive's frame.
        scale: one sigma of ln RSS that the model does not explain. untouched: IDs of lamps with too few observations.
        covariance: (p, p) of all parameters, in the order of `estimator.calibration.parameters`.
        converged: whether the last steps of the solver were small.
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
        """RMS of the residuals (ln RSS) over the rows used, before and after."""
        first, last = (float(np.sqrt(np.mean(r[self.used] ** 2))) for r in (self.before, self.after))
        return first, last


def calibrate_lamps(survey: Survey, rows: Rows, priors: Priors = PRIORS, start: Array | None = None) -> Calibrated:
    """Fit the survey to one drive.

    Args:
        survey: prior values; ``rows.lamp`` indexes its lamps.
        rows: RSS with poses; thinned here.
        priors: prior sigmas of the parameters.
        start: (x, y, yaw) initial pose of the drive's frame in the survey's, where the priors leave it free.

    Raises:
        TooLittle: fewer than 30 observations in plain view, or no lamp with six.
    """
    return _fitted(survey, thinned(rows), priors, start)


def calibrate_from(survey: Survey, parts: Sequence[Rows], priors: Priors) -> Calibrated:
    """Fit the survey to rows that are already thinned, in several parts.

    Raises:
        TooLittle: fewer than 30 observations in plain view, or no lamp with six.
    """
    return _fitted(survey, joined(parts), priors, None)


def _fitted(survey: Survey, rows: Rows, priors: Priors, start: Array | None) -> Calibrated:
    """Check that the rows suffice, and solve."""
    task = problem(survey, priors)
    if start is not None:
        task.before[Common.FRAME_X : Common.FRAME_YAW + 1] = start
    begin = linear(task, rows, task.before)
    if len(rows) < FEWEST_ROWS or int(begin.seen.sum()) < FEWEST_ROWS:
        raise TooLittle(
            f"only {int(begin.seen.sum())} positions with a lamp in view; at least {FEWEST_ROWS} are needed"
        )
    counts = np.bincount(rows.lamp[begin.seen], minlength=len(survey.lamps))
    if counts.max() < FEWEST_OF_A_LAMP:
        raise TooLittle(f"no lamp was received from {FEWEST_OF_A_LAMP} positions 0.5 m apart; drive under the lamps")
    found = solve(task, rows)
    return _calibrated(task, rows, begin.residual, found)


def _calibrated(task: Problem, rows: Rows, before: Array, found: Solution) -> Calibrated:
    """Assemble the result from the solution; ``before``: (n,) residuals at the prior values."""
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
    """(K,) one sigma of ln power of each lamp, including the common gain; the prior sigma for a fixed lamp."""
    P, common = found.covariance, int(Common.GAIN)
    own = np.array([task.own(k).start + int(Own.GAIN) for k in range(len(task.lamps))], dtype=np.int64)
    variance = P[own, own] + P[common, common] + 2.0 * P[own, common]
    prior = np.array([lamp.sigma_ln for lamp in task.survey.lamps])
    result: Array = np.where(task.prior[own] > 0.0, np.sqrt(np.maximum(variance, 1e-6)), prior)
    return result


def estimates(task: Problem, found: Solution) -> tuple[Estimate, ...]:
    """Estimates of every free parameter, common ones first."""
    names: list[tuple[int | None, str]] = [(None, c.name.lower()) for c in Common]
    names += [(lamp.lamp_id, o.name.lower()) for lamp in task.survey.lamps for o in Own]
    assert len(names) == COMMONS + OWNS * len(task.lamps)
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    columns = (v.tolist() for v in (task.before, found.theta, sigma, task.prior))
    rows = list(zip(names, *columns, strict=True))
    some = [rows[k] for k in task.free.tolist()]
    return tuple(Estimate(lamp, name, _unit(name), b, a, s, prior) for (lamp, name), b, a, s, prior in some)


def _unit(name: str) -> str:
    """Unit of a parameter by its name."""
    for part, unit in _UNITS.items():
        if part in name:
            return unit
    return "m"
