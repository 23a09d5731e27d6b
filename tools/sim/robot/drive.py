"""A differential-drive robot: a smooth drive along a closed route (the ground truth), and the body's sway."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


STEP_M: Final = 0.01
SHARP_RAD: Final = 0.075
"""A step of the route that turns by more is a turn on the spot: it takes as long as the turn does."""


@dataclass(frozen=True, slots=True)
class Route:
    """A closed tour: corners (x, y) in m, the first is where it starts and ends; corners are rounded over a length."""

    corners: tuple[tuple[float, float], ...]
    rounding_m: float = 1.6


@dataclass(frozen=True, slots=True)
class Body:
    """What the robot can do and how it is built (m, s, rad).

    Attributes:
        speed, acceleration, turn_rate, lateral: limits of forward speed, forward acceleration, yaw rate, and sideways
            acceleration. wheel_base: distance between the wheels.
        lidar: (x, y, yaw) of the lidar in base_link. height: of the scan plane.
        tilt: constant pitch of the lidar's mount, positive ahead down. sway: amplitude of pitch and roll while moving.
        dive: pitch per m/s^2 of braking.
    """

    speed: float = 0.6
    acceleration: float = 0.4
    turn_rate: float = 0.9
    lateral: float = 0.5
    wheel_base: float = 0.40
    lidar: tuple[float, float, float] = (0.15, 0.0, 0.0)
    height: float = 0.30
    tilt: float = 0.001
    sway: float = 0.002
    dive: float = 0.004


def smooth(route: Route) -> Array:
    """Points every cm along the rounded closed route, (n, 2); the last equals the first.

    Corners are rounded by a periodic moving average with a Hann window, which leaves straight stretches untouched and
    makes the curvature continuous.
    """
    corners = np.array(route.corners)
    closed = np.vstack([corners, corners[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    count = round(length[-1] / STEP_M)
    s = np.arange(count) * (length[-1] / count)
    line = np.column_stack([np.interp(s, length, closed[:, 0]), np.interp(s, length, closed[:, 1])])
    half = max(round(0.5 * route.rounding_m / STEP_M), 1)
    window = np.hanning(2 * half + 3)[1:-1]
    window /= window.sum()
    padded = np.vstack([line[-half:], line, line[:half]])
    rounded = np.column_stack([np.convolve(padded[:, axis], window, mode="valid") for axis in (0, 1)])
    return np.vstack([rounded, rounded[:1]])


class Drive:
    """The ground truth: pose, speed and turn rate of base_link at any time, lap after lap.

    A lap starts with ``dwell_s`` of standing still and ends at rest where it began, at the route's first corner. Before
    time 0 and after ``laps`` laps the robot stands there.
    """

    def __init__(self, route: Route, body: Body, dwell_s: float = 2.0, laps: float = np.inf) -> None:
        points = smooth(route)
        step = np.hypot(*np.diff(points, axis=0).T)
        self._s = np.concatenate([[0.0], np.cumsum(step)])
        self._xy = points
        self._yaw, curvature = _headings(points, step)
        self._v = _speeds(self._s, _sharpened(curvature, self._yaw, step), body)
        self._curvature = curvature
        self._t = np.concatenate([[0.0], np.cumsum(2.0 * step / (self._v[1:] + self._v[:-1]))])
        self.body = body
        self.dwell_s = dwell_s
        self.laps = laps
        self.length_m = float(self._s[-1])
        self.lap_s = float(self._t[-1]) + dwell_s

    def _lap(self, t: Array) -> tuple[Array, Array]:
        """Number of full laps, and seconds into the moving part of this one (clipped to it)."""
        lap = np.clip(np.floor(t / self.lap_s), 0.0, self.laps)
        into = np.where(lap >= self.laps, 0.0, t - lap * self.lap_s - self.dwell_s)
        return lap, np.clip(into, 0.0, self._t[-1])

    def _within(self, into: Array) -> tuple[Array, Array]:
        """Arc length and speed at times into a lap: between two route points the acceleration is constant."""
        k = np.clip(np.searchsorted(self._t, into, side="right") - 1, 0, len(self._t) - 2)
        span = self._t[k + 1] - self._t[k]
        acceleration = (self._v[k + 1] - self._v[k]) / span
        tau = into - self._t[k]
        return self._s[k] + tau * (self._v[k] + 0.5 * acceleration * tau), self._v[k] + acceleration * tau

    def pose(self, t: Array) -> Array:
        """(n, 3) poses (x, y, yaw unwrapped) at (n,) times in s."""
        lap, into = self._lap(np.asarray(t, dtype=float))
        s, _ = self._within(into)
        turned = self._yaw[-1] - self._yaw[0]
        x, y = np.interp(s, self._s, self._xy[:, 0]), np.interp(s, self._s, self._xy[:, 1])
        return np.column_stack([x, y, np.interp(s, self._s, self._yaw) + lap * turned])

    def twist(self, t: Array) -> Array:
        """(n, 2) forward speed in m/s and yaw rate in rad/s."""
        _, into = self._lap(np.asarray(t, dtype=float))
        s, v = self._within(into)
        v = np.where((into <= 0.0) | (into >= self._t[-1]), 0.0, v)
        return np.column_stack([v, v * np.interp(s, self._s, self._curvature)])

    def travelled(self, t: Array) -> Array:
        """(n,) distance driven since time 0 in m."""
        lap, into = self._lap(np.asarray(t, dtype=float))
        return np.asarray(lap * self.length_m + self._within(into)[0])

    def tilt(self, t: float) -> tuple[float, float]:
        """Pitch and roll of the scan plane at ``t`` (positive: ahead, left points down)."""
        twist = self.twist(np.array([t - 0.05, t, t + 0.05]))
        moving = min(twist[1, 0] / 0.2, 1.0) * self.body.sway
        braking = -(twist[2, 0] - twist[0, 0]) / 0.1
        pitch = self.body.tilt + self.body.dive * braking
        pitch += moving * 0.5 * (np.sin(2 * np.pi * 1.7 * t) + np.sin(2 * np.pi * 4.3 * t + 1.0))
        roll = moving * 0.5 * (np.sin(2 * np.pi * 1.3 * t + 2.0) + np.sin(2 * np.pi * 5.1 * t))
        return float(pitch), float(roll)


def leans(drive: Drive, t: Array) -> Array:
    """(n, 2) pitch and roll of the body at (n,) times: :meth:`Drive.tilt` less the tilt of the lidar's mount."""
    body, (before, now, after) = drive.body, (drive.twist(t + step)[:, 0] for step in (-0.05, 0.0, 0.05))
    moving = 0.5 * body.sway * np.minimum(now / 0.2, 1.0)
    pitch = -body.dive * (after - before) / 0.1
    pitch = pitch + moving * (np.sin(2 * np.pi * 1.7 * t) + np.sin(2 * np.pi * 4.3 * t + 1.0))
    roll = moving * (np.sin(2 * np.pi * 1.3 * t + 2.0) + np.sin(2 * np.pi * 5.1 * t))
    return np.column_stack([pitch, roll])


