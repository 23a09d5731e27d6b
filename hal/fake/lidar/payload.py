"""Builds the payload of a measurement reply from a scan: range of steps, clusters, echoes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hal.fake.lidar import scip_encoder
from hal.fake.lidar.commands import Measure
from hal.fake.lidar.scan import FakeScan

Ints = npt.NDArray[np.int32]


def chosen_steps(distance: Ints, wanted: Measure, dmin: int) -> npt.NDArray[np.intp]:
    """Steps to send: every one, or with clusters the nearest one of each cluster that is no error code.

    The last cluster may be smaller (one reading of the documents: ``ceil(k / n)`` outputs).
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
    """Characters of one scan for command ``name`` (MD GD, MS GS, ME GE, ND HD, NE HE).

    ``extra``: by a fault, steps sent beyond the requested ones (the last one repeated), or fewer where negative.
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
