"""Snapshot builder: one step's result with its age, the pose predicted to now, and the published state."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from daemon.integrity.state_memory import Memory
from daemon.snapshot import (
    LISTED_DIMMED,
    LISTED_LINKS,
    Condition,
    CycleTiming,
    DimmedLamp,
    LightFix,
    LightLink,
    LightPicture,
    LinkUse,
    LoopReason,
    Snapshot,
    Trust,
)
from estimator import Array, Fix, Link, LinkState, Loop, StepResult, se2
from estimator import LoopReason as Why

Triple = tuple[float, float, float]

UNHEARD: Final = (LinkState.FAINT, LinkState.MISSING)
"""Link states of lamps that are listed and not received."""
NO_TRUST: Final = Trust()
USES: Final = {state: LinkUse.__members__.get(state.name, LinkUse.OTHER) for state in LinkState}
LOOPS: Final = {why: LoopReason.__members__.get(why.name, LoopReason.OTHER) for why in Why}
LONGEST_CARRY_PERIODS: Final = 3.0
"""Scan periods over which the velocity extrapolates the pose; beyond, there is no prediction."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What the daemon adds to the estimate; see `Snapshot` for the meaning of each."""

    t_mono: float = 0.0
    t_utc: float = 0.0
    period: float = 0.1
    scan_rate: float | None = None
    missed: int = 0
    overruns: int = 0
    cycle_us: int | None = None
    lidar_ok: bool | None = None
    adc_ok: bool | None = None
    blocks: int = 0
    blocks_lost: int = 0
    odometry_ok: bool | None = None
    fault: int = 0
    trust: Trust = NO_TRUST
    condition: Condition | None = None
    pulse: CycleTiming | None = None


@dataclass(slots=True)
class SnapshotBuilder:
    """Numbers the snapshots and stores the latest loop closure.

    Attributes:
        map_id: identity of the map frame, 0: not known. loop_seen: loops acknowledged by a client, modulo 65536.
    """

    map_id: int = 0
    loop_seen: int = 0
    _seq: int = 0
    _loop: Loop | None = None
    _links: tuple[tuple[Link, ...], tuple[LightLink, ...]] = ((), ())

    def on_loops_seen(self, counter: int) -> None:
        """Stores the number of loops that a client has acknowledged; see `Snapshot.loop_latched`."""
        self.loop_seen = counter

    def build(self, result: StepResult | None, verdict: Memory, facts: Facts) -> Snapshot:
        """Returns a snapshot of this cycle."""
        self._seq += 1
        if result is not None and result.loop is not None:
            self._loop = result.loop
        loop = self._loop
        estimate = None if result is None or not math.isfinite(result.t_mono) else result
        guessed = estimate is not None and estimate.places is not None  # an unconfirmed pose has no known covariance
        received = _received(result, facts)
        return Snapshot(
            seq=self._seq,
            t_mono=facts.t_mono if estimate is None else estimate.t_mono,
            t_sent=facts.t_mono,
            t_utc=facts.t_utc,
            state=verdict.state,
            reason=verdict.reason,
            pose=None if estimate is None else _pose(estimate),
            odom=None if estimate is None else _triple(estimate.T_odom_base),
            predicted=None if estimate is None else _predicted(estimate, facts),
            covariance=None if estimate is None or guessed else _upper(_aged(estimate, facts)),
            velocity=None if estimate is None else _triple(estimate.velocity),
            known=(False, False, False) if guessed else verdict.known,
            jumps=0 if estimate is None else estimate.jumps,
            map_id=self.map_id,
            loop_counter=0 if loop is None else loop.counter,
            loop_latched=loop is not None and loop.counter % 2**16 != self.loop_seen,
            loop_new=None if loop is None else loop.keyframe_new,
            loop_old=None if loop is None else loop.keyframe_old,
            loop_reason=None if loop is None else LOOPS[loop.reason],
            loop_residual=None if loop is None else loop.residual_m,
            links=None if facts.adc_ok is None else len(received),
            light_id=received[0].lamp_id if received else None,
            light=None if facts.adc_ok is None else _light(result, facts, self._shown(result)),
            scan_rate=facts.scan_rate,
            missed=facts.missed,
            overruns=facts.overruns,
            cycle_us=facts.cycle_us,
            lidar_ok=facts.lidar_ok,
            adc_ok=facts.adc_ok,
            odometry_ok=facts.odometry_ok,
            fault=facts.fault,
            trust=facts.trust,
            condition=facts.condition,
            pulse=facts.pulse,
        )

    def _shown(self, result: StepResult | None) -> tuple[LightLink, ...]:
        """Returns the first links as they are published, cached: every other cycle has no new ones."""
        links = () if result is None or result.lights is None else result.lights.links
        if links is not self._links[0]:
            self._links = links, tuple([_link(link) for link in links[:LISTED_LINKS]])
        return self._links[1]