def _headings(points: Array, step: Array) -> tuple[Array, Array]:
    """Heading (unwrapped) and curvature at every route point; the tour is closed, so both are periodic."""
    ring = np.vstack([points[-2], points, points[1]])
    chord = ring[2:] - ring[:-2]
    yaw = np.unwrap(np.arctan2(chord[:, 1], chord[:, 0]))
    bend = np.concatenate([[yaw[-1] - yaw[-2]], np.diff(yaw), [yaw[1] - yaw[0]]])
    span = np.concatenate([step[-1:], step, step[:1]])
    return yaw, (bend[1:] + bend[:-1]) / (span[1:] + span[:-1])


def _sharpened(curvature: Array, yaw: Array, step: Array) -> Array:
    """The curvature by which speed is limited: at either end of a turn on the spot that of the turn itself.

    Its mean with the steps beside it would let the robot leave the turn before it is round.
    """
    turn = np.abs(np.diff(yaw))
    bend = np.where(turn > SHARP_RAD, turn / np.maximum(step, 1e-9), 0.0)
    ends = np.maximum(np.concatenate([bend[-1:], bend]), np.concatenate([bend, bend[:1]]))
    return np.maximum(np.abs(curvature), ends)


def _speeds(s: Array, curvature: Array, body: Body) -> Array:
    """Fastest speed at every route point within the body's limits, starting and ending at rest."""
    bend = np.maximum(np.abs(curvature), 1e-9)
    v = np.minimum(body.speed, np.minimum(body.turn_rate / bend, np.sqrt(body.lateral / bend)))
    v[0] = v[-1] = 0.0
    ramp = 2.0 * body.acceleration * s
    squared = np.minimum.accumulate(v**2 - ramp) + ramp
    squared = np.minimum.accumulate((squared + ramp)[::-1])[::-1] - ramp
    return np.sqrt(np.maximum(squared, 0.0))


def compose(poses: Array, offset: tuple[float, float, float]) -> Array:
    """(n, 3) poses, each followed by the same planar transform."""
    x, y, yaw = offset
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return np.column_stack([poses[:, 0] + c * x - s * y, poses[:, 1] + s * x + c * y, poses[:, 2] + yaw])
