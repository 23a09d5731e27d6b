"""Lamp gains and sensor states that outlive a hypothesis and a run; gain consistency of the present hypothesis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from estimator.light_filter import state_vector
from estimator.light_filter.filter_state import Lights, Track
from estimator.light_filter.link_association import Sight
from estimator.light_filter.link_gating import settled
from estimator.light_filter.motion_update import wheel_scales
from estimator.light_filter.survey import Lamp
from estimator.numerics.arrays import Array

Learned = Mapping[int, tuple[Array, Array]]
"""By lamp ID: means and variances of (ln gain, tilt x, tilt y)."""

SENSORS = slice(state_vector.SCALE, state_vector.FIRST)
"""States of odometry, gyro, receiver and diffuse floor, which do not depend on the pose."""

DOUBT = np.array((0.03, 0.01, 0.01)) ** 2
"""Variance added to a stored gain and tilt of a lamp."""
LEAST: Sequence[float] = DOUBT.tolist()
"""Minimum variance of an expected gain or tilt."""
AGED = np.array((0.05, 0.02, 0.02)) ** 2
"""Variance added from one run to the next: lamps age, and gather dust, while the robot is off."""


def fresh_gains(lights: Lights) -> Learned:
    """Gains of the lamps in the slots of the single hypothesis; empty while its pose is not certain."""
    if len(lights.tracks) != 1 or not settled(lights.tracks[0]):
        return {}
    track = lights.tracks[0]
    learned = {}
    for lamp_id, slot in track.slots.items():
        at = state_vector.FIRST + state_vector.OWN * slot
        P = np.diag(track.P)[at : at + 3] + DOUBT
        learned[lamp_id] = track.x[at : at + 3].copy(), np.minimum(P, new_variance(lights, lamp_id))
    return learned


def new_variance(lights: Lights, lamp_id: int) -> tuple[float, float, float]:
    """Prior variances of (ln gain, tilt x, tilt y) of a lamp."""
    gain, lean = lights.catalogue.by_id[lamp_id].sigma_ln, lights.settings.model.lean
    return gain * gain, lean * lean, lean * lean


def gains_known(lights: Lights) -> Learned:
    """All stored lamp gains, with those of the present hypothesis."""
    return {**lights.gains, **fresh_gains(lights)}


def expected_of(lights: Lights, lamp_id: int) -> tuple[Sequence[float], Sequence[float]]:
    """Prior means and variances of a lamp's (ln gain, tilt x, tilt y): of an earlier run, else of the survey.

    Values of this run are not used: a wrong pose would have found lamp gains that fit it.
    """
    if known := lights.recalled.get(lamp_id):
        return known[0].tolist(), known[1].tolist()
    return (0.0, 0.0, 0.0), new_variance(lights, lamp_id)


def bend(lights: Lights, used: list[Sight]) -> None:
    """Update the gain consistency of the likeliest hypothesis (`model_consistency.Bent`).

    The value of a lamp is the sum of squared normalised deviations of its gain, tilt and link error. The link error
    counts in its usual sigma, although its initial variance is larger. Plain numbers are used: arrays of three would
    cost a sixth of the whole update.

    ``used``: links accepted in the latest epoch. Without any, or with those of another hypothesis, nothing changes.
    """
    if not lights.tracks:
        return
    track, squares = lights.tracks[0], dict[int, float]()
    for sight in used:
        if sight.lamp is None or track.slots.get(sight.lamp.lamp_id) != sight.slot:
            continue
        first = state_vector.FIRST + state_vector.OWN * sight.slot
        own = track.x[first : first + state_vector.OWN].tolist()
        expected = zip(own[:3], *expected_of(lights, sight.lamp.lamp_id), LEAST, strict=True)
        off = [(is_ - mean, max(variance, least)) for is_, mean, variance, least in expected]
        squares[sight.lamp.lamp_id] = (
            sum(by * by / variance for by, variance in off) + own[state_vector.ERROR] * own[state_vector.ERROR]
        )
    if squares:
        lights.bent.take(squares, lights.course.t_mono, lights.course.way)


def sensors_known(lights: Lights) -> tuple[Array, Array] | None:
    """Means and variances of :data:`SENSORS`; None while none are certain enough to keep."""
    known = lights.tracks[0] if len(lights.tracks) == 1 and settled(lights.tracks[0]) else lights.before
    if known is None:
        return None
    mean, variance = known.x[SENSORS].copy(), np.diag(known.P)[SENSORS].copy()
    if lights.course.matched:  # its scales are those of scan matches, not of wheels
        mean[:3], variance[:3] = wheel_scales(lights)
    return mean, variance


def recall(lights: Lights, gains: Learned, sensors: tuple[Array, Array] | None, lamps: tuple[Lamp, ...]) -> None:
    """Start from the gains, sensor states and described lamps of an earlier run. The survey overrides described lamps.

    A lamp that described itself is not subject to removal until it is received again.
    """
    catalogue = lights.catalogue
    for lamp in lamps:
        if lamp.lamp_id not in catalogue.by_id:
            catalogue.add(lamp)
    for lamp_id, (mean, variance) in gains.items():
        if lamp_id in catalogue.by_id:
            lights.gains[lamp_id] = mean.copy(), np.minimum(variance + AGED, new_variance(lights, lamp_id))
            lights.recalled[lamp_id] = lights.gains[lamp_id]
    if sensors is not None:
        mean, variance = sensors
        lights.before = Track()
        lights.before.x[SENSORS], lights.before.P[SENSORS, SENSORS] = mean, np.diag(variance)
