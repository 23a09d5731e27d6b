"""Text report of `lumiloop why`: state, reason, disagreeing solutions, known axes, lamps, and preceding changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np

from daemon.diagnosis.moment import SECOND_S, Moment, chosen, clock, end_of, faults_changed, of_day
from daemon.health.faults import FAULTS, Fault
from daemon.health.reasons import REASONS, Reason
from daemon.publish.meanings import USES
from daemon.snapshot import LightLink, LinkUse, Snapshot, State
from estimator import Array, se2

AXES: Final = ("x", "y", "heading")
GAP: Final = 16.27
"""Squared Mahalanobis distance of three components beyond chance (1 in 1000)."""
GONE: Final = (Reason.LIDAR_SILENT, Reason.LIDAR_UNREACHABLE)
"""Reasons published while the lidar is without data or not steady again, whichever solution holds the pose."""
MOST: Final = 12
"""Changes that are listed; beyond that, those of state and faults, and the latest of all others."""
AGAINST: Final = (LinkUse.OCCLUDED, LinkUse.REJECTED)
"""Link uses whose RSS is, or was a moment ago, inconsistent with the pose."""
FITS: Final = 0.2
"""Residual (ln) below which the RSS is consistent."""


def report(told: Sequence[Moment], utc: float, where: str, wide: float, second: bool = False, made: str = "") -> str:
    """Returns the text for a time that lasts from ``utc`` for ``wide``, s (:func:`daemon.diagnosis.moment.chosen`).

    ``second``: a whole second, of which the first change is reported. ``made``: lines on the software that made the
    recording and on its clock, where needed.
    """
    k, last, changed = chosen(told, utc, second, wide)
    one, begun, apart = told[k], clock(utc), told[k].utc - utc
    when = begun
    if second:
        begun, meant = _named(utc, wide)
        when = f"{begun}, {meant}: {_change(one.utc - end_of(utc, wide), changed)}"
    if apart > SECOND_S and changed is None:
        when = f"{begun}, before the first cycle, which ran {apart:.0f} s later"
    elif apart < -SECOND_S:
        when = f"{begun}, without a cycle; the last one before ran {-apart:.0f} s earlier"
    lines = [f"{when}, cycle of {of_day(one.utc)}, {where}", *([made] if made else []), *_state(told, k)]
    lines += ["", "solutions", *(f"  {line}" for line in _witnesses(told, k))]
    lines += ["", "axes", *(f"  {line}" for line in _axes(told, k))]
    if one.snapshot.light is not None:
        lines += ["", "lamps", *(f"  {line}" for line in _lamps(told, k))]
    first = f"{max(0.0, utc - told[0].utc):.0f} s before"
    lines += ["", f"what changed in the {first}{' and in this second, or just after it' if second else ''}"]
    lines += [f"  {line}" for line in _listed(list(_changes(told[: last + 1])))] or ["  nothing"]
    return "\n".join(lines) + "\n"


def _named(utc: float, wide: float) -> tuple[str, str]:
    """Returns the printed form of a second that begins at ``utc`` and lasts ``wide``, s, and its description."""
    if utc.is_integer():
        return clock(utc, whole=True), "the whole second"
    return clock(utc), "the second after it" if wide >= SECOND_S else "the rest of that second"


def _change(after_s: float, changed: int | None) -> str:
    """Describes the reported change of a whole second; ``after_s``: from its end, negative within it."""
    if changed is None:
        return "no change of state, reason or faults in it"
    if after_s < 0.0:
        return "first change of state, reason or faults in it"
    return f"no change of state, reason or faults in it; a change {after_s:.2f} s after it"


def _state(told: Sequence[Moment], k: int) -> Iterator[str]:
    one = told[k]
    since = _since(told, k, lambda moment: (moment.state, moment.reason))
    yield f"{one.state.name} since {since}: {_because(one.reason)}{_in_brackets(REASONS[one.reason][1])}"
    for fault in one.faults:
        text, remedy = _fault(fault)
        yield f"fault {fault} since {_since(told, k, partial(_has, fault))}: {text}{_in_brackets(remedy)}"
    again = one.snapshot.state, Reason(one.snapshot.reason)
    if one.told is not None and one.told not in Reason._value2member_map_:
        yield f"(newer software published reason {one.told}, which is unknown here; this is the replay's reason)"
    if again != (one.state, one.reason):
        yield f"(this was published; the replay gives {again[0].name}: {_because(again[1])})"
    if one.told is None:
        yield "(the recording has no published reason and faults; the reason is the replay's, and faults are unknown)"
    if one.snapshot.pose is not None:
        x, y, yaw = one.snapshot.pose
        said = f"pose {x:.3f} {y:.3f} m, {math.degrees(yaw):.1f} deg"
        if one.snapshot.covariance is not None:
            xx, _, yy, *_, tt = one.snapshot.covariance
            said += f"; sigma {math.sqrt(max(xx, yy)):.3f} m, {math.degrees(math.sqrt(tt)):.2f} deg"
        trust = one.snapshot.trust
        if trust.horizontal_m is not None:
            used = (("lidar", trust.laser), ("light", trust.light), ("odometry", trust.wheels))
            rests = [name for name, bound in used if bound]
            said += f"; protection level {trust.horizontal_m:.2f} m by {', '.join(rests)}"
        yield said
    if one.snapshot.trust.places is not None:
        yield f"relocalisation: {one.snapshot.trust.places} hypotheses"


def _because(reason: Reason) -> str:
    """Returns a reason with its published number."""
    return f"reason {int(reason)}, {REASONS[reason][0]}" if reason else REASONS[reason][0]


def _in_brackets(remedy: str) -> str:
    return f" ({remedy})" if remedy else ""


def _fault(number: int) -> tuple[str, str]:
    """Returns meaning and remedy of a fault; newer software may have recorded one that is not known here."""
    return FAULTS[Fault(number)] if number in Fault._value2member_map_ else ("unknown to this version", "")


def _has(fault: int, one: Moment) -> bool:
    return fault in one.faults


def _since(told: Sequence[Moment], k: int, what: Callable[[Moment], object]) -> str:
    """Returns the time of day since which a value has been what it is at ``k``."""
    now = what(told[k])
    begin = k
    while begin > 0 and what(told[begin - 1]) == now:
        begin -= 1
    return f"before {of_day(told[0].utc)}" if begin == 0 else of_day(told[begin].utc)


def _witnesses(told: Sequence[Moment], k: int) -> Iterator[str]:
    yield _laser(told, k)
    yield _wheels(told[k])
    if told[k].snapshot.light is not None:
        yield _light(told[k])


def laser_dissents(one: Moment) -> bool:
    """True if the scan match of this cycle failed."""
    match = None if one.result is None else one.result.match
    return one.scan is not None and one.fresh and match is not None and not match.ok


def _laser(told: Sequence[Moment], k: int) -> str:
    latest = next((one for one in reversed(told[: k + 1]) if one.scan is not None and one.fresh), None)
    if latest is None or latest.result is None or latest.result.match is None:
        return "lidar    no scan in this time"
    match, ago = latest.result.match, told[k].utc - latest.utc
    when = f", {ago:.2f} s ago" if ago > 0.3 else ""
    gone = told[k].state is State.NO_LIDAR or told[k].reason in GONE
    silent = latest is not told[k] and told[k].snapshot.lidar_ok is False
    before = f"no data for {ago:.{1 if ago >= 1.0 else 2}f} s; before: "
    if not match.ok:
        said = f"without a match: {match.reason.value} ({match.queries} points)"
        return f"lidar    {before}a scan {said}" if silent else f"lidar    DISAGREES: a scan{when} {said}"
    x, y, yaw = match.correction.tolist()
    moved = f"moved the prediction by {1e3 * math.hypot(x, y):.0f} mm, {math.degrees(yaw):.2f} deg"
    fit = f"{match.inliers} of {match.queries} points fit, residual {1e3 * match.residual_m:.0f} mm"
    word = before if silent else f"matches{' again, not steady yet' if gone else when}: "
    return f"lidar    {word}{fit}, {moved}"


def _wheels(one: Moment) -> str:
    said = one.wheels
    if one.snapshot.odometry_ok is None:
        return "odometry not configured"
    if one.snapshot.odometry_ok is False:
        return "odometry without data"
    if said is None:
        return "odometry cannot be compared with the lidar, which needs two seconds of both with all axes known"
    told, seen = _motion(said.wheels), _motion(said.laser)
    away_m, away_rad = said.apart
    apart = f"{away_m:.2f} m, {math.degrees(away_rad):.1f} deg apart"
    word = "agrees with the lidar" if said.agree else "DISAGREES"
    return f"odometry {word}: in {said.seconds:.1f} s odometry moved {told}, the lidar {seen}; {apart}"


def _motion(T: Array) -> str:
    x, y, yaw = T.tolist()
    return f"{math.hypot(x, y):.2f} m, {math.degrees(yaw):.1f} deg"


def light_apart(one: Moment) -> tuple[float, float] | None:
    """Returns the separation of the light solution from the pose, m and rad; None without a light solution."""
    light, pose = one.snapshot.light, one.snapshot.pose
    if light is None or light.pose is None or pose is None:
        return None
    x, y, yaw = se2.between(np.array(pose), np.array(light.pose)).tolist()
    return math.hypot(x, y), abs(yaw)


def _light(one: Moment) -> str:
    light = one.snapshot.light
    assert light is not None
    if one.snapshot.adc_ok is False:
        return "light    without data: no samples arrive"
    away, gap = light_apart(one), one.snapshot.trust.gap
    if away is None:
        return f"light    has no solution ({light.fix.name}, {light.used} lamps used)"
    far = f"its position is {away[0]:.2f} m, {math.degrees(away[1]):.1f} deg from the pose"
    against = sum(link.use in AGAINST for link in light.links)
    used = f"{light.fix.name}, {light.used} lamps used" + (
        f", {against} are inconsistent with the pose" if against else ""
    )
    if gap is None:
        return f"light    {used}; {far}"
    word = "DISAGREES" if gap > GAP or against > light.used else "agrees"
    return f"light    {word}: {far}, {math.sqrt(gap):.1f} sigma; {used}"


def _axes(told: Sequence[Moment], k: int) -> Iterator[str]:
    for axis, name in enumerate(AXES):
        since = _since(told, k, partial(_known, axis))
        yield f"{name:8}{'known' if told[k].snapshot.known[axis] else 'UNKNOWN'} since {since}"
    result = told[k].result
    match = None if result is None else result.match
    if match is not None and match.ok and len(blind := match.blind_directions()):
        said = "; ".join(_direction(row) for row in blind.tolist())
        yield f"this scan does not determine the pose {said} (odom frame)"


def _known(axis: int, one: Moment) -> bool:
    return one.snapshot.known[axis]


def _direction(row: list[float]) -> str:
    x, y, turn = row
    if abs(turn) > 0.7:
        return "in heading"
    return f"along {math.degrees(math.atan2(y, x)) % 180.0:.0f} deg"


def _lamps(told: Sequence[Moment], k: int) -> Iterator[str]:
    light = told[k].snapshot.light
    assert light is not None
    if not light.links:
        yield "none is received"
    for use in LinkUse:
        links = [link for link in light.links if link.use is use]
        if links:
            said = ", ".join(map(_link, links))
            yield f"{len(links)} {use.name}: {USES[use]}: {said}"


def _link(link: LightLink) -> str:
    name = f"code {link.code}" if link.lamp_id is None else f"lamp {link.lamp_id}"
    if link.residual is None:
        return name
    again = "; consistent again, used if this continues" if link.use in AGAINST and abs(link.residual) < FITS else ""
    return f"{name} ({math.exp(link.residual):.2f} of expected{again})"


def _listed(changes: list[tuple[bool, str]]) -> Iterator[str]:
    """Returns the changes that there is room for; changes of lamps must not displace a fault."""
    minor = [k for k, (grave, _) in enumerate(changes) if not grave]
    out = set(minor[: max(0, len(changes) - MOST)])
    if out:
        yield f"... {len(out)} more, of axes, solutions, lamps"
    yield from (text for k, (_, text) in enumerate(changes) if k not in out)


def _changes(told: Sequence[Moment]) -> Iterator[tuple[bool, str]]:
    """Yields one line per change, oldest first, and whether it was published as state or fault."""
    for utc, grave, text in changes(told):
        yield grave, f"{of_day(utc)}  {text}"


def changes(told: Sequence[Moment]) -> Iterator[tuple[float, bool, str]]:
    """Yields the time (UTC, s) of each change, whether it was published as state or fault, and its description."""
    for before, one in pairwise(told):
        for text in _published(before, one):
            yield one.utc, True, text
        for text in _changed(before, one):
            yield one.utc, False, text


def _published(before: Moment, one: Moment) -> Iterator[str]:
    yield from (f"command {order}" for order in one.orders)
    if (before.state, before.reason) != (one.state, one.reason):
        yield f"{one.state.name}: {_because(one.reason)}"
    for sign, fault in faults_changed(before, one):
        yield f"fault {fault} {'comes' if sign == '+' else 'is over'}: {_fault(fault)[0]}"


def _changed(before: Moment, one: Moment) -> Iterator[str]:
    old, new = before.snapshot, one.snapshot
    for axis, name in enumerate(AXES):
        if old.known[axis] != new.known[axis]:
            yield f"{name} {'known' if new.known[axis] else 'unknown'}"
    agreed, agrees = (None if m.wheels is None else m.wheels.agree for m in (before, one))
    if agrees is False and agreed is not False:
        yield "odometry begins to disagree"
    if laser_dissents(one) and not laser_dissents(before):
        assert one.result is not None
        assert one.result.match is not None
        yield f"a scan has no match: {one.result.match.reason.value}"
    if new.loop_counter != old.loop_counter:
        yield f"loop closure, keyframe {new.loop_new} on {new.loop_old}"
    if new.jumps != old.jumps and new.pose is not None and old.pose is not None:
        yield f"the pose jumps by {math.dist(new.pose[:2], old.pose[:2]):.2f} m"
    if one.dropped:
        yield f"{one.dropped} scans were skipped, because newer ones had arrived"
    yield from _lamps_changed(old, new)


def _lamps_changed(old: Snapshot, new: Snapshot) -> Iterator[str]:
    if old.light is None or new.light is None or old.light.links is new.light.links:
        return
    if old.light.fix is not new.light.fix:
        yield f"light: {new.light.fix.name}"
    was = {link.lamp_id: link.use for link in old.light.links if link.lamp_id is not None}
    for link in new.light.links:
        use = None if link.lamp_id is None else was.get(link.lamp_id)
        if use is not None and use is not link.use:
            yield f"lamp {link.lamp_id}: {use.name} -> {link.use.name}"
