"""From a scan of the world to the payload a measurement command asks for: range of steps, grouping, echoes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hal.fake.lidar import scip_encoder
from hal.fake.lidar.commands import Measure
from hal.fake.lidar.scan import FakeScan

Ints = npt.NDArray[np.int32]


def chosen_steps(distance: Ints, wanted: Measure, dmin: int) -> npt.NDArray[np.intp]:
    """Steps that are sent: every one, or with grouping the nearest that is no error code of each group.

    The last group may be smaller (one reading of the documents: ``ceil(k / n)`` outputs).
    """
    steps = np.arange(wanted.start, wanted.end + 1)
    if wanted.cluster == 1:
        return steps
    groups = -(-steps.size // wanted.cluster)
    padded = np.full(groups * wanted.cluster, np.iinfo(np.int32).max, dtype=np.int64)
    part = distance[steps].astype(np.int64)
    padded[: steps.size] = np.where(part >= dmin, part, part + (1 << 20))
    nearest = padded.reshape(groups, wanted.cluster).argmin(axis=1)
    return np.asarray(wanted.start + np.arange(groups) * wanted.cluster + nearest)


def payload(name: str, wanted: Measure, scan: FakeScan, dmin: int, extra: int = 0) -> bytes:
    """Characters of one scan as command ``name`` sends them (MD GD, MS GS, ME GE, ND HD, NE HE).

    ``extra`` is the fault of sending more steps than were asked for (the last one again), or fewer.
    """
    steps = chosen_steps(scan.ranges_mm, wanted, dmin)
    if extra:
        steps = np.append(steps, np.repeat(steps[-1:], extra)) if extra > 0 else steps[:extra]
    distance = scan.ranges_mm[steps]
    if name in ("MD", "GD"):
        return scip_encoder.distances(distance)
    if name in ("MS", "GS"):
        return scip_encoder.short_distances(distance)
    intensity = np.zeros_like(distance) if scan.intensity is None else scan.intensity[steps]
    if name in ("ME", "GE"):
        return scip_encoder.distances_intensities(distance, intensity)
    none = np.zeros((distance.size, 0), dtype=np.int32)
    further = none if scan.echoes_mm is None else scan.echoes_mm[steps]
    if name in ("ND", "HD"):
        return scip_encoder.multi_echo(distance, further)
    weaker = None if scan.echo_intensity is None else scan.echo_intensity[steps]
    return scip_encoder.multi_echo(distance, further, intensity, weaker)
