"""Plot of one scan match: scan on the local map before and after, pairs by residual, lamps, convergence."""

from __future__ import annotations

import io
from importlib.util import find_spec
from typing import Any, Final

import numpy as np

from estimator import Array, Entry, Iteration, LightSaid, Reason, Told, icp, local_map, se2

_INCHES: Final = (14.0, 10.5)
_MARGIN_M: Final = 0.5


def available() -> bool:
    """True if matplotlib, an extra, is installed."""
    return find_spec("matplotlib") is not None


def draw(name: str, entry: Entry, told: tuple[Told, ...]) -> bytes | None:
    """Returns a PNG of one match with the title ``name``; None without matplotlib."""
    if not available():
        return None
    from matplotlib.figure import Figure

    canvas = Figure(figsize=_INCHES, dpi=100, layout="constrained")
    canvas.suptitle(_title(name, entry, told))
    if entry.asked is None:
        _plain(canvas.add_subplot(), entry)
    else:
        grid = canvas.subplots(2, 2, gridspec_kw={"height_ratios": (3, 2)})
        chosen = _chosen(entry, told)
        most = _most(told[0])
        _pairs(grid[0, 0], (entry, told[0]), 0, most)
        dots = _pairs(grid[0, 1], (entry, chosen), len(chosen.iterations) - 1, most)
        if dots is not None:
            canvas.colorbar(dots, ax=list(grid[0]), shrink=0.8, label="residual of the pair, mm")
        _residuals(grid[1, 0], (told[0], chosen))
        _convergence(grid[1, 1], told)
    out = io.BytesIO()
    canvas.savefig(out, format="png")
    return out.getvalue()


def _title(name: str, entry: Entry, told: tuple[Told, ...]) -> str:
    result, second = entry.result, ", with multi-start" if len(told) > 1 else ""
    x, y, yaw = result.correction.tolist()
    off, turn = np.hypot(x, y), f"{np.degrees(yaw):.2f} deg"
    moved = f"prediction corrected by {1e3 * off:.1f} mm, {turn}"
    if result.reason is Reason.REJECTED:
        moved = f"would have moved the prediction by {off:.2f} m, {turn}; rejected"
    fit = f"{result.inliers} of {result.queries} points fit, residual {1e3 * result.residual_m:.1f} mm"
    line = f"{result.iterations} iterations{second}; {moved}; {fit}" if told else f"{result.queries} points"
    return f"{name}: {result.reason.value}\n{line}"


def _chosen(entry: Entry, told: tuple[Told, ...]) -> Told:
    """Returns the attempt that gave the result: the last one with the same number of inliers."""
    same = [one for one in told if one.what != "trial" and int(one.attempt.sums[icp.INLIERS]) == entry.result.inliers]
    return same[-1] if same else told[0]


def _plain(axes: Any, entry: Entry) -> None:
    xy = entry.points.xy
    axes.plot(xy[:, 0], xy[:, 1], ".", color="C0", markersize=3)
    axes.plot(*entry.points.origin, "^", color="k", label="lidar")
    axes.set(title="the scan, not matched", xlabel="x forward, m", ylabel="y left, m", aspect="equal")


def _most(told: Told) -> float:
    """Returns the end of the colour scale, mm: 95 % of the residuals of the first iteration lie within."""
    values = told.iterations[0].pairs.residual_m if told.iterations else np.empty(0)
    return max(1.0, 1e3 * float(np.quantile(np.abs(values), 0.95))) if len(values) else 1.0


