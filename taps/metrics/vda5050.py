"""The position object of VDA 5050, the interface between mobile robots and fleet control.

A localiser has no battery, order or safety state, so that it sends no ``state`` message; the sender of one inserts this
object. Version 3 calls it ``mobileRobotPosition``, version 2 ``agvPosition``.
"""

from __future__ import annotations

import math

from daemon.publish.stream.messages import Pose
from daemon.snapshot import State

LOCALISED = (State.TRACKING, State.MAPPING, State.DEGRADED)


def localised(latest: Pose) -> bool:
    """Whether the snapshot has a confirmed pose."""
    return latest.pose is not None and latest.covariance is not None and latest.state in LOCALISED


def position(latest: Pose, held: Pose | None = None) -> dict[str, object] | None:
    """The object of version 3; None before the first pose.

    ``held``: the last message with a pose, used while ``latest`` has none; ``localized`` is then false. The standard
    leaves ``localizationScore`` to the vehicle: here it is the share of known axes (x, y, heading).
    """
    known = latest if latest.pose is not None else held
    if known is None or known.pose is None:
        return None
    confirmed = localised(latest)
    x, y, yaw = known.pose
    position_object: dict[str, object] = {
        "x": round(x, 4),
        "y": round(y, 4),
        "theta": round(math.remainder(yaw, 2.0 * math.pi), 5),
        "mapId": f"{known.map_id:08x}",
        "localized": confirmed,
        "localizationScore": round(sum(latest.known) / len(latest.known), 2) if confirmed else 0.0,
    }
    if confirmed and latest.trust.horizontal_m is not None:
        position_object["deviationRange"] = round(latest.trust.horizontal_m, 4)
    return position_object


def position_v2(latest: Pose, held: Pose | None = None, description: str = "") -> dict[str, object] | None:
    """The object of version 2; ``description``: of the map; empty: none."""
    position_object = position(latest, held)
    if position_object is not None:
        position_object["positionInitialized"] = position_object.pop("localized")
        if description:
            position_object["mapDescription"] = description
    return position_object
