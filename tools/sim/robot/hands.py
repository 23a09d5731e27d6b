"""Somebody who lifts the robot and puts it down elsewhere on its tour: orders for ``robot`` beside those for devices.

Its wheels stand still meanwhile, its lidar, tilted against somebody's coat, sees nothing, and it drives on from there
as if nothing had happened.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from hal.fake.faults.orders import Fault, Parameter, Vocabulary, Word
from tools.sim.robot.drive import Array, Drive

VOCABULARY: Final[Vocabulary] = {
    "carry": Word(
        "the robot is lifted and put down `ahead` seconds further along its tour, which `takes` seconds",
        "once",
        {"ahead": Parameter(60.0, 1.0, 1e5), "takes": Parameter(2.0, 0.0, 600.0)},
    )
}


@dataclass(frozen=True, slots=True)
class Carry:
    """Lifted at ``t_up`` and put down at ``t_down`` (t_mono); from and to these seconds on the drive's clock."""

    t_up: float
    t_down: float
    from_s: float
    to_s: float


class Way:
    """Which part of its tour the robot is in at each instant since it drove off (s), with every time it was carried."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self.carries: list[Carry] = []

    def carry(self, t: float, ahead_s: float, takes_s: float) -> None:
        """Lift it at ``t``; while it is being carried nobody else can."""
        if self.carries and t < self.carries[-1].t_down:
            return
        at = float(self.clock(np.array([t]))[0])
        self.carries.append(Carry(t, t + takes_s, at, at + ahead_s))

    def in_the_air(self, t: float) -> bool:
        """Whether somebody is carrying it."""
        return any(one.t_up <= t < one.t_down for one in self.carries)

    def clock(self, t: Array) -> Array:
        """(n,) seconds on the drive's clock at (n,) instants; it stands still in the air."""
        out = np.maximum(t, 0.0)
        for one in self.carries:
            out = np.where(t >= one.t_up, one.from_s, out)
            out = np.where(t >= one.t_down, one.to_s + (t - one.t_down), out)
        return np.asarray(out)

    def poses(self, t: Array) -> Array:
        """(n, 3) true poses; from place to place in a straight line."""
        out = self._drive.pose(self.clock(t))
        for one in self.carries:
            share = np.clip((t - one.t_up) / max(one.t_down - one.t_up, 1e-9), 0.0, 1.0)[:, None]
            begin, end = self._drive.pose(np.array([one.from_s, one.to_s]))
            turned = begin[2] + np.remainder(end[2] - begin[2] + np.pi, 2.0 * np.pi) - np.pi
            between = (1.0 - share) * begin + share * np.array((end[0], end[1], turned))
            out = np.where(((t >= one.t_up) & (t < one.t_down))[:, None], between, out)
        return np.asarray(out)


def then(T: Array, pose: Array) -> Array:
    """A pose (x, y, yaw) seen from a frame that lies at T, as seen from where T is."""
    c, s = np.cos(T[2]), np.sin(T[2])
    return np.array((T[0] + c * pose[0] - s * pose[1], T[1] + s * pose[0] + c * pose[1], T[2] + pose[2]))


def start_of(end: Array, pose: Array) -> Array:
    """Where the frame lies in which ``pose`` is what from here is ``end``."""
    turn = end[2] - pose[2]
    c, s = np.cos(turn), np.sin(turn)
    return np.array((end[0] - c * pose[0] + s * pose[1], end[1] - s * pose[0] - c * pose[1], turn))


class Movable(Protocol):
    """A scene whose robot can be carried."""

    def carry(self, t_mono: float, ahead_s: float, takes_s: float) -> None:
        """Lift the robot now, and put it down further along its tour."""
        ...


class Hands:
    """A :class:`hal.fake.faults.schedule.Target` that carries the robot of a scene."""

    vocabulary = VOCABULARY

    def __init__(self, scene: Movable, now: Callable[[], float]) -> None:
        self._scene, self._now = scene, now

    def check(self, fault: Fault) -> None:
        """Nothing more to check than the ranges."""

    def in_force(self) -> list[Fault]:
        """Carrying is over as soon as it is ordered."""
        return []

    def begin(self, fault: Fault) -> None:
        """Lift it."""
        self._scene.carry(self._now(), fault.number("ahead"), fault.number("takes"))

    def end(self, fault: Fault) -> None:
        """Nothing to lift."""
