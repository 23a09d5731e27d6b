"""Fusing a match into the moving pose, and what the filters learn from it."""

from __future__ import annotations

import numpy as np

from estimator import absolute, motion, se2
from estimator.linear3 import invert3
from estimator.records import Array, Scan
from estimator.result import MatchResult, Reason
from estimator.state import State

LEAST_NOISE_M = 0.004
LEARNING = 0.02
CAUCHY = 0.807
"""What the robust weights of the matcher leave of a Gaussian's variance."""


def fuse(state: State, match: MatchResult) -> None:
    """Take the matched pose and add its information; without odometry it also tells the velocity.

    The match has weighed the prediction in already (Eq. 14), so its pose is the fused pose.
    """
    moving = state.fused
    if match.ok:
        state.failures = 0
        learn_noise(state, match)
        T_pred, P_pred = moving.T_odom_base, moving.P
        moving.T_odom_base = match.T_odom_base
        inflated = motion.learn(moving, match.correction, bool(match.known_axes.all()))
        moving.P = invert3(invert3(P_pred * inflated) + match.information)
        absolute.on_match(state, T_pred, P_pred, inflated)
        if state.t_scan > -np.inf:
            made = se2.between(state.T_odom_scan, moving.T_odom_base)
            moving.gyro.learn(float(made[2]), moving.t_mono - state.t_scan)
            motion.feel(moving, made, (state.t_scan, moving.t_mono), 2.0 * np.diag(moving.P), state.settings.noise)
    elif match.reason is not Reason.NO_MAP:
        state.failures += 1
        if not moving.odometry:
            moving.velocity = 0.8 * moving.velocity  # a velocity that nothing confirms is let die
    state.t_scan, state.T_odom_scan = moving.t_mono, moving.T_odom_base


def noise_of(state: State, scan: Scan) -> float:
    """Range noise to reckon with: what residuals have shown, within a factor of three of the device's own figure."""
    stated = max(scan.sigma_m, LEAST_NOISE_M)
    return min(max(state.noise_m or stated, stated / 3.0, LEAST_NOISE_M), 3.0 * stated)


def learn_noise(state: State, match: MatchResult) -> None:
    """Follow the variance of the residuals."""
    square = match.residual_m**2 / CAUCHY
    if state.noise_m > 0.0:
        square = (1.0 - LEARNING) * state.noise_m**2 + LEARNING * square
    state.noise_m = float(np.sqrt(square))


def covariance(state: State) -> Array:
    """3x3 covariance of T_map_base: of the anchor, swung out to here, and of the pose relative to it.

    Once light has told where the map lies it is that of the place in the survey's frame instead.
    """
    away = se2.between(state.T_odom_anchor, state.fused.T_odom_base)
    tie = state.absolute
    if tie is not None and tie.placed:
        P = tie.P
    else:
        P = se2.carry(state.T_odom_anchor, away, state.P_anchor) + state.fused.P
    R = se2.rotation(state.T_map_odom[2])
    return np.asarray(R @ P @ R.T)
