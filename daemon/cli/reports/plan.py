"""Report of `lumiloop plan --json`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from daemon.commissioning.floor import Array, Hall
from daemon.commissioning.lamp_selection import Goals, Plan
from daemon.commissioning.laser_information import KNOWN_SIGMA_M
from daemon.commissioning.light_information import Fitting, worst


def as_object(hall: Hall, plan: Plan, goals: Goals, fitting: Fitting, folder: Path) -> dict[str, Any]:
    """Returns lamps and accuracy of a plan. ``folder``: of the files that were made."""
    xy = hall.in_map(plan.lamps) if len(plan.lamps) else np.zeros((0, 2))
    return {
        "floor": {
            "area_m2": len(hall.places) * hall.step**2,
            "places": len(hall.places),
            "step_m": hall.step,
        },
        "lamps": {
            "count": len(plan.lamps),
            "reach_m": fitting.reach,
            "positions": [{"x_m": round(float(x), 3), "y_m": round(float(y), 3)} for x, y in xy],
        },
        "goals": {
            "links": goals.links,
            "sigma_m": goals.accuracy,
            "share": goals.share,
            "reached_share": float(plan.reached),
            "possible_share": float(plan.possible.mean()),
            "short": plan.short_of(goals) or None,
        },
        "links": {"enough_share": float((plan.links >= goals.links).mean()), "mean": float(plan.links.mean())},
        "accuracy": {
            "laser": _sigmas(worst(plan.walls)[0]),
            "light": _sigmas(plan.light_sigma),
            "laser_and_light": _sigmas(plan.sigma),
        },
        "folder": str(folder),
    }


def _sigmas(sigma: Array) -> dict[str, float | None]:
    """Sigmas (n,), m, of the worse axis: median and 95 %, None where they are not finite; share of blind places."""
    ordered = np.sort(sigma)
    median, most = ordered[len(ordered) // 2], ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))]
    known = [float(value) if np.isfinite(value) else None for value in (median, most)]
    return {"median_m": known[0], "p95_m": known[1], "blind_share": float((sigma > KNOWN_SIGMA_M).mean())}
