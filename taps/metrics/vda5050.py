"""The position object of VDA 5050, the interface of mobile robots and their fleet's control, with its names.

A localiser does not know battery, orders or safety state, so it sends no ``state`` message: whoever builds one puts
this object into it. Version 3 calls it ``mobileRobotPosition``, version 2 ``agvPosition``.
"""

from __future__ import annotations

import math

from daemon.publish.stream.messages import Pose
from daemon.snapshot import State

LOCALISED = (State.TRACKING, State.MAPPING, State.DEGRADED)


def position(latest: Pose, held: Pose | None = None) -> dict[str, object] | None:
    """The object of version 3; None while no pose has ever been told.

    ``held``: the last one with a pose, for while ``latest`` has none: ``localized`` is false then. The standard leaves
    it to the vehicle what ``localizationScore`` is: here, the share of axes (x, y, heading) that are observed.
    """
    known = latest if latest.pose is not None else held
    if known is None or known.pose is None:
        return None
    localised = latest.pose is not None and latest.covariance is not None and latest.state in LOCALISED
    x, y, yaw = known.pose
    told: dict[str, object] = {
        "x": round(x, 4),
        "y": round(y, 4),
        "theta": round(math.remainder(yaw, 2.0 * math.pi), 5),
        "mapId": f"{known.map_id:08x}",
        "localized": localised,
        "localizationScore": round(sum(latest.known) / len(latest.known), 2) if localised else 0.0,
    }
    if localised and latest.trust.horizontal_m is not None:
        told["deviationRange"] = round(latest.trust.horizontal_m, 4)
    return told


def position_v2(latest: Pose, held: Pose | None = None, description: str = "") -> dict[str, object] | None:
    """The object of version 2; ``description``: of the map, as far as there is one."""
    told = position(latest, held)
    if told is not None:
        told["positionInitialized"] = told.pop("localized")
        if description:
            told["mapDescription"] = description
    return told
