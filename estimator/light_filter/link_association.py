"""Data association of links: the lamp of each link, missing lamps, and lamps stronger than possible."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Final

from estimator.cdma.epoch import LightEpoch, LinkFlag
from estimator.light_filter import state_vector
from estimator.light_filter.filter_state import Lights, Track
from estimator.light_filter.survey import Lamp
from estimator.numerics.arrays import Array
from estimator.result import Fix, Link, LinkState

ACCEPTED, FAINT, TWIN, UNSURVEYED = LinkState.ACCEPTED, LinkState.FAINT, LinkState.TWIN, LinkState.UNSURVEYED
FAINT_FLAG, TWIN_FLAG = int(LinkFlag.FAINT), int(LinkFlag.TWIN)  # enum lookups would be half the time of an update

TWIN_SHARE = 0.1
"""Relative RSS from which a second lamp of the same code contributes to a link."""
NO_LIGHT_A = 1e-15
"""RSS (A) below which a value is rounding: one electron in a block is more."""
ABSENT_S, ABSENT_M = 5.0, 1.0
"""A lamp is missing if not received for `ABSENT_S` (s) and over this path length (m); people in the way move on."""
WELL_INSIDE = 0.7
"""Share of the radius of the field of view within which a lamp should be received."""
NEARER_M: Final = 1.0
"""Margin of the position (m) in the test for too strong lamps."""
STRONGER: Final = 2.0
"""Factor over the largest possible RSS within `NEARER_M` of a position from which a lamp is not received there."""


@dataclass(slots=True, eq=False)
class Sight:
    """One link of an epoch as associated by a hypothesis; the fields are those of `result.Link`."""

    code: int
    amplitude: float
    variance: float
    state: LinkState = UNSURVEYED
    lamp: Lamp | None = None
    contradicted: bool = False
    slot: int = -1
    residual: float | None = None
    sigma: float | None = None

    def link(self, learned: Learned) -> Link:
        """The published link; ``learned``: gains of the hypothesis."""
        known = self.lamp is not None and self.state is not TWIN
        link_id = self.lamp.lamp_id if self.lamp is not None and known else None
        gain, spread = learned.gain(self.slot)
        sigma = math.sqrt(max(spread, 0.0))
        residual, of_it = self.residual, self.sigma
        return Link(self.code, link_id, self.state, self.amplitude, residual, of_it, gain, sigma, self.contradicted)


class Learned:
    """Lamp gains of a hypothesis; ``track`` None: no hypothesis."""

    def __init__(self, track: Track | None) -> None:
        """Convert the arrays to lists at once: reading one number costs as much as reading all."""
        self._x: list[float] = []
        if track is not None:  # includes unused slots: the hypothesis may be newer than the sights
            self._x = track.x.tolist()
            self._variance, self._common = track.P.diagonal().tolist(), track.P[state_vector.COMMON].tolist()

    def gain(self, slot: int) -> tuple[float, float]:
        """Gain (ln) of the lamp in a slot (-1: none), common gain included, and its variance."""
        if slot < 0 or not self._x:
            return 0.0, 0.0
        at = state_vector.FIRST + state_vector.OWN * slot
        spread = self._variance[at] + self._variance[state_vector.COMMON] + 2.0 * self._common[at]
        return self._x[at] + self._x[state_vector.COMMON], spread


def sights(lights: Lights, epoch: LightEpoch, x: float, y: float) -> list[Sight]:
    """Links of an epoch, each with its lamp for a receiver near (x, y) in m, strongest first."""
    rows = zip(
        epoch.ids.tolist(),
        epoch.amplitude.tolist(),
        epoch.variance.tolist(),
        epoch.flags.tolist(),
        epoch.lamps,
        repeat(0.0, len(epoch.ids)) if epoch.relative_var is None else epoch.relative_var.tolist(),
        strict=True,
    )
    found = []
    for code, amplitude, variance, flags, frame, relative_var in rows:
        if not (NO_LIGHT_A < amplitude < math.inf and variance >= 0.0):
            found.append(Sight(code, 0.0, math.inf, FAINT))
            continue
        sight = Sight(code, amplitude, variance)
        found.append(sight)
        if frame is not None:
            sight.lamp, sight.contradicted = lights.catalogue.learn(frame, code, lights.course.t_mono)
            alone = True
        else:
            sight.lamp, alone = nearest(lights, code, x, y)
            alone = alone and not flags & TWIN_FLAG
            if sight.lamp is not None:
                lights.catalogue.touch(sight.lamp.lamp_id, lights.course.t_mono)
        if sight.lamp is None:
            continue
        noise_var = max(variance - relative_var * amplitude**2, 0.0)
        if flags & FAINT_FLAG or amplitude <= lights.settings.faint * math.sqrt(noise_var):
            sight.state = FAINT
        else:
            sight.state = ACCEPTED if alone else TWIN
    found.sort(key=lambda sight: -sight.amplitude)
    return found


def nearest(lights: Lights, code: int, x: float, y: float) -> tuple[Lamp | None, bool]:
    """Lamp of a code nearest to a position, and whether the link can come from it alone."""
    lamps = lights.catalogue.candidates(code)
    if len(lamps) < 2:
        return (lamps[0], True) if lamps else (None, True)
    ranked = sorted(lamps, key=lambda lamp: -below(lights, lamp, x, y))
    first, second = (below(lights, lamp, x, y) for lamp in ranked[:2])
    return ranked[0], second < TWIN_SHARE * first


def below(lights: Lights, lamp: Lamp, x: float, y: float) -> float:
    """Approximate RSS of a lamp at a position, level and without field of view; only ranks lamps."""
    receiver = lights.survey.receiver
    h2 = max(lamp.z - receiver.z, 0.1) ** 2
    d2 = h2 + (lamp.x - x) ** 2 + (lamp.y - y) ** 2
    fall = math.pow(h2 / d2, 0.5 * (lamp.order + receiver.order))
    return lamp.power_w * fall / d2


def absent(lights: Lights, links: list[Link], pose: Array, fix: Fix) -> list[Link]:
    """The links, with an entry of RSS 0 for every missing surveyed lamp; tested only with `Fix.GOOD`."""
    if fix is not Fix.GOOD:
        return links
    now, way, x, y = lights.course.t_mono, lights.course.way, float(pose[0]), float(pose[1])
    heard = {link.lamp_id for link in links if link.state is not LinkState.FAINT}
    unsure = {link.code for link in links if link.lamp_id is None}
    receiver = lights.survey.receiver
    slope = WELL_INSIDE * math.tan(min(receiver.half_fov_rad, 1.3))
    missing = set()
    for lamp_id in lights.catalogue.surveyed:
        lamp = lights.catalogue.by_id[lamp_id]
        if lamp_id in heard or lamp.code in unsure:
            lights.absent.pop(lamp_id, None)
        elif math.hypot(lamp.x - x, lamp.y - y) < slope * (lamp.z - receiver.z):
            t, begun = lights.absent.setdefault(lamp_id, (now, way))
            if now - t > ABSENT_S and way - begun > ABSENT_M:
                missing.add(lamp_id)
    known = [replace(k, state=LinkState.MISSING) if k.lamp_id in missing else k for k in links]
    faint = {link.lamp_id for link in links}
    extra = [Link(lights.catalogue.by_id[i].code, i, LinkState.MISSING, 0.0) for i in sorted(missing - faint)]
    return known + extra


def strong_at(lights: Lights, epoch: LightEpoch, x: float, y: float) -> list[bool]:
    """For each lamp of an epoch, whether it is stronger than possible near a position of the receiver (m)."""
    return [
        too_strong(lights, sight.lamp, sight.amplitude, x, y)
        for sight in sights(lights, epoch, x, y)
        if sight.state is LinkState.ACCEPTED and sight.lamp is not None
    ]


def too_strong(lights: Lights, lamp: Lamp, amplitude: float, x: float, y: float) -> bool:
    """Whether a lamp is received in line of sight, and stronger than possible near a position of the receiver (m).

    A learned gain below the survey is not applied. An obstacle may have dimmed the lamp while its gain was learned.
    """
    rx = lights.survey.receiver
    h = max(lamp.z - rx.z, 0.1)
    away = max(math.hypot(lamp.x - x, lamp.y - y) - NEARER_M, 0.0)
    fall = h / math.hypot(h, away) / math.cos(min(rx.half_fov_rad, 1.5))
    known = lights.gains.get(lamp.lamp_id)
    rim = lights.catalogue.rims[lamp.lamp_id] * (1.0 if known is None else math.exp(max(float(known[0][0]), 0.0)))
    return amplitude > rim * max(1.0, STRONGER * math.pow(fall, lamp.order + rx.order + 2.0))
