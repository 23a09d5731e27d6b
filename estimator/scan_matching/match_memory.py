"""Scan-matching state between scans: the local map, the latest match, and learned noise and residual correlation."""

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
        local_map: map for the next scan, None before the first keyframe.
        t_scan, T_odom_scan: instant (s) and pose of the latest scan.
        t_match, T_odom_match: instant (s) and pose of the latest scan that matched.
        t_newest_scan: end of the latest scan, s.
        bearing_rad: the latest bearings that passed validation.
        first_alike, driven: ranges (m) of the first of several scans that are all alike, and the motion of the wheels
            since (x, y, yaw).
        scans_since_keyframe: scans since the newest keyframe.
        failures: consecutive scans that did not match.
        restarts: number of local map restarts because nothing fitted the old one.
        noise_m: range noise learned from residuals, m; 0 before the first.
        residual_sums: (2,) exponentially weighted sums over neighbouring residuals, product and squares
            (`estimator.scan_matching.residual_correlation`).
        unheld_s: duration of prediction along a degenerate direction, s.
        steps: predicted path length and rotation, in units of the keyframe distances.
    """

    local_map: LocalMap | None = None
    t_scan: float = -math.inf
    T_odom_scan: Array = field(default_factory=se2.identity)
    t_match: float = -math.inf
    T_odom_match: Array = field(default_factory=se2.identity)
    t_newest_scan: float = -math.inf
    bearing_rad: Array | None = None
    first_alike: Array = field(default_factory=lambda: np.empty(0))
    driven: Array = field(default_factory=se2.identity)
    scans_since_keyframe: int = 0
    failures: int = 0
    restarts: int = 0
    noise_m: float = 0.0
    residual_sums: Array = field(default_factory=lambda: np.zeros(2))
    unheld_s: float = 0.0
    steps: float = 0.0