def _received(result: StepResult | None, facts: Facts) -> list[Link]:
    """Returns the links above the noise, largest RSS first; empty while no samples arrive."""
    if result is None or result.lights is None or not facts.adc_ok:
        return []
    return [link for link in result.lights.links if link.state not in UNHEARD]


def _light(result: StepResult | None, facts: Facts, links: tuple[LightLink, ...]) -> LightPicture:
    """Returns the light solution; without samples only the block counts, however good the fix was before."""
    if result is None or result.lights is None or not facts.adc_ok:
        return LightPicture(blocks=facts.blocks, blocks_lost=facts.blocks_lost)
    lights = result.lights
    placed = lights.fix not in (Fix.NONE, Fix.LOST)
    sigma = [math.sqrt(variance) if variance >= 0.0 else math.nan for variance in lights.covariance.diagonal().tolist()]
    return LightPicture(
        fix=LightFix[lights.fix.name],
        used=len(lights.accepted),
        t_mono=lights.t_mono if math.isfinite(lights.t_mono) else None,
        pose=_triple(lights.T_map_base) if placed else None,
        sigma=(sigma[0], sigma[1], sigma[2]) if placed else None,
        floor=lights.floor,
        clock_ppm=lights.clock_ppm,
        blocks=facts.blocks,
        blocks_lost=facts.blocks_lost,
        links=links,
        dimmed=tuple([DimmedLamp(lamp.hertz, lamp.swing_a, lamp.other_hertz) for lamp in lights.pwm[:LISTED_DIMMED]]),
    )


def _link(link: Link) -> LightLink:
    return LightLink(link.code, link.lamp_id, USES[link.state], link.amplitude, link.residual)


def _pose(result: StepResult) -> Triple:
    return _triple(se2.compose(result.T_map_odom, result.T_odom_base))


def _aged(result: StepResult, facts: Facts) -> Array:
    """Returns the covariance at the present time.

    Without input the robot may have moved; the next step uses the same growth.
    """
    from estimator import LARGEST_TURN, LONGEST_CARRY_S, UNSEEN  # loaded by the warm-up

    unseen = facts.t_mono - result.t_mono - LONGEST_CARRY_S
    if unseen <= 0.0:
        return result.covariance
    grown: Array = np.diag(np.minimum((UNSEEN * unseen) ** 2, (math.inf, math.inf, LARGEST_TURN**2)))
    return result.covariance + grown


def _predicted(result: StepResult, facts: Facts) -> Triple | None:
    """Returns the pose predicted to now at constant velocity; None if the velocity is too old."""
    ahead = facts.t_mono - result.t_mono
    if ahead > LONGEST_CARRY_PERIODS * facts.period:
        return None
    moved = se2.exp(result.velocity * max(0.0, ahead))
    return _triple(se2.compose(se2.compose(result.T_map_odom, result.T_odom_base), moved))


def _triple(values: Array) -> Triple:
    x, y, yaw = values.tolist()
    return (x, y, yaw)


def _upper(P: Array) -> tuple[float, float, float, float, float, float]:
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = P.tolist()
    return (xx, xy, yy, xt, yt, tt)
