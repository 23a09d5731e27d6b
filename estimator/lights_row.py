"""What the `lights` filter knows of its place, and what it does not under lamps that are one row (see `row.py`)."""

from __future__ import annotations

import math
from typing import Final

from estimator import row
from estimator.lights_state import Lights, Track

HELD_S: Final = 1.0
"""After so long without a usable link the pose is said to be held."""
SETTLED_M: Final = 0.2
"""Standard deviation up to which a place is known well."""


def settled(track: Track) -> bool:
    """Whether the place is known well enough for a link that does not fit to be called wrong.

    What a lamp is received as depends on the place and hardly on the heading, which without wheels is never known well.
    """
    return bool(track.P[0, 0] + track.P[1, 1] < SETTLED_M**2)


def in_a_row(lights: Lights, t_mono: float) -> bool:
    """Whether the lamps in use have been one row for long enough to count as such.

    What a row tells of the distance from it, and of the heading, is the same mistake in every epoch: who also knows the
    way and the turn to a hair soon believes it. Lamps that have gone out tell nothing. Who turns on the spot knows the
    place by the lamps before, and needs to be told of the turn.
    """
    under = lights.under
    return under.lasts(t_mono) and under.far >= row.LASTING_M and t_mono - lights.t_used < HELD_S


def known_place(lights: Lights, track: Track, middle: float) -> bool:
    """Take note of a row of lamps, and say whether links that are improbable together may be doubted.

    That is where the place is settled, and under a row where it is along it: across, `row.loosen` holds it to be less
    well known than that, so that what is improbable then is so for every place across.

    Args:
        lights: all of the filter.
        track: its only hypothesis; its covariance may grow.
        middle: of the epoch, s.
    """
    accepted = frozenset[int]() if lights.result is None else lights.result.accepted
    narrow, angle = row.shape(lights.catalogue, accepted)
    if row.several(lights.catalogue, accepted):
        lights.under.take(middle, narrow, lights.course.T[:2], track.P[:3, :3])
    if not (lights.course.wheels and lights.under.lasts(middle) and middle - lights.t_used < HELD_S):
        return settled(track)
    row.loosen(narrow, angle, track.P, lights.under.least(angle))
    return row.across(angle + 0.5 * math.pi, track.P) < SETTLED_M**2
