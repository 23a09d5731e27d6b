"""Lamp mapping: positions and powers of unsurveyed lamps from a drive with known poses.

Nobody wants to measure 200 lamps by hand. Each lamp is first fitted alone. Its RSS is largest below it, and ln RSS
falls with distance as in Eq. 1, so a maximum-likelihood fit from the position of the largest RSS finds it. A joint fit
of all lamps follows, with the parameters they share: the receiver's tilt, order and lever arm, the diffuse floor, and
the height of the ceiling. The result is in the frame of the drive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from estimator.calibration.calibrate import Calibrated, TooLittle, calibrate_from
from estimator.calibration.observations import Index, Rows, thinned
from estimator.calibration.parameters import COMMONS, OWNS, Own, Priors, problem
from estimator.calibration.robust_solver import solve
from estimator.light_filter.survey import Lamp, Receiver, Survey
from estimator.numerics.arrays import Array

REACH_M: Final = 2.2
"""Horizontal range of a lamp, in heights above the receiver (the edge of the field of view is at 1.7)."""
NEAR_M: Final = 1.5
"""Radius (m) around the position of the largest RSS over which the peak is averaged."""
WEAKEST: Final = 0.05
"""Share of the median lamp's peak RSS; a code whose peak is below is diffuse light of a distant lamp."""
FEWEST: Final = 20
"""Observations without which no lamp is mapped."""
USUAL_HEIGHT_M: Final = 2.6
"""Height of the lamps above the receiver, m, where none is given."""
HEIGHT_SIGMA_M: Final = 0.5
"""Prior sigma of that height, m."""
GAIN_LN: Final = 1.2
"""Prior sigma of ln power."""
ALONE: Final = Priors(gain=0.0, order=0.2, slope=0.0, place=3.0, floor=0.01, rx_order=0.0, rx_slope=0.0, lever=0.0)
TOGETHER: Final = Priors(gain=0.0, order=0.1, slope=0.02, place=3.0, floor=0.01, rx_order=0.25, pattern=0.1, glow=0.2)


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """Received RSS in order of arrival, one element (pose: one row) each.

    Attributes:
        rows: observations; their ``lamp`` is the number of the code.
        lamp_id: (n,) lamp ID of the data frame, -1 without one.
    """

    rows: Rows
    lamp_id: Index


@dataclass(frozen=True, slots=True, eq=False)
class Surveyed:
    """Survey from a drive.

    Attributes:
        found: joint fit; its survey is the result, in the frame of the drive.
        sigma: (K, 3) one sigma of x, y, z of each lamp, m. nearest: (K,) smallest distance of the drive to it, m.
        height_told: whether the drive determined the height of the ceiling.
        left_out: codes received too rarely or too weakly to be located.
    """

    found: Calibrated
    sigma: Array
    nearest: Array
    height_told: bool
    left_out: tuple[int, ...]


def survey(heard: Heard, receiver: Receiver, depth: float, height: float | None = None) -> Surveyed:
    """Locate every received lamp.

    Args:
        heard: RSS with poses.
        receiver: prior values; lever arm, tilt and order are refined.
        depth: modulation depth of the lamps.
        height: z of the lamps above the ground, m; None: estimated as far as the drive determines it.

    Raises:
        TooLittle: no lamp was received often enough.
        ValueError: the lamps are not above the receiver.
    """
    z = receiver.z + USUAL_HEIGHT_M if height is None else height
    if z < receiver.z + 0.3:
        raise ValueError(f"lamps at z = {z} m are not above the receiver at z = {receiver.z} m")
    groups, left_out = _groups(heard, REACH_M * (z - receiver.z))
    if not groups:
        raise TooLittle(f"no lamp was received well from {FEWEST} positions; drive under the lamps with the decoder on")
    alone = [_alone(rows, Lamp(n, code, 0.0, 0.0, z), receiver, depth) for n, code, rows in groups]
    start = Survey(tuple(alone), receiver, depth=depth)
    joint = [replace(rows, lamp=np.full(len(rows), k, dtype=np.int64)) for k, (_, _, rows) in enumerate(groups)]
    priors = TOGETHER if height is not None else replace(TOGETHER, height=HEIGHT_SIGMA_M)
    found = calibrate_from(start, joint, priors)
    return _surveyed(found, height is None, left_out)


