"""Without wheels, along a direction that no match holds: the pose is a guess. How wrong it may be, what tells later.

The velocity carries the pose on, and no match contradicts it. What it may be wrong by adds up with the way: the map
that is laid meanwhile is out of place for good, so it is the covariance of the place in the map that grows.

A silence of the laser is something else: it has grown the prediction's own covariance already.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from estimator.motion import LONGEST_CARRY_S, UNSEEN
from estimator.records import Array

if TYPE_CHECKING:
    from estimator.state import State

HELD: Final = 100.0
"""Information with which a match holds a direction: 10 cm (`MatchResult.known_axes`)."""
SAME_WAY: Final = 0.95
"""Cosine below which a direction is another one than where the stretch began."""
TELLS_S: Final = 0.15
"""So far apart, two matches tell the speed."""


@dataclass(slots=True, eq=False)
class Guess:
    """A stretch of way along which the pose is guessed; start with ``Guess()``.

    Attributes:
        seconds: how long so far; 0: there is none.
        along: unit vector (odom axes) that nothing holds, as it was first; None: it has turned, or is not known.
        speed: along it when the stretch began, m/s. variance: of that.
        P: (3, 3; m, m, rad; odom axes) what has been added to the covariance of the anchor, and can be taken back.
        held: instant, and metres along it, of the first match after it that holds every direction.
    """

    seconds: float = 0.0
    along: Array | None = None
    speed: float = 0.0
    variance: float = 0.0
    P: Array = field(default_factory=lambda: np.zeros((3, 3)))
    held: tuple[float, float] | None = None

    def stays(self) -> None:
        """Nothing of what has been added is taken back: the place in the map has been told otherwise since."""
        self.along = None


def loose_direction(H: Array) -> Array | None:
    """Unit vector (x, y) along which information ``H`` (3, 3) does not hold the place, None where it holds all."""
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = H.tolist()
    tt = max(tt, 1e-9)
    xx, xy, yy = xx - xt * xt / tt, xy - xt * yt / tt, yy - yt * yt / tt
    half = 0.5 * math.atan2(2.0 * xy, xx - yy)
    x, y = -math.sin(half), math.cos(half)
    return np.array((x, y)) if x * x * xx + 2.0 * x * y * xy + y * y * yy < HELD else None


def on_match(state: State, H: Array, dt: float) -> None:
    """Take in a match with information ``H`` (3, 3; odom axes), ``dt`` seconds after the scan before.

    Along a direction that it does not hold the place grows uncertain, at walking pace, from half a second on.
    """
    if state.fused.odometry:
        state.guess = Guess()
        return
    loose = loose_direction(H)
    if loose is None:
        if state.guess.seconds > 0.0:
            _settle(state)
        return
    if state.guess.seconds == 0.0 or state.guess.held is not None:
        state.guess = _begun(state, loose)
    now, tie = state.guess, state.absolute
    turned = now.along is not None and abs(float(now.along @ loose)) < SAME_WAY
    if turned or (tie is not None and tie.placed):  # then the anchor's covariance is what light has told
        now.stays()
    before, now.seconds = now.seconds, now.seconds + min(max(dt, 0.0), LONGEST_CARRY_S)
    t0, t1 = max(0.0, before - LONGEST_CARRY_S), max(0.0, now.seconds - LONGEST_CARRY_S)
    more = np.zeros((3, 3))
    more[:2, :2] = float(UNSEEN[0]) ** 2 * (t1 * t1 - t0 * t0) * np.outer(loose, loose)
    now.P += more
    state.P_anchor += more
    state.atlas.loosen(more, state.T_odom_anchor)  # the way too, or no loop could bring submaps together again


def _begun(state: State, along: Array) -> Guess:
    x, y = _in_base(state, along)
    velocity, variance = state.fused.velocity, state.fused.velocity_variance
    return Guess(
        along=along,
        speed=float(x * velocity[0] + y * velocity[1]),
        variance=float(x * x * variance[0] + y * y * variance[1]),
    )


def _in_base(state: State, along: Array) -> tuple[float, float]:
    """A direction of the odom frame in axes of the robot."""
    yaw = float(state.fused.T_odom_base[2])
    c, s = math.cos(yaw), math.sin(yaw)
    return float(c * along[0] + s * along[1]), float(c * along[1] - s * along[0])


def _settle(state: State) -> None:
    """The stretch is over: what the speed of before and of now leave in doubt of the way between is less than a guess.

    With the acceleration ``a`` that a robot may have (`MotionNoise`), and both speeds known, the way of ``T`` seconds
    is at most ``a T^2 / 4`` from that at their mean: half of it first gained and then lost again. That is counted as
    two deviations, and the mean itself is as far from the speed that has carried the pose as the two speeds say.
    Links of the graph stay as loose as they were made.
    """
    now, t = state.guess, state.fused.t_mono
    if now.along is None or not now.P.any():
        state.guess = Guess()
        return
    at = float(now.along @ state.fused.T_odom_base[:2])
    if now.held is None:
        now.held = (t, at)
    if t - now.held[0] < TELLS_S:
        return
    slower = (at - now.held[1]) / (t - now.held[0]) - now.speed
    bent = 0.125 * state.settings.noise.acceleration * now.seconds**2
    left = bent * bent + 0.25 * now.seconds**2 * (slower * slower + now.variance)
    state.P_anchor -= max(0.0, 1.0 - left / float(now.P[0, 0] + now.P[1, 1])) * now.P
    state.guess = Guess()
