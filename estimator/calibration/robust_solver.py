"""Robust least squares of a calibration problem: Levenberg-Marquardt on ln RSS with Cauchy loss.

Cost    sum_i q_i c^2/2 ln(1 + (r_i / (c s_i))^2) + 1/2 sum_k ((theta_k - before_k) / prior_k)^2
with    s_i^2 = scale^2 (0.03^2 + doubt_i^2) + noise_i^2,   q_i = 1 / (rows in the same patch of ground)

The model error is the same for all observations of one patch. A thousand rows beside one wall hold little information.
All rows of a patch together weigh as one row, so that the priors keep their weight against them.

The scale is estimated from the residuals (median absolute deviation) and the fit is repeated. RSS far below the
expectation was blocked; RSS far above it came by a mirror or from another lamp. Both are rejected after the first
round. The covariance is the larger of two, parameter by parameter. One counts each patch as one observation. The other
is White's sandwich over patches, which shows the actual scatter (H. White, Econometrica 48, 1980).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.calibration.observations import Rows, patches
from estimator.calibration.parameters import COMMONS, OWNS, Linear, Problem, bounded, linear
from estimator.numerics.arrays import Array

Mask = npt.NDArray[np.bool_]

ROUNDS: Final = 5
"""Fits, with a new scale after each."""
STEPS: Final = 40
"""Most steps of one fit."""
CAUCHY: Final = 2.385
"""Constant c of the Cauchy loss: 95 % efficiency with Gaussian errors."""
BLOCKED: Final = -3.5
STRANGE: Final = 5.0
"""Residuals in sigmas below `BLOCKED` or above this are rejected."""
MODEL_LN: Final = 0.03
"""One sigma of ln RSS that the model does not explain in a usual room."""
FIRST_SCALE: Final = 4.0
LEAST_SCALE: Final = 0.05
"""Smallest scale; scales are in units of `MODEL_LN`."""
MAD: Final = 1.4826
"""Sigma over median absolute deviation of a Gaussian."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Result of the solver.

    Attributes:
        theta: (p,) parameters. covariance: (p, p), zero for fixed parameters.
        used: (n,) rows in plain view that were not rejected. residual: (n,) ln(received / expected).
        scale: one sigma of ln RSS that the model does not explain where it is best.
        cost: final cost. converged: whether the last steps were small.
    """

    theta: Array
    covariance: Array
    used: Mask
    residual: Array
    scale: float
    cost: float
    converged: bool


def solve(task: Problem, rows: Rows, start: Array | None = None) -> Solution:
    """Solve the problem, starting at ``start`` (p,), or at the prior values where it is None."""
    theta = bounded(task.before if start is None else start)
    scale, used = FIRST_SCALE, np.ones(len(rows), dtype=np.bool_)
    cost, converged = 0.0, False
    for turn in range(ROUNDS):
        here = linear(task, rows, theta)
        used = here.seen & (_in_sigmas(here, rows, scale, BLOCKED, STRANGE) if turn > 0 else True)
        theta, cost, converged = _descend(task, rows.chosen(used), theta, scale)
        # over all rows in plain view, rejected or not: the scale of those kept would shrink round by round
        scale = _scale(linear(task, rows.chosen(here.seen), theta), rows.chosen(here.seen), task)
    last = linear(task, rows, theta)
    covariance = _covariance(task, rows.chosen(used), theta, scale)
    return Solution(theta, covariance, used, last.residual, scale * MODEL_LN, cost, converged)


def sigmas(here: Linear, rows: Rows, scale: float) -> Array:
    """(n,) one sigma of each residual."""
    total: Array = np.sqrt(scale**2 * (MODEL_LN**2 + here.doubt**2) + rows.sigma**2)
    return total


def _in_sigmas(here: Linear, rows: Rows, scale: float, low: float, high: float) -> Mask:
    """(n,) whether each residual lies between two limits in sigmas."""
    share = here.residual / sigmas(here, rows, scale)
    return (share > low) & (share < high)


def _scale(here: Linear, rows: Rows, task: Problem) -> float:
    """Scale of the residuals beyond noise, corrected for the number of free parameters."""
    n, spent = len(rows), len(task.free)
    if n < 3:
        return FIRST_SCALE
    unit = MODEL_LN**2 + here.doubt**2
    total = MAD**2 * float(np.median(here.residual**2 / unit)) * n / max(n - spent, 0.5 * n)
    return max(float(np.sqrt(max(total - float(np.median(rows.sigma**2 / unit)), 0.0))), LEAST_SCALE)


def _importance(rows: Rows) -> Array:
    """(n,) weight of each row in its patch; the weights of a patch sum to one."""
    groups = patches(rows.pose, rows.lamp)
    part: Array = 1.0 / np.bincount(groups)[groups] if len(rows) else np.zeros(0)
    return part


def _cost(task: Problem, here: Linear, s: Array, q: Array, theta: Array) -> float:
    """Cost of the residuals (Cauchy) and of the priors; ``s``: (n,) sigmas, ``q``: (n,) weights in the patch."""
    share = here.residual / s
    free = task.free
    held = (theta[free] - task.before[free]) / task.prior[free]
    return float(0.5 * CAUCHY**2 * (q @ np.log1p((share / CAUCHY) ** 2)) + 0.5 * held @ held)


def _weight(here: Linear, s: Array) -> Array:
    """(n,) weights of the reweighted least squares."""
    weight: Array = 1.0 / (s * s * (1.0 + (here.residual / (CAUCHY * s)) ** 2))
    return weight


def _normal(task: Problem, rows: Rows, here: Linear, weight: Array) -> tuple[Array, Array]:
    """Matrix and right-hand side of the weighted normal equations, without priors, for all parameters."""
    p = len(task.before)
    A, b = np.zeros((p, p)), np.zeros(p)
    for lamp in range(len(task.lamps)):
        mine = rows.lamp == lamp
        if not mine.any():
            continue
        J = np.hstack((here.common[mine], here.own[mine]))
        at = np.r_[0:COMMONS, np.arange(OWNS) + COMMONS + OWNS * lamp]
        WJ = weight[mine, None] * J
        A[np.ix_(at, at)] += J.T @ WJ
        b[at] += WJ.T @ here.residual[mine]
    return A, b


def _descend(task: Problem, rows: Rows, theta: Array, scale: float) -> tuple[Array, float, bool]:
    """Levenberg-Marquardt at a fixed scale; returns parameters, cost and whether it converged."""
    free = task.free
    held = np.diag(1.0 / task.prior[free] ** 2)
    here = linear(task, rows, theta)
    s, q = sigmas(here, rows, scale), _importance(rows)
    cost, damping = _cost(task, here, s, q, theta), 1e-4
    for _ in range(STEPS):
        A, b = _normal(task, rows, here, q * _weight(here, s))
        A, b = A[np.ix_(free, free)] + held, b[free] - held @ (theta[free] - task.before[free])
        while damping < 1e8:
            step = np.linalg.solve(A + damping * np.diag(np.diag(A)), b)
            trial = theta.copy()
            trial[free] += step
            trial = bounded(trial)
            there = linear(task, rows, trial)
            reached = _cost(task, there, s, q, trial)
            if reached <= cost:
                break
            damping *= 8.0
        else:
            return theta, cost, True
        gained, theta, here, damping = cost - reached, trial, there, max(0.2 * damping, 1e-9)
        cost = reached
        if gained < 1e-5 * (1.0 + cost):
            return theta, cost, True
    return theta, cost, False


def _covariance(task: Problem, rows: Rows, theta: Array, scale: float) -> Array:
    """The larger of sandwich and inverse information, see above; zero for fixed parameters."""
    p, free = len(theta), task.free
    here = linear(task, rows, theta)
    weight = _importance(rows) * _weight(here, sigmas(here, rows, scale))
    held = np.diag(1.0 / task.prior[free] ** 2)
    pick = np.ix_(free, free)
    inverse = np.linalg.inv(_normal(task, rows, here, weight)[0][pick] + held)
    scores = _scores(task, rows, here, weight)[:, free]
    few = len(scores) / max(len(scores) - len(free), 0.5 * len(scores), 1.0)
    sandwich = inverse @ (few * scores.T @ scores + held) @ inverse
    stretch = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(inverse), 1.0))
    covariance = np.zeros((p, p))
    covariance[pick] = stretch[:, None] * inverse * stretch[None, :]
    return covariance


def _scores(task: Problem, rows: Rows, here: Linear, weight: Array) -> Array:
    """(patches, p) score of each patch: weighted residuals times derivatives, summed over the patch."""
    groups = patches(rows.pose, rows.lamp)[:, None]
    scores = np.zeros((int(groups.max(initial=0)) + 1, len(task.before)))
    pull = (weight * here.residual)[:, None]
    np.add.at(scores, (groups, np.arange(COMMONS)[None, :]), pull * here.common)
    np.add.at(scores, (groups, COMMONS + OWNS * rows.lamp[:, None] + np.arange(OWNS)[None, :]), pull * here.own)
    return scores
