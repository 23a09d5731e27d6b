"""T1 of Eq. 14: pose of the new scan by light, or else by the prediction.

Light gives only points of lamps seen from both bodies (``p_i = X_ref^-1 L_i`` and ``q_i = X_new^-1 L_i``). Eq. 13 on
these returns ``X_ref^-1 X_new`` for any lamp positions. So T1 is the relative pose of the light filter between the
reference scan and the new one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.result import Virtual
from estimator.scan_matching.local_map import PlacedScan
from estimator.scan_matching.scan_matcher import Prior

LIKELY: Final = np.diag((0.02**2, 0.02**2, 0.005**2))
"""Smallest covariance of a relative pose from light: stamps, and position-dependent errors of the light model."""


@dataclass(frozen=True, slots=True, eq=False)
class First:
    """T1 of Eq. 14, and its fit to its own measurement (Eq. 6).

    Attributes:
        T: pose of the new base.
        L: its information, in the axes of its frame.
        misfit: mean squared normalised residual of the links.
        links: their number, 0 where light is paused.
    """

    T: Array
    L: Array
    misfit: float = 0.0
    links: int = 0


def predicted(prior: Prior, reference: PlacedScan) -> First:
    """T1 without light: the prediction, with no link behind it."""
    return First(prior.T, prior.L)


def from_light(reference: PlacedScan, now: Virtual, misfit: float) -> First:
    """T1 from light: ``X_ref^-1 X_new`` applied to the reference keyframe, in the odom frame.

    The correlation of the two positions' errors is unknown. Their sum as the relative error is never too small.

    Args:
        reference: keyframe of the match, with a light solution.
        now: light solution at the new scan.
        misfit: mean squared normalised residual of its links.
    """
    ref = reference.virtual
    assert ref is not None
    relative = se2.between(ref.T_map_base, now.T_map_base)
    T = se2.compose(reference.T_odom_keyframe, relative)
    R = se2.rotation(reference.T_odom_keyframe[2] - ref.T_map_base[2])
    P = R @ (se2.carry(ref.T_map_base, relative, ref.covariance) + now.covariance) @ R.T
    return First(T, invert3(np.ascontiguousarray(P + LIKELY)), misfit, len(now.accepted))
