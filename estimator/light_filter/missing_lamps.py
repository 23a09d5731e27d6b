"""Lamps that should be received and are not."""

from __future__ import annotations

import math
from dataclasses import replace

from estimator.light_filter.filter_state import Lights
from estimator.measurements import Array
from estimator.result import Fix, Link, LinkState

ABSENT_S, ABSENT_M = 5.0, 1.0
"""A lamp not received for so long and over so much way is called missing; people in the way move on."""
WELL_INSIDE = 0.7
"""Share of the field of view's reach within which a lamp should be received."""


def absent(lights: Lights, links: list[Link], pose: Array, fix: Fix) -> list[Link]:
    """The links, with one of amplitude 0 for every surveyed lamp that is missing; judged only in a good place."""
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
