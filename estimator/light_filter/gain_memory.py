"""What the `lights` filter has learned that outlasts a hypothesis, and the process."""

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
"""By lamp ID: means and variances of (ln gain, lean x, lean y)."""

SENSORS = slice(state_vector.SCALE, state_vector.FIRST)
"""States of motion sensing, receiver and floor, which are the same wherever the robot is."""

DOUBT = np.array((0.03, 0.01, 0.01)) ** 2
"""What a lamp's gain and lean lose by being remembered."""
LEAST: Sequence[float] = DOUBT.tolist()
"""Nothing is expected more surely."""
AGED = np.array((0.05, 0.02, 0.02)) ** 2
"""What they lose from one run to the next: lamps age, and gather dust, while the robot is off."""


def fresh_gains(lights: Lights) -> Learned:
    """What the one hypothesis knows of its lamps, if it is worth believing."""
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
    """Of (ln gain, lean x, lean y) of a lamp of which nothing has been learned."""
    gain, lean = lights.catalogue.by_id[lamp_id].sigma_ln, lights.settings.model.lean
    return gain * gain, lean * lean, lean * lean


def gains_known(lights: Lights) -> Learned:
    """All that is known of the lamps' gains."""
    return {**lights.gains, **fresh_gains(lights)}


def expected_of(lights: Lights, lamp_id: int) -> tuple[Sequence[float], Sequence[float]]:
    """Means and variances of a lamp's own (ln gain, lean x, lean y): of an earlier run, else as surveyed.

    Not what this run has found so far: a place that is wrong has found lamps that fit it.
    """
    if known := lights.recalled.get(lamp_id):
        return known[0].tolist(), known[1].tolist()
    return (0.0, 0.0, 0.0), new_variance(lights, lamp_id)


def bend(lights: Lights, used: list[Sight]) -> None:
    """Note how far the likeliest hypothesis takes lamps for others than was expected (`model_consistency.Bent`).

    Of a lamp it is the sum of the squares of what is taken for its own gain, its lean and the error of its link: in
    deviations, of the link in usual ones, though at first more is allowed for. In plain numbers: arrays of three cost
    a sixth of the whole update.

    ``used``: the links accepted in the latest epoch; none tell nothing, nor do those that an older hypothesis has used.
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
    """Means and variances of :data:`SENSORS`, None while nothing worth keeping is known."""
    known = lights.tracks[0] if len(lights.tracks) == 1 and settled(lights.tracks[0]) else lights.before
    if known is None:
        return None
    mean, variance = known.x[SENSORS].copy(), np.diag(known.P)[SENSORS].copy()
    if lights.course.matched:  # what it knows of scales is about matches, and would be taken for that of wheels
        mean[:3], variance[:3] = wheel_scales(lights)
    return mean, variance


def recall(lights: Lights, gains: Learned, sensors: tuple[Array, Array] | None, lamps: tuple[Lamp, ...]) -> None:
    """Begin with what an earlier run has learned. The survey wins over what a lamp said of itself then.

    A lamp known by its own word is not among those that may be let go until it is heard again.
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
