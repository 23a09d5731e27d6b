"""What scan matching remembers from scan to scan: the local map, the latest match, and what residuals have shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.scan_matching.local_map import LocalMap


@dataclass(slots=True, eq=False)
class MatchMemory:
    """State of scan matching.

    Attributes:
        local_map: what the next scan is matched against, None before the first keyframe.
        t_scan, T_odom_scan: instant (s) and pose of the latest scan. t_match: instant of the latest that matched.
        t_newest_scan: end of the latest scan's sweep, s. bearing_rad: the latest bearings found in order.
        scans_since_keyframe: scans since the newest keyframe. failures: scans in a row that did not match.
        restarts: how often the local map was begun anew because nothing fitted the old one.
        noise_m: range noise learned from residuals, m; 0 before the first. residual_sums: (2,) fading sums over
            neighbouring residuals, product and squares (`estimator.scan_matching.residual_correlation`).
        unheld_s: for how long the pose has been carried on along a direction that no match held, s.
        steps: way and turn by the prediction, in units of the keyframe distances.
    """

    local_map: LocalMap | None = None
    t_scan: float = -math.inf
    T_odom_scan: Array = field(default_factory=se2.identity)
    t_match: float = -math.inf
    t_newest_scan: float = -math.inf
    bearing_rad: Array | None = None
    scans_since_keyframe: int = 0
    failures: int = 0
    restarts: int = 0
    noise_m: float = 0.0
    residual_sums: Array = field(default_factory=lambda: np.zeros(2))
    unheld_s: float = 0.0
    steps: float = 0.0
