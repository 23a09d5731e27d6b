"""The ceiling at link level: what a photodiode on the robot receives of every lamp, at any pose and time.

Direct light from measured-like emission tables past walls, shelves and people; light by way of the walls; diffuse light
that differs over the room; lamps that differ from one another, age, warm up and lean. It shares no code with the
estimator and is richer than its model: see docs/simulator.md for what is modelled and what is not.

::

    ceiling = paper_ceiling(Effects(gain_spread=0.05), seed=3)
    ceiling.amplitudes(poses, t)        # (n, lamps) A of modulated photocurrent
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.sim.building.building import Building
from tools.sim.building.buildings import building
from tools.sim.building.world import SimWorld
from tools.sim.ceiling import optics
from tools.sim.ceiling.bounce import Finish, Walls, inside, interpolate, obstacle_rows
from tools.sim.ceiling.diffuse import carried, own_wave, pattern, waves, within
from tools.sim.ceiling.effects import IDEAL, Effects, Photodiode
from tools.sim.ceiling.kernels import LAMP_COLUMNS, direct
from tools.sim.ceiling.lamps import Fixture, Zone, fixtures

Array = npt.NDArray[np.float64]

MARGIN: Final = np.radians(8.0)
"""Beyond half the field of view, in which light is still looked for: lamp, receiver and robot lean."""


Lean = Callable[[Array], Array]
"""Pitch and roll (n, 2) of the robot at (n,) times, positive: ahead and left point down."""
Movers = Callable[[Array, Array], Array]
"""(n or 1, k, 8) obstacle rows of what moves, at (n,) times for a robot at (n, 3) poses."""


@dataclass(eq=False)
class Ceiling:
    """All lamps of a building over one photodiode.

    Attributes:
        fixtures: lamps as planned. world: what stands between. height_m: of the ceiling. depth: of modulation.
        lean, movers: how the robot sways, and who walks about; None: it does not, nobody.
        lit_since: when the lamps were switched on, s; -inf: at time 0.
        placed: (lamps, 3) where they truly are. power_w: (lamps,) what they truly radiate at time 0 when warm.
    """

    fixtures: tuple[Fixture, ...]
    world: SimWorld
    height_m: float = 3.0
    effects: Effects = field(default_factory=Effects)
    photodiode: Photodiode = field(default_factory=Photodiode)
    depth: float = 0.30
    seed: int = 0
    lean: Lean | None = None
    movers: Movers | None = None
    lit_since: float = -np.inf

    def __post_init__(self) -> None:
        fx, n = self.effects, len(self.fixtures)
        chance = np.stack(
            [np.random.default_rng((self.seed, lamp.lamp_id)).standard_normal(16) for lamp in self.fixtures]
        )
        own = np.random.default_rng((self.seed, 0))
        self.placed = np.array([(f.x, f.y, f.z) for f in self.fixtures]) + fx.survey_m * chance[:, 0:3]
        self.power_w = np.array([f.power_w for f in self.fixtures]) * np.exp(fx.gain_spread * chance[:, 3])
        self.gain = float(np.exp(fx.receiver_gain * own.standard_normal()))
        self.receiver_lean = np.radians(fx.receiver_tilt_deg) * own.standard_normal(2)
        self._ageing = fx.ageing * np.sign(chance[:, 4]) * (0.5 + 0.5 * _share(chance[:, 5]))
        self._warm = 0.7 + 0.6 * _share(chance[:, 6])
        self._swing = 2.0 * np.pi * _share(chance[:, 7])
        self._waves = waves(own)
        self._own_waves = chance[:, 12:16]
        self.emission = np.stack(
            [
                optics.emission(f.half_angle_deg, fx.emission, c[8:12])
                for f, c in zip(self.fixtures, chance, strict=True)
            ]
        )
        self.acceptance = optics.acceptance(self.photodiode.half_fov_deg, fx.acceptance)
        tilt = np.radians(fx.lamp_tilt_deg) * np.roll(chance, 3, axis=1)[:, :2]
        self._lamps = np.stack([self._lamp_row(k, tilt[k]) for k in range(n)])
        self._obstacles = (
            self._arrange() if fx.obstacles else (np.zeros((0, 8)), np.zeros(n + 1, np.int32), np.zeros(0, np.int32))
        )
        self._walls: dict[Zone, Walls] = {}
        self._grids: dict[int, Array] = {}
        self._off: dict[int, tuple[float, float]] = {}

    # what can be done to it

    def switch_off(self, lamp_id: int, t_begin: float = -np.inf, t_end: float = np.inf) -> None:
        """A lamp is dark for some time; raises ValueError if there is none of that number."""
        self._off[self._index(lamp_id)] = (t_begin, t_end)

    def moved(self, lamp_id: int, by: tuple[float, float]) -> Ceiling:
        """The same ceiling with one lamp hung elsewhere, which the plan does not know."""
        other = replace(self)
        other.placed, other._lamps, other._off = self.placed.copy(), self._lamps.copy(), dict(self._off)
        k = self._index(lamp_id)
        other.placed[k, :2] += by
        other._lamps[k, :2] += by
        other._obstacles = other._arrange() if self.effects.obstacles else other._obstacles
        return other

    def _index(self, lamp_id: int) -> int:
        for k, lamp in enumerate(self.fixtures):
            if lamp.lamp_id == lamp_id:
                return k
        raise ValueError(f"no lamp has the number {lamp_id}; there are 1 to {len(self.fixtures)}")

    # what is received

    def amplitudes(self, T_map_base: Array, t: Array) -> Array:
        """Modulated photocurrent of each lamp.

        Args:
            T_map_base: (n, 3) poses in the building's frame.
            t: (n,) s since the run began.

        Returns:
            (n, lamps) A.
        """
        poses, t = np.atleast_2d(np.asarray(T_map_base, float)), np.atleast_1d(np.asarray(t, float))
        sights = self.sights(poses, t)
        out = np.zeros((len(poses), len(self.fixtures)))
        moving = np.zeros((1, 0, 8))
        if self.movers is not None and self.effects.people:
            moving = self.movers(t, poses)
        direct(sights, (self._lamps, self.emission, self.acceptance), self._obstacles, moving, out)
        out += self.by_the_walls(sights[:, :2]) + self.diffuse(sights[:, :2])
        pd = self.photodiode
        return out * (self.depth * self.gain * pd.responsivity * pd.area_m2) * self.powers(t)

    def sights(self, poses: Array, t: Array) -> Array:
        """(n, 9) place, axis and own x axis of the photodiode."""
        pd = self.photodiode
        lean = np.zeros((len(poses), 2))
        if self.lean is not None and self.effects.sway:
            lean = self.lean(t)
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        slope_x, slope_y = self.receiver_lean[0] + lean[:, 0], self.receiver_lean[1] + lean[:, 1]
        up = np.column_stack([c * slope_x - s * slope_y, s * slope_x + c * slope_y, np.ones(len(poses))])
        up /= np.linalg.norm(up, axis=1)[:, None]
        ahead = np.column_stack([c, s, np.zeros(len(poses))])
        ahead -= np.sum(ahead * up, axis=1)[:, None] * up
        ahead /= np.linalg.norm(ahead, axis=1)[:, None]
        x, y = poses[:, 0] + c * pd.x - s * pd.y, poses[:, 1] + s * pd.x + c * pd.y
        return np.ascontiguousarray(np.column_stack([x, y, np.full(len(poses), pd.z), up, ahead]))

    def powers(self, t: Array) -> Array:
        """(n, lamps) mean radiant power in W."""
        fx = self.effects
        t = t - self.lit_since if np.isfinite(self.lit_since) else t
        change = 1.0 + self._ageing * np.clip(t[:, None] / fx.ageing_s, 0.0, 1.0)
        change = change * (1.0 + fx.warm_up * self._warm * np.exp(-np.maximum(t[:, None], 0.0) / fx.warm_up_s))
        change = change * (1.0 + fx.drift * np.sin(2.0 * np.pi * t[:, None] / 1800.0 + self._swing))
        for k, (begin, end) in self._off.items():
            change[(t >= begin) & (t < end), k] = 0.0
        return np.asarray(change * self.power_w)

    def by_the_walls(self, at: Array) -> Array:
        """(n, lamps) weighted irradiance (1/m^2) by way of the walls of a lamp's own room, for 1 W."""
        out = np.zeros((len(at), len(self.fixtures)))
        if self.effects.bounces == 0 or self.effects.rho == 0.0:
            return out
        level = self.acceptance.mean(axis=1, keepdims=True)
        for k, fixture in enumerate(self.fixtures):
            here = within(at, fixture.zone)
            if not here.any():
                continue
            walls = self._walls_of(fixture.zone)
            if k not in self._grids:
                self._grids[k] = walls.grid(self._lamps[k], self.emission[k], np.ascontiguousarray(level))
            out[here, k] = interpolate(walls.x, walls.y, self._grids[k], at[here])
        return out

    def diffuse(self, at: Array) -> Array:
        """(n, lamps) diffuse irradiance (1/m^2) for 1 W: fills a room unevenly, leaks a little out of it."""
        fx = self.effects
        below = self.emission[:, 0, 0] / (self._lamps[:, 2] - self.photodiode.z) ** 2
        common = pattern(at, self._waves)
        out = np.empty((len(at), len(self.fixtures)))
        for k, fixture in enumerate(self.fixtures):
            own = pattern(at, own_wave(self._own_waves[k]))
            uneven = 1.0 + fx.floor_swing * np.clip(0.8 * common + 0.35 * own, -1.0, 1.0)
            out[:, k] = fx.floor * below[k] * uneven * carried(at, self._lamps[k, :2], fixture.zone)
        return out

    def _walls_of(self, zone: Zone) -> Walls:
        if zone not in self._walls:
            fx = self.effects
            finish = Finish(fx.rho, fx.bounces, self.photodiode.z, self.height_m)
            self._walls[zone] = Walls(self.world, zone, finish)
        return self._walls[zone]

    def _lamp_row(self, k: int, tilt: Array) -> Array:
        """See :data:`tools.sim.ceiling.kernels.LAMP_COLUMNS`."""
        down = np.array([tilt[0], tilt[1], -1.0])
        down /= np.linalg.norm(down)
        along = np.array([1.0, 0.0, 0.0]) - down[0] * down
        along /= np.linalg.norm(along)
        row = np.zeros(LAMP_COLUMNS)
        row[:3], row[3:6], row[6:9], row[9:12] = self.placed[k], along, np.cross(down, along), down
        reach = np.tan(np.radians(self.photodiode.half_fov_deg) + MARGIN)
        row[12:] = self.fixtures[k].radius_m, (self.placed[k, 2] - self.photodiode.z) * reach
        return row

    def _arrange(self) -> tuple[Array, npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """What may stand in the way of each lamp."""
        world = self.world
        rows = obstacle_rows(world.shapes, world.tops)
        x, y, reach = self._lamps[:, 0], self._lamps[:, 1], self._lamps[:, 13]
        shapes = world.shapes
        if len(world.shelves):
            boxes = np.column_stack([np.full(len(world.shelves), 2.0), world.shelves, np.zeros(len(world.shelves))])
            rows = np.vstack([rows, boxes])
            shapes = np.vstack([shapes, boxes[:, :6]])
        near = [
            np.flatnonzero(
                inside(shapes, (x[k] - reach[k], y[k] - reach[k], x[k] + reach[k], y[k] + reach[k]), 0.0)
                & (rows[:, 6] > self.photodiode.z)
            )
            for k in range(len(x))
        ]
        start = np.concatenate([[0], np.cumsum([len(items) for items in near])])
        return np.ascontiguousarray(rows), start.astype(np.int32), np.concatenate(near).astype(np.int32)


def _share(normal: Array) -> Array:
    """Standard normal numbers to 0 .. 1, smoothly."""
    return np.asarray(0.5 + 0.5 * np.tanh(0.8 * normal))


def ceiling_of(place: Building, effects: Effects | None = None, seed: int = 0, **more: object) -> Ceiling:
    """The ceiling of a building; ``more`` are further attributes of :class:`Ceiling`."""
    return Ceiling(fixtures(place), place.world, place.height_m, effects or Effects(), seed=seed, **more)  # type: ignore[arg-type]  # passed on


def paper_ceiling(effects: Effects | None = None, seed: int = 0) -> Ceiling:
    """The 16 lamps of the paper's room (Table 1) without the corridor's."""
    whole = building("paper_room")
    planned = tuple(f for f in fixtures(whole) if f.zone[0] == -5.0)
    return Ceiling(planned, whole.world, whole.height_m, effects or Effects(), seed=seed)


__all__ = ["IDEAL", "Ceiling", "Effects", "Photodiode", "ceiling_of", "paper_ceiling"]
