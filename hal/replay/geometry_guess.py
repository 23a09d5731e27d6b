"""Infers a laser's beam geometry and no-return range from a log that does not give them."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.replay.carmen_lines import LaserSetup

SICK_CODES_M: Final = (81.83, 81.92)
"""SICK LMS 2xx telegrams: 0x1FF7 to 0x1FFF (8183 to 8191 cm) mean no return, dazzling and other non-distances."""

_KNOWN_FOV_DEG: Final = {
    401: (-50.0, 0.25),  # LMS 2xx at its finest: 100 deg
    541: (-135.0, 0.5),  # LMS 1xx
    1081: (-135.0, 0.25),  # LMS 1xx, UTM-30LX
    682: (-119.53125, 360.0 / 1024.0),  # URG-04LX: steps 44 to 725, front 384
    761: (-95.0, 0.25),  # UXM-30LX
}
FINEST_RAD: Final = 1e-4
"""Least plausible angle between beams."""
_PILE_SHARE: Final = 1e-4
_PILE_HEIGHT: Final = 10.0
_PILE_DEPTH_M: Final = 1.0


def beam_geometry(setup: LaserSetup) -> tuple[float, float, bool]:
    """``(start, step, sure)``: bearing of the first beam and angle between beams, rad, counter-clockwise positive.

    A line with a setup gives both. `FLASER` gives only the number of beams. Its lasers cover 180 deg from -90 deg with
    whole fractions of a degree: an odd number of beams spans the half circle, an even number lacks the last beam. 180
    and 181 are 1.0 deg, 360 and 361 are 0.5 deg. ``sure`` is False where this is a guess.
    """
    if abs(setup.start) <= 2.0 * math.pi and FINEST_RAD <= setup.resolution <= math.pi:
        return setup.start, _step(setup), True
    if setup.count in _KNOWN_FOV_DEG:
        start, step = _KNOWN_FOV_DEG[setup.count]
        return math.radians(start), math.radians(step), True
    step = math.pi / (setup.count - 1 if setup.count % 2 else setup.count) if setup.count > 1 else math.pi
    return -math.pi / 2, step, setup.count in (180, 181, 360, 361, 720, 721)


def _step(setup: LaserSetup) -> float:
    """Field of view divided by the beams, if it agrees with the written resolution.

    A step with six decimals, summed over a thousand beams, is off by a tenth of a beam's width.
    """
    spans = [setup.fov / n for n in (setup.count - 1, setup.count) if n > 0 and math.isfinite(setup.fov)]
    near = min(spans, key=lambda step: abs(step - setup.resolution), default=math.inf)
    return near if abs(near - setup.resolution) < 2e-3 * setup.resolution else setup.resolution


def whole_step(start: float, step: float) -> float:
    """Index of the beam to the front, rounded to a whole one within the rounding of written angles."""
    front = -start / step
    return float(round(front)) if abs(front - round(front)) < 1e-3 else front


def no_return(ranges: npt.NDArray[np.int32], unit_m: float, declared: float) -> int | None:
    """Smallest value, in range units, that means "no return"; None where every value looks like a distance.

    A declared maximum counts. Without one the largest value counts if it is frequent, with hardly any value in the
    metre below it. A real wall spreads over the range noise, a code does not.

    Args:
        ranges: all readings of one laser.
        unit_m: metres per unit.
        declared: the log's maximum range in m, or NaN.
    """
    values, counts = np.unique(ranges, return_counts=True)
    if math.isfinite(declared) and declared > 0.0:
        return round(declared / unit_m)
    if len(values) == 0:
        return None
    if SICK_CODES_M[0] <= values[-1] * unit_m <= SICK_CODES_M[1]:
        return round(SICK_CODES_M[0] / unit_m)
    depth = round(_PILE_DEPTH_M / unit_m)
    below = counts[(values < values[-1]) & (values >= values[-1] - depth)]
    pile = counts[-1] >= max(2.0, _PILE_SHARE * ranges.size)
    alone = len(below) == 0 or counts[-1] >= _PILE_HEIGHT * float(below.mean())
    return int(values[-1]) if pile and alone and len(values) > 1 else None
