"""Faults of a scan's values: wrong ranges, codes or intensities in valid replies."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import numpy as np

from hal.fake.faults.schedule import ActiveFaults
from hal.fake.lidar.models import LidarModel
from hal.fake.lidar.scan import FakeScan


def altered(scan: FakeScan, orders: ActiveFaults, model: LidarModel, chance: Random) -> FakeScan:
    """The scan after the faults ``wrong``, ``codes`` and ``dark`` that strike it.

    ``wrong`` shifts measured distances and keeps them in the legal range; error codes are unchanged.
    """
    fault = orders.strike("wrong")
    if fault:
        ranges = scan.ranges_mm
        measured = (ranges >= model.dmin) & (ranges <= model.dmax)
        shifted = np.clip(ranges + int(fault.number("by_mm")), model.dmin, model.dmax)
        scan = replace(scan, ranges_mm=np.where(measured, shifted, ranges).astype(np.int32))
    fault = orders.strike("codes")
    if fault:
        hit = np.random.default_rng(chance.getrandbits(32)).random(scan.ranges_mm.size) < fault.number("beams")
        ranges = np.where(hit, int(fault.number("value")), scan.ranges_mm)
        scan = replace(scan, ranges_mm=ranges.astype(np.int32))
    if orders.strike("dark"):
        scan = replace(scan, intensity=None, echo_intensity=None)
    return scan
