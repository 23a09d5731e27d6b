"""Scenarios of the integrity runs: what befalls a robot in a place, drawn by chance from a kind and a seed."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from estimator.cdma.epoch import LightEpoch
from estimator.light_filter.survey import Survey
from estimator.numerics import se2
from hal.odometry import RawOdometry
from tools.experiments.integrity import places
from tools.experiments.integrity.places import Place
from tools.sim.building.world import Array
from tools.sim.ceiling.ceiling import Ceiling, Effects
from tools.sim.ceiling.links import EPOCH_S, PERIOD_S, Links
from tools.sim.ceiling.movers import walkers_of
from tools.sim.ceiling.records import frames, light_epoch, survey
from tools.sim.robot.drive import Body, Drive, leans
from tools.sim.robot.odometry import Odometer, Wheels

SECONDS: Final = 62.0
SETTLED_S: Final = 10.0
"""From here on a drive counts: the first seconds are the start's."""
RATE_HZ: Final = 20.0
FIRST_S: Final = 0.2
"""Devices speak from here on."""


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """One drive from ``begin`` to ``end`` on the scenario's clock."""

    begin: float
    end: float
    drive: Drive


@dataclass(slots=True, eq=False)
class Scenario:
    """What happens.

    Attributes:
        kind, seed: what it was drawn from. place: where. legs: the way; between two the robot is carried, wheels still.
        lit, wheels: there are lamps and a photodiode; wheel odometry. beams, fov_deg: of the lidar.
        ceilings: (from when, lamps that shine from then on). told: what the robot knows of them.
        blind, dark: (from, to) when the lidar, the photodiode is covered.
        recoverable: (from, to) when the right place could be known. clean: nothing goes wrong at all.
        mount: from when the lidar's mount is turned: by an angle (rad) at once, and on by a rate (rad/s).
        restarts: when the daemon is switched off and on again with the map that it has made.
    """

    kind: str
    seed: int
    place: Place
    legs: tuple[Leg, ...]
    lit: bool
    wheels: bool
    beams: int = 181
    fov_deg: float = 270.0
    ceilings: tuple[tuple[float, Ceiling], ...] = ()
    told: Survey | None = None
    blind: tuple[tuple[float, float], ...] = ()
    dark: tuple[tuple[float, float], ...] = ()
    recoverable: tuple[tuple[float, float], ...] = ()
    clean: bool = False
    mount: tuple[float, float, float] = (np.inf, 0.0, 0.0)
    restarts: tuple[float, ...] = ()
    seconds: float = SECONDS
    notes: dict[str, object] = field(default_factory=dict)

    def pose(self, t: Array) -> Array:
        """(n, 3) true poses in the building's frame; carried from the end of a leg to the begin of the next."""
        t = np.atleast_1d(np.asarray(t, float))
        out = np.empty((len(t), 3))
        for number, leg in enumerate(self.legs):
            here = t >= leg.begin if number else np.ones(len(t), bool)
            out[here] = leg.drive.pose(np.minimum(t[here], leg.end) - leg.begin)
            if number:
                before = self.legs[number - 1]
                between = (t > before.end) & (t < leg.begin)
                if between.any():
                    ends = before.drive.pose(np.array([before.end - before.begin]))[0], leg.drive.pose(np.zeros(1))[0]
                    share = ((t[between] - before.end) / (leg.begin - before.end))[:, None]
                    out[between] = ends[0] + share * (ends[1] - ends[0])
        return out

    def turned(self, t: Array) -> Array:
        """(n,) yaw of the lidar less that of its configured mount, rad."""
        since, angle, rate = self.mount
        return np.where(t >= since, angle + rate * np.maximum(t - since, 0.0), 0.0)

    def tilt(self, t: float) -> tuple[float, float]:
        """Pitch and roll of the scan plane."""
        leg = next((leg for leg in reversed(self.legs) if t >= leg.begin), self.legs[0])
        return leg.drive.tilt(min(t, leg.end) - leg.begin)

    def odometry(self) -> Iterator[RawOdometry]:
        """Cumulative readings; while it is carried the wheels stand."""
        base = se2.identity()
        for number, leg in enumerate(self.legs):
            wheels = Wheels(rate_hz=RATE_HZ)
            odometer = Odometer(leg.drive, self.place.world, wheels, self.seed)  # the same wheels in every leg
            until = self.legs[number + 1].begin if number + 1 < len(self.legs) else self.seconds
            now = base
            for k in range(round((until - leg.begin) * RATE_HZ)):
                t = leg.begin + k / RATE_HZ
                if t <= leg.end:
                    now = se2.compose(base, np.asarray(odometer.reading(k)))
                if t >= FIRST_S:
                    yield RawOdometry(t + 0.004, t, float(now[0]), float(now[1]), float(now[2]))
            base = now

    def light(self) -> Iterator[LightEpoch]:
        """Decoded light, block by block."""
        begin = np.arange(FIRST_S, self.seconds - EPOCH_S, PERIOD_S)
        middle = begin + 0.5 * EPOCH_S
        poses, sight = self.pose(middle), np.ones(len(begin))
        for since, until in self.dark:
            sight[(middle >= since) & (middle < until)] = 0.0
        shining = [ceiling.amplitudes(poses, middle) * sight[:, None] for _, ceiling in self.ceilings]
        decoders = [(Links(ceiling, None, self.seed), frames(ceiling)) for _, ceiling in self.ceilings]
        for k, t in enumerate(begin.tolist()):
            number = max(n for n, (since, _) in enumerate(self.ceilings) if n == 0 or t >= since)
            links, said = decoders[number]
            yield light_epoch(self.ceilings[number][1], links.report(t, t + EPOCH_S, shining[number][k]), said)


