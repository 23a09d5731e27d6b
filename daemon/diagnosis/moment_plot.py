"""Plot of `lumiloop why`: the trajectory around the moment on the map, and the solutions over time."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np

from daemon.diagnosis.moment import Moment, at, clock, faults_changed
from daemon.diagnosis.moment_report import AXES, GAP, laser_dissents, light_apart
from daemon.snapshot import LinkUse, State
from estimator import Array, Grid, se2

_INCHES: Final = (14.0, 8.0)
_MARGIN_M: Final = 4.0
LAST_S: Final = 0.05
"""Duration of the last cycle in the plot, s."""
LABEL: Final = 0.06
"""Share of the time axis that a fault's number occupies; the next label goes below it."""
LABELS: Final = 8
"""Rows of labels; when all are occupied, the first is used again."""
COLOURS: Final = {
    State.TRACKING: "tab:green",
    State.MAPPING: "tab:blue",
    State.DEGRADED: "tab:orange",
    State.AMBIGUOUS: "tab:purple",
    State.RELOCATING: "tab:purple",
    State.LOST: "tab:red",
    State.NO_LIDAR: "tab:red",
    State.STARTING: "0.5",
}


def draw(told: Sequence[Moment], utc: float, grid: Grid, kind: str = "png") -> bytes:
    """Returns a PNG, SVG or PDF file, by ``kind``; ``utc``, s: zero of its time axis. Needs matplotlib."""
    from matplotlib.figure import Figure

    one = told[at(told, utc)]
    canvas = Figure(figsize=_INCHES, dpi=100, layout="constrained")
    canvas.suptitle(f"{clock(utc)}: {one.state.name}, {one.reason.name.lower().replace('_', ' ')}")
    parts = canvas.add_gridspec(4, 2, width_ratios=(3, 2))
    _place(canvas.add_subplot(parts[:, 0]), told, one, grid)
    seconds = np.array([moment.utc - utc for moment in told])
    rows = [canvas.add_subplot(parts[row, 1]) for row in range(4)]
    _states(rows[0], told, seconds)
    _uncertainty(rows[1], told, seconds)
    _wheels(rows[2], told, seconds)
    _light(rows[3], told, seconds)
    for row in rows:
        row.axvline(0.0, color="k", linewidth=0.8)
        row.set_xlim(seconds[0], max(seconds[-1], seconds[0] + LAST_S))
    rows[-1].set_xlabel("seconds from the requested time")
    out = io.BytesIO()
    canvas.savefig(out, format=kind)
    return out.getvalue()


def _place(axes: Any, told: Sequence[Moment], one: Moment, grid: Grid) -> None:
    """Plots the map, the trajectory coloured by state, the robot, the light solution, and the motion by odometry."""
    poses = [(moment.state, moment.snapshot.pose) for moment in told if moment.snapshot.pose is not None]
    if not poses:
        axes.set_title("no pose was available")
        return
    rows, columns = grid.log_odds.shape
    if rows and columns:
        x, y = grid.origin.tolist()
        extent = (x, x + columns * grid.resolution, y, y + rows * grid.resolution)
        axes.imshow(1.0 - grid.probability, origin="lower", extent=extent, cmap="gray", vmin=0.0, vmax=1.0, alpha=0.6)
    way = np.array([pose[:2] for _, pose in poses])
    for state in dict.fromkeys(state for state, _ in poses):
        part = np.array([said is state for said, _ in poses])
        axes.plot(way[part, 0], way[part, 1], ".", color=COLOURS[state], markersize=4, label=state.name)
    if one.snapshot.pose is not None:
        x, y, yaw = one.snapshot.pose
        axes.plot(x, y, "^", color="k", markersize=9, label="robot")
        axes.plot((x, x + 0.8 * math.cos(yaw)), (y, y + 0.8 * math.sin(yaw)), color="k")
        _wheel_way(axes, one)
    _lamps(axes, one)
    low, high = way.min(axis=0) - _MARGIN_M, way.max(axis=0) + _MARGIN_M
    axes.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x in the map, m", ylabel="y, m")
    axes.legend(loc="best", fontsize=8)


def _wheel_way(axes: Any, one: Moment) -> None:
    """Plots the robot's earlier position by odometry and by lidar."""
    if one.wheels is None or one.snapshot.pose is None:
        return
    here: Array = np.array(one.snapshot.pose)
    for name, T, style in (("wheels", one.wheels.wheels, "C3--"), ("laser", one.wheels.laser, "C0--")):
        then = se2.compose(here, se2.inverse(T))
        label = f"from where, by the {name}"
        axes.plot((then[0], here[0]), (then[1], here[1]), style, linewidth=1.5, label=label)


def _lamps(axes: Any, one: Moment) -> None:
    light = one.snapshot.light
    if light is None or light.pose is None:
        return
    x, y, _ = light.pose
    used = sum(link.use is LinkUse.ACCEPTED for link in light.links)
    axes.plot(x, y, "*", color="gold", markeredgecolor="k", markersize=14, label=f"light solution ({used} lamps)")
    if light.sigma is not None:
        turn = np.linspace(0.0, 2.0 * np.pi, 60)
        axes.plot(x + 2 * light.sigma[0] * np.cos(turn), y + 2 * light.sigma[1] * np.sin(turn), color="goldenrod")


