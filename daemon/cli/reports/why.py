"""Report of `lumiloop why --json`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from daemon.cli.reports.output import meaning, pose, zoned
from daemon.diagnosis.moment import Moment, chosen
from daemon.diagnosis.moment_report import changes, laser_dissents, light_apart
from daemon.snapshot import LightLink


def as_object(told: Sequence[Moment], utc: float, where: str, wide: float, second: bool) -> dict[str, Any]:
    """Returns the cycle of a time, and what changed before it; arguments as of `moment_report.report`."""
    k, last, changed = chosen(told, utc, second, wide)
    one = told[k]
    snapshot = one.snapshot
    x, y, yaw = snapshot.known
    return {
        "asked": {"time": zoned(utc), "lasts_s": wide, "whole_second": second, "changes_in_it": changed is not None},
        "recording": where,
        "cycle": {"time": zoned(one.utc)},
        "state": one.state.name,
        "reason": meaning("reason", int(one.reason)),
        "faults": None if one.told is None else [meaning("fault", fault) for fault in one.faults],
        "pose": None if snapshot.pose is None else pose(snapshot.pose),
        "sigma": _sigma(snapshot.covariance),
        "protection_m": snapshot.trust.horizontal_m,
        "hypotheses": snapshot.trust.places,
        "known": {"x": x, "y": y, "yaw": yaw},
        "witnesses": {"laser": _laser(told, k), "wheels": _wheels(one), "light": _light(one)},
        "changes": [
            {"time": zoned(at), "published": published, "text": text}
            for at, published, text in changes(told[: last + 1])
        ],
    }


def _sigma(covariance: Sequence[float] | None) -> dict[str, float] | None:
    if covariance is None:
        return None
    xx, _, yy, *_, tt = covariance
    return pose([math.sqrt(xx), math.sqrt(yy), math.sqrt(tt)])


def _laser(told: Sequence[Moment], k: int) -> dict[str, Any] | None:
    """The latest scan match; None: no scan in all that time."""
    latest = next((one for one in reversed(told[: k + 1]) if one.scan is not None and one.fresh), None)
    if latest is None or latest.result is None or (match := latest.result.match) is None:
        return None
    x, y, yaw = match.correction.tolist()
    return {
        "dissents": laser_dissents(latest),
        "age_s": told[k].utc - latest.utc,
        "reason": match.reason.value,
        "points": match.queries,
        "inliers": match.inliers,
        "residual_m": match.residual_m if match.ok else None,
        "correction": pose([x, y, yaw]) if match.ok else None,
    }


def _wheels(one: Moment) -> dict[str, Any] | None:
    """Motion by odometry against that by the lidar; None: they cannot be compared."""
    if (said := one.wheels) is None:
        return None
    away_m, away_rad = said.apart
    return {
        "dissents": not said.agree,
        "seconds_s": said.seconds,
        "wheels": pose(said.wheels.tolist()),
        "laser": pose(said.laser.tolist()),
        "apart_m": away_m,
        "apart_rad": away_rad,
    }


def _light(one: Moment) -> dict[str, Any] | None:
    """The light solution; None: no photodiode is configured."""
    if (light := one.snapshot.light) is None:
        return None
    away = light_apart(one)
    return {
        "fix": light.fix.name,
        "used": light.used,
        "pose": None if light.pose is None else pose(light.pose),
        "apart_m": None if away is None else away[0],
        "apart_rad": None if away is None else away[1],
        "gap": one.snapshot.trust.gap,
        "links": [_link(link) for link in light.links],
    }


def _link(link: LightLink) -> dict[str, Any]:
    return {
        "code": link.code,
        "lamp": link.lamp_id,
        "use": link.use.name,
        "strength_a": link.strength,
        "residual_ln": link.residual,
    }