Make = Callable[[np.random.Generator], Scenario]


def draw(kind: str, seed: int) -> Scenario:
    """The scenario of a kind and a seed; raises KeyError for a kind that there is not."""
    rng = np.random.default_rng((zlib.crc32(kind.encode()), seed))
    return KINDS[kind](kind, seed, rng)


def _lit(kind: str) -> bool:
    return not kind.endswith("_unlit")


def _begin(kind: str, seed: int, rng: np.random.Generator, place: Place, wheels: float = 0.7) -> Scenario:
    """One drive through a place, with or without lamps as the kind says, with wheels by chance."""
    drive = Drive(place.route(rng), Body(speed=float(rng.uniform(0.35, 0.8))), float(rng.uniform(1.0, 4.0)))
    beams, fov = ((91, 180.0), (181, 180.0), (181, 270.0))[int(rng.integers(0, 3))]
    made = Scenario(
        kind, seed, place, (Leg(0.0, SECONDS, drive),), _lit(kind), bool(rng.random() < wheels), beams, fov,
        recoverable=((SETTLED_S, SECONDS),),
    )  # fmt: skip
    return _light_up(made, rng) if made.lit else made


def _light_up(made: Scenario, rng: np.random.Generator) -> Scenario:
    """Hang the lamps: each a little different from the plan, the robot's body swaying."""
    effects = Effects(gain_spread=float(rng.uniform(0.02, 0.08)), rho=float(rng.uniform(0.3, 0.7)))
    ceiling = Ceiling(made.place.lamps, made.place.world, 3.0, effects, seed=made.seed)
    ceiling.lean = lambda t: leans(made.legs[0].drive, t)
    if made.place.walkers:
        ceiling.movers = walkers_of(made.place.walkers)
    made.ceilings, made.told = ((0.0, ceiling),), survey(ceiling)
    return made