def _empty(axes: Any, why: str) -> None:
    """Writes a text in place of curves without a point."""
    axes.set_yticks([])
    axes.text(0.5, 0.5, why, ha="center", va="center", transform=axes.transAxes, fontsize=8)


def _states(axes: Any, told: Sequence[Moment], seconds: Array) -> None:
    """Plots strips of state, unknown axes and failed scan matches, and the changes of faults by number."""
    ends = np.append(seconds[1:], seconds[-1] + LAST_S)
    for moment, begin, end in zip(told, seconds.tolist(), ends.tolist(), strict=True):
        axes.barh(0, end - begin, left=begin, color=COLOURS[moment.state], height=0.8)
        for axis in range(3):
            if not moment.snapshot.known[axis]:
                axes.barh(axis + 1, end - begin, left=begin, color="tab:red", height=0.8)
        if laser_dissents(moment):
            axes.barh(4, end - begin, left=begin, color="tab:red", height=0.8)
    free = [-math.inf] * LABELS  # time until which each row of labels is occupied
    for (before, moment), begin in zip(pairwise(told), seconds[1:].tolist(), strict=True):
        if not (changed := faults_changed(before, moment)):
            continue
        axes.axvline(begin, color="tab:red", linestyle=":", linewidth=0.8)
        for sign, fault in changed:
            row = next((row for row, until in enumerate(free) if until <= begin), 0)
            free[row] = begin + LABEL * float(ends[-1] - seconds[0])
            said, y = f"{sign}{fault}", 4.4 - 5.0 * row / LABELS
            axes.text(begin, y, said, color="tab:red", fontsize=7, va="top", clip_on=True)
    axes.set_yticks(range(5), ["state", *(f"{name} unknown" for name in AXES), "scan refused"], fontsize=8)
    axes.set_ylim(-0.5, 4.5)


def _uncertainty(axes: Any, told: Sequence[Moment], seconds: Array) -> None:
    sigma = [math.nan if (P := one.snapshot.covariance) is None else math.sqrt(max(P[0], P[2])) for one in told]
    bound = [math.nan if (m := one.snapshot.trust.horizontal_m) is None else m for one in told]
    if np.isnan([*sigma, *bound]).all():
        _empty(axes, "no sigma and no protection level was published")
        return
    axes.plot(seconds, sigma, label="sigma of the position, m")
    axes.plot(seconds, bound, label="protection level, m")
    axes.set_yscale("log")
    axes.legend(fontsize=7)


def _two_scales(
    axes: Any, seconds: Array, left: tuple[str, list[float]], right: tuple[str, list[float]], more: Sequence[Any] = ()
) -> Any:
    """Plots one curve on the left axis and one on the right axis, which it returns; each name has its unit.

    ``more``: further artists of the left axis for the legend.
    """
    other = axes.twinx()
    lines = [*axes.plot(seconds, left[1], "C0", label=left[0]), *other.plot(seconds, right[1], "C1", label=right[0])]
    for side, colour in ((axes, "C0"), (other, "C1")):
        side.tick_params(axis="y", colors=colour, labelsize=7)
        side.set_ylim(bottom=0.0)
    axes.legend(handles=[*lines, *more], fontsize=7, loc="upper left")
    return other


def _wheels(axes: Any, told: Sequence[Moment], seconds: Array) -> None:
    """Plots the separation of odometry and lidar.

    A sensor without data leaves a gap, as its last value is no comparison.
    """
    both = [None if False in (one.snapshot.odometry_ok, one.snapshot.lidar_ok) else one.wheels for one in told]
    metres = [math.nan if said is None else said.apart[0] for said in both]
    turned = [math.nan if said is None else math.degrees(said.apart[1]) for said in both]
    if np.isnan(metres).all():
        _empty(axes, "odometry and lidar could not be compared")
        return
    odd = np.array([said is not None and not said.agree for said in both])
    dots = (
        axes.plot(seconds[odd], np.array(metres)[odd], ".", color="tab:red", label="they disagree") if odd.any() else []
    )
    _two_scales(axes, seconds, ("odometry minus lidar, m", metres), ("degrees", turned), dots)


def _light(axes: Any, told: Sequence[Moment], seconds: Array) -> None:
    if all(one.snapshot.light is None for one in told):
        _empty(axes, "no photodiode")
        return
    speaks = [one.snapshot.adc_ok is not False for one in told]
    places = [light_apart(one) if said else None for one, said in zip(told, speaks, strict=True)]
    away = [math.nan if far is None else far[0] for far in places]
    gaps = [one.snapshot.trust.gap if said else None for one, said in zip(told, speaks, strict=True)]
    gap = [math.nan if g is None else math.sqrt(g) for g in gaps]
    if np.isnan([*away, *gap]).all():
        _empty(axes, "no light solution was available")
        return
    other = _two_scales(axes, seconds, ("light solution minus pose, m", away), ("in deviations", gap))
    most = math.sqrt(GAP)
    other.axhline(most, color="tab:red", linewidth=0.8)
    other.set_ylim(0.0, max(other.get_ylim()[1], 1.1 * most))  # keep the threshold in view
