"""Converts the ranges of a CARMEN log (m) to a lidar's device units, with the geometry that the log implies."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.lidar import VALID, LidarGeometry
from hal.replay.carmen_lines import LaserLine, LaserSetup
from hal.replay.geometry_guess import beam_geometry, no_return, whole_step
from hal.replay.report import LogReport

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.int32]

UNIT_M: Final = 0.001
PARAM_MODEL: Final = "lumiloop_laser_model"
PARAM_DMIN: Final = "lumiloop_laser_dmin"
PARAM_PERIOD: Final = "lumiloop_laser_period"
PARAM_BEAM_DT: Final = "lumiloop_laser_beam_dt"
"""Parameters that `lumiloop convert` adds to a log: text, metres, seconds, seconds between beams."""

PARAM_MAXIMUM: Final = "robot_front_laser_max"
_PART: Final = 256
"""Scans converted at a time, which bounds the memory."""
_FARTHEST: Final = 1_000_000
"""One kilometre in range units; a longer value is no distance of an indoor lidar."""


@dataclass(frozen=True, slots=True, eq=False)
class CarmenScan:
    """One scan in device units; `hal.lidar.RawScan` describes its fields. ``raw`` has a beam's range or its code."""

    geometry: LidarGeometry
    raw: Whole
    intensity: Whole | None

    def beams(self) -> tuple[Whole, Whole]:
        """Ranges and codes; computed on each call, so that a log in memory holds one number per beam."""
        valid = (self.raw >= self.geometry.dmin) & (self.raw <= self.geometry.dmax)
        return np.where(valid, self.raw, np.int32(0)), np.where(valid, np.int32(VALID), self.raw)


def convert(lasers: list[LaserLine], parameters: dict[str, str], time: Array, report: LogReport) -> list[CarmenScan]:
    """Metres to whole millimetres and codes, one laser setup at a time.

    Args:
        lasers: laser lines in file order.
        parameters: the log's parameters.
        time: monotone time of each line, for the period.
        report: receives the counts of beams.
    """
    by_setup: dict[LaserSetup, list[int]] = {}
    for index, line in enumerate(lasers):
        by_setup.setdefault(line.setup, []).append(index)
    period = float(np.median(np.diff(time))) if len(lasers) > 1 else 0.0
    scans: dict[int, CarmenScan] = {}
    for setup, indices in by_setup.items():
        raw = _raw([lasers[index].ranges for index in indices], setup.count)
        geometry = _geometry(setup, raw, parameters, period)
        valid = np.count_nonzero((raw >= geometry.dmin) & (raw <= geometry.dmax))
        report.use("beams", raw.size)
        report.use("beams without a return", int(raw.size - valid))
        for row, index in enumerate(indices):
            scans[index] = CarmenScan(geometry, raw[row], _intensity(lasers[index].remission))
    return [scans[index] for index in range(len(lasers))]


def _intensity(remission: array[float]) -> Whole | None:
    return np.rint(np.nan_to_num(np.asarray(remission))).astype(np.int32) if remission else None


def _raw(ranges: list[array[float]], count: int) -> Whole:
    """Ranges of one laser, a row per scan, (n, count); converted in parts to bound the memory."""
    raw = np.empty((len(ranges), count), np.int32)
    for first in range(0, len(ranges), _PART):
        raw[first : first + _PART] = _millimetres(np.array(ranges[first : first + _PART]))
    return raw


def _millimetres(metres: Array) -> Whole:
    """Metres to range units; NaN, infinity and negative values become 0, below every laser's least distance."""
    usable = np.isfinite(metres) & (metres > 0.0)
    return np.rint(np.where(usable, np.minimum(metres / UNIT_M, 2.0 * _FARTHEST), 0.0)).astype(np.int32)


def _number(parameters: dict[str, str], name: str, otherwise: float) -> float:
    try:
        value = float(parameters[name])
    except (KeyError, ValueError):
        return otherwise
    return value if math.isfinite(value) else otherwise


def _geometry(setup: LaserSetup, raw: Whole, parameters: dict[str, str], usual_period: float) -> LidarGeometry:
    start, step, _ = beam_geometry(setup)
    dmin = max(1, round(_number(parameters, PARAM_DMIN, UNIT_M) / UNIT_M))
    limits = [no_return(raw, UNIT_M, math.nan), no_return(raw, UNIT_M, setup.maximum)]
    limits.append(no_return(raw, UNIT_M, _number(parameters, PARAM_MAXIMUM, math.nan)))
    known = [limit for limit in limits if limit is not None]
    return LidarGeometry(
        model=parameters.get(PARAM_MODEL, "CARMEN laser"),
        serial="",
        firmware="",
        ares=2.0 * math.pi / step,
        afrt=whole_step(start, step),
        amin=0,
        amax=setup.count - 1,
        dmin=dmin,
        dmax=min([_FARTHEST, *(limit - 1 for limit in known)]),
        range_unit_m=UNIT_M,
        period_s=_number(parameters, PARAM_PERIOD, usual_period),
        beam_dt_s=_number(parameters, PARAM_BEAM_DT, 0.0),
    )