def _groups(heard: Heard, reach: float) -> tuple[list[tuple[int, int, Rows]], tuple[int, ...]]:
    """Thinned rows by lamp as (lamp ID, code, rows), and the codes that yielded no lamp."""
    codes = np.unique(heard.rows.lamp)
    peaks = [float(heard.rows.amplitude[heard.rows.lamp == code].max()) for code in codes]
    least = WEAKEST * float(np.median(peaks)) if peaks else 0.0
    groups: list[tuple[int, int, Rows]] = []
    left_out = []
    named, taken = set(heard.lamp_id[heard.lamp_id >= 0].tolist()), set[int]()
    free = iter(k for k in range(1, 65536) if k not in named)
    for code in codes.tolist():
        mine = np.flatnonzero(heard.rows.lamp == code)
        parts = _apart(heard.rows.chosen(mine), reach, least)
        for part in parts:
            said = heard.lamp_id[mine[part]]
            said = said[said >= 0]
            name = int(np.bincount(said).argmax()) if len(said) else next(free)
            if name in taken:
                continue  # same lamp ID in its data frame: reflected light of the same lamp
            taken.add(name)
            groups.append((name, code, thinned(heard.rows.chosen(mine[part]))))
        if not parts:
            left_out.append(code)
    return groups, tuple(left_out)


def _apart(rows: Rows, reach: float, least: float) -> list[Index]:
    """Split the rows of one code by lamp: around the peak RSS, then around the peak of the rest, and so on."""
    rest = np.arange(len(rows))
    found: list[Index] = []
    while len(rest) >= FEWEST and rows.amplitude[rest].max() > least:
        middle = _peak(rows.chosen(rest))
        near = np.hypot(*(rows.pose[rest, :2] - middle).T) < reach
        if near.sum() >= FEWEST:
            found.append(rest[near])
        elif not near.any():
            break
        rest = rest[~near]
    return found


def _peak(rows: Rows) -> Array:
    """Approximate position of the largest RSS: mean of the positions near it, weighted by RSS squared."""
    top = rows.pose[int(np.argmax(rows.amplitude)), :2]
    near = np.hypot(*(rows.pose[:, :2] - top).T) < NEAR_M
    weight = rows.amplitude[near] ** 2
    middle: Array = weight @ rows.pose[near, :2] / weight.sum()
    return middle


def _alone(rows: Rows, lamp: Lamp, receiver: Receiver, depth: float) -> Lamp:
    """Fit one lamp alone, starting from the position of its largest RSS."""
    x, y = _peak(rows)
    first = Survey((replace(lamp, x=float(x), y=float(y), sigma_ln=GAIN_LN),), receiver, depth=depth)
    rows = replace(rows, lamp=np.zeros(len(rows), dtype=np.int64))
    task = problem(first, ALONE)
    task = replace(task, before=_with_gain(task.before, rows, lamp, receiver, depth))
    found = solve(task, rows)
    own = found.theta[COMMONS : COMMONS + OWNS]
    power = lamp.power_w * float(np.exp(own[Own.GAIN]))
    return replace(first.lamps[0], x=float(own[Own.X]), y=float(own[Own.Y]), power_w=power, order=float(own[Own.ORDER]))


def _with_gain(before: Array, rows: Rows, lamp: Lamp, receiver: Receiver, depth: float) -> Array:
    """Parameters with an initial power: the largest RSS is taken as that at the nadir."""
    H = (lamp.order + 1.0) * receiver.area_m2 / (2.0 * np.pi * (lamp.z - receiver.z) ** 2)
    nadir = receiver.responsivity * depth * lamp.power_w * H
    before = before.copy()
    before[COMMONS + Own.GAIN] = np.log(np.quantile(rows.amplitude, 0.99) / nadir)
    return before


def _surveyed(found: Calibrated, free_height: bool, left_out: tuple[int, ...]) -> Surveyed:
    """Assemble the result: sigmas and smallest distances by lamp."""
    K = len(found.survey.lamps)
    sigma = np.zeros((K, 3))
    by_name: Mapping[tuple[int | None, str], float] = {(e.lamp_id, e.name): e.sigma for e in found.estimates}
    height = by_name.get((None, "height"), 0.0)
    for k, lamp in enumerate(found.survey.lamps):
        sigma[k] = (by_name[lamp.lamp_id, "x"], by_name[lamp.lamp_id, "y"], height)
    at = np.array([(lamp.x, lamp.y) for lamp in found.survey.lamps])
    nearest = np.array(
        [float(np.hypot(*(found.rows.pose[found.rows.lamp == k, :2] - at[k]).T).min()) for k in range(K)]
    )
    told = free_height and any(e.told for e in found.estimates if e.name == "height")
    return Surveyed(found, sigma, nearest, told, left_out)