def _clean(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    office = rng.random() < 0.2 and not _lit(kind)  # see _kidnap
    place = places.office(rng) if office else places.room(rng, people=int(rng.integers(0, 2)))
    made = _begin(kind, seed, rng, place)
    made.clean = True
    return made


def _kidnap(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    """Carried off in the middle of the drive, at once or for some seconds, the lidar open or covered meanwhile."""
    place = places.office(rng) if rng.random() < 0.3 else places.room(rng)
    made = _begin(kind, seed, rng, place)
    at = float(rng.uniform(18.0, 35.0))
    took = 0.0 if rng.random() < 0.4 else float(rng.uniform(0.5, 6.0))
    second = Drive(place.route(rng), made.legs[0].drive.body, float(rng.uniform(0.0, 3.0)))
    made.legs = (replace(made.legs[0], end=at), Leg(at + took, SECONDS, second))
    if took and rng.random() < 0.5:
        made.blind = ((at, at + took),)
    known = at + took + 12.0
    made.recoverable = ((SETTLED_S, at), (known, SECONDS)) if made.lit else ((SETTLED_S, at),)
    if made.lit and len(place.lamps) > 60:  # an office: one row of lamps above a corridor does not tell its sides
        made.recoverable = ()
    made.notes = {"at": at, "took": took, "covered": bool(made.blind)}
    return made


def _corridor(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    made = _begin(kind, seed, rng, places.corridor(rng), wheels=0.5)
    made.recoverable = ((20.0, SECONDS),) if made.lit and made.wheels else ()
    return made


def _glass(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    return _begin(kind, seed, rng, places.room(rng, glass=True))


def _crowd(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    return _begin(kind, seed, rng, places.room(rng, people=int(rng.integers(4, 11))))


def _symmetric(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    """Half of them are carried off to where the room looks alike."""
    made = _begin(kind, seed, rng, places.symmetric_room(rng))
    if rng.random() < 0.5:
        at = float(rng.uniform(18.0, 35.0))
        second = Drive(made.place.route(rng), made.legs[0].drive.body, float(rng.uniform(0.0, 3.0)))
        made.legs = (replace(made.legs[0], end=at), Leg(at, SECONDS, second))
        made.recoverable = ((SETTLED_S, at), (at + 12.0, SECONDS)) if made.lit else ((SETTLED_S, at),)
        made.notes = {"at": at}
    return made


def _false_lights(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    """A lamp hangs elsewhere, two have changed their codes, or a lamp shines that nobody surveyed; always, or later."""
    place = places.room(rng) if rng.random() < 0.75 else places.symmetric_room(rng)
    made = _begin(kind, seed, rng, place)
    right = made.ceilings[0][1]
    what = str(rng.choice(["moved", "exchanged", "extra", "twin"]))
    ids = [lamp.lamp_id for lamp in right.fixtures]
    one, two = (int(k) for k in rng.permutation(len(ids))[:2])
    if what == "moved":
        by = rng.uniform(0.7, 3.0) * np.exp(1j * rng.uniform(0.0, 6.28))
        wrong = right.moved(ids[one], (float(by.real), float(by.imag)))
    else:
        planned = list(right.fixtures)
        if what == "exchanged":
            a, b = planned[one], planned[two]
            planned[one], planned[two] = replace(a, code=b.code), replace(b, code=a.code)
        else:
            zone = planned[0].zone
            x, y = float(rng.uniform(zone[0] + 0.5, zone[2] - 0.5)), float(rng.uniform(zone[1] + 0.5, zone[3] - 0.5))
            code = planned[one].code if what == "twin" else 128
            planned.append(replace(planned[one], x=x, y=y, lamp_id=900, code=code))
        wrong = Ceiling(tuple(planned), right.world, 3.0, right.effects, seed=made.seed, lean=right.lean)
    since = 0.0 if rng.random() < 0.5 else float(rng.uniform(15.0, 40.0))
    made.ceilings = ((0.0, wrong),) if since == 0.0 else ((0.0, right), (since, wrong))
    made.notes = {"what": what, "since": since}
    return made


def _dead_lamps(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    """A third to all of the lamps are dark, from the start or from some time on."""
    made = _begin(kind, seed, rng, places.room(rng))
    ceiling = made.ceilings[0][1]
    share = float(rng.choice([0.3, 0.5, 0.7, 1.0]))
    for lamp in ceiling.fixtures:
        if rng.random() < share:
            ceiling.switch_off(lamp.lamp_id, 0.0 if share < 1.0 and rng.random() < 0.5 else float(rng.uniform(12, 40)))
    made.recoverable = ((SETTLED_S, SECONDS),) if share <= 0.3 else ()
    made.notes = {"share": share}
    return made


def _covered(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    """The photodiode, the lidar, or both are covered for a while; sometimes the robot is carried off meanwhile."""
    made = _begin(kind, seed, rng, places.room(rng))
    at, lasts = float(rng.uniform(15.0, 30.0)), float(rng.uniform(3.0, 15.0))
    which = int(rng.integers(0, 3))
    made.dark = ((at, at + lasts),) if which != 1 else ()
    made.blind = ((at, at + lasts),) if which != 0 else ()
    if which == 2 and rng.random() < 0.5:
        second = Drive(made.place.route(rng), made.legs[0].drive.body, 1.0)
        made.legs = (replace(made.legs[0], end=at + 0.3 * lasts), Leg(at + 0.7 * lasts, SECONDS, second))
    made.recoverable = ((SETTLED_S, at), (at + lasts + 12.0, SECONDS))
    made.notes = {"at": at, "lasts": lasts, "which": ("photodiode", "lidar", "both")[which], "legs": len(made.legs)}
    return made


def _restart(kind: str, seed: int, rng: np.random.Generator) -> Scenario:
    """Switched off after a drive and on again with the map of it: where it was, or carried to another place."""
    place = (places.room, places.symmetric_room, places.office)[int(rng.choice(3, p=[0.6, 0.25, 0.15]))](rng)
    made = _begin(kind, seed, rng, place)
    at, seconds = float(rng.uniform(30.0, 40.0)), 100.0
    made.seconds, made.restarts = seconds, (at,)
    if rng.random() < 0.7:
        second = Drive(place.route(rng), made.legs[0].drive.body, float(rng.uniform(0.5, 2.0)))
        made.legs = (replace(made.legs[0], end=at), Leg(at, seconds, second))
    else:
        made.legs = (replace(made.legs[0], end=seconds),)
    after = ((at + 12.0, seconds),) if made.lit else ()
    made.recoverable = () if len(place.lamps) > 60 else ((SETTLED_S, at), *after)
    made.notes = {"at": at, "carried": len(made.legs) > 1}
    return made


Draw = Callable[[str, int, np.random.Generator], Scenario]

KINDS: Final[dict[str, Draw]] = {
    "clean_lit": _clean,
    "clean_unlit": _clean,
    "kidnap_lit": _kidnap,
    "kidnap_unlit": _kidnap,
    "corridor_lit": _corridor,
    "corridor_unlit": _corridor,
    "glass_lit": _glass,
    "glass_unlit": _glass,
    "crowd_lit": _crowd,
    "crowd_unlit": _crowd,
    "symmetric_lit": _symmetric,
    "symmetric_unlit": _symmetric,
    "false_lights": _false_lights,
    "dead_lamps": _dead_lamps,
    "covered": _covered,
    "restart_lit": _restart,
    "restart_unlit": _restart,
}