def _pairs(axes: Any, what: tuple[Entry, Told], number: int, most: float) -> Any:
    """Plots the scan at one iteration on the map: each pair as a line and its point, coloured by the residual."""
    entry, told = what
    assert entry.asked is not None
    elements = entry.asked[1].elements
    axes.plot(elements[:, local_map.X], elements[:, local_map.Y], "s", color="0.8", markersize=2, label="local map")
    if not told.iterations:
        axes.set(title="the iteration limit was 0", aspect="equal")
        return None
    one, points = told.iterations[number], told.attempt.view.points[:, :2]
    at = se2.apply(one.T_odom_base, points)
    axes.plot(at[:, 0], at[:, 1], ".", color="k", markersize=2, label="point without a pair")
    axes.plot(*one.T_odom_base[:2], "^", color="k", markersize=6, label="robot")
    dots = _coloured(axes, one, (at[one.pairs.point], elements[one.pairs.element, : local_map.NX]), most)
    if entry.light is not None:
        _lights(axes, entry, entry.light)
    low, high = at.min(axis=0) - _MARGIN_M, at.max(axis=0) + _MARGIN_M
    axes.set(xlabel="x of odom, m", ylabel="y of odom, m", aspect="equal", xlim=(low[0], high[0]))
    axes.set_ylim(low[1], high[1])
    when = "before" if number == 0 else "after"
    attempt = "" if told.what == "first" else f" of the {told.what} attempt"
    axes.set_title(f"{when}: iteration {number + 1} of {len(told.iterations)}{attempt}")
    axes.legend(loc="best", fontsize=7)
    return dots


def _coloured(axes: Any, one: Iteration, ends: tuple[Array, Array], most: float) -> Any:
    from matplotlib.collections import LineCollection

    residual, (here, there) = 1e3 * one.pairs.residual_m, ends
    lines = LineCollection(list(np.stack((here, there), axis=1)), array=residual, linewidths=1.5, zorder=3)
    lines.set(cmap="coolwarm", clim=(-most, most))
    axes.add_collection(lines)
    return axes.scatter(here[:, 0], here[:, 1], c=residual, s=7, cmap="coolwarm", vmin=-most, vmax=most, zorder=4)


def _lights(axes: Any, entry: Entry, said: LightSaid) -> None:
    """Plots the lamp positions by light at the matched pose, and those from the newest keyframe."""
    for k, lamp in enumerate(said.lamps):
        now = se2.apply(entry.result.T_odom_base, lamp.present[None])[0]
        axes.plot(*now, "*", color="gold", markeredgecolor="k", markersize=12, label=None if k else "lamp, from here")
        axes.annotate(
            str(lamp.lamp_id), now, xytext=(5, 5), textcoords="offset points", fontsize=7, annotation_clip=True
        )
        if lamp.reference is not None:
            then = se2.apply(said.T_odom_keyframe, lamp.reference[None])[0]
            label = None if k else "lamp, from the keyframe"
            axes.plot(*then, "x", color="k", markersize=7, label=label)
            axes.plot((now[0], then[0]), (now[1], then[1]), color="goldenrod", linewidth=1.0)


def _residuals(axes: Any, both: tuple[Told, Told]) -> None:
    """Plots the residuals of the first and of the last iteration."""
    first, last = both
    for told, number, name in ((first, 0, "first iteration"), (last, -1, "last iteration")):
        if told.iterations:
            values = 1e3 * told.iterations[number].pairs.residual_m
            axes.hist(np.clip(values, -100.0, 100.0), bins=80, range=(-100.0, 100.0), histtype="step", label=name)
    axes.set(xlabel="residual of the pair, mm (beyond 100: at the edge)", ylabel="pairs", yscale="symlog")
    axes.legend(fontsize=8)


def _convergence(axes: Any, told: tuple[Told, ...]) -> None:
    """Plots the distance of each iteration's start from the end of its attempt, and its robust scale."""
    for one in told:
        away = [se2.between(one.attempt.T, step.T_odom_base) for step in one.iterations]
        far = [1e3 * max(float(np.hypot(x, y)), 1e-6) for x, y, _ in away]
        count = np.arange(1, len(far) + 1)
        trial = one.what == "trial"
        style = {"color": "0.7", "linewidth": 0.8} if trial else {"marker": "o", "markersize": 3}
        axes.plot(count, far, label=None if trial else f"{one.what}: distance from its end, mm", **style)
        if not trial:
            scale = [1e3 * step.row[icp.SCALE] for step in one.iterations]
            axes.plot(count, scale, "--", label=f"{one.what}: robust scale, mm")
    axes.set(xlabel="iteration", yscale="log")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend(fontsize=8)
