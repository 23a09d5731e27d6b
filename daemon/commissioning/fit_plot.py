"""Plots of a calibration and of a survey by drive; they need matplotlib, which is an extra."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from daemon.system.extras import how_to_install
from estimator.calibration import Calibrated, Surveyed, WheelFit

_MISSING: Final = f"no plot: matplotlib is not installed ({how_to_install('plot')})"


def draw_calibration(found: Calibrated, path: Path) -> str:
    """Plots residuals before and after, over the distance from each lamp; returns a line for the user."""
    canvas = _canvas((9.0, 4.5))
    if canvas is None:
        return _MISSING
    at = np.array([(lamp.x, lamp.y) for lamp in found.survey.lamps])[found.rows.lamp]
    pose, (x, y, yaw) = found.rows.pose, found.T_survey_drive
    c, s = np.cos(yaw), np.sin(yaw)
    there = np.column_stack((x + c * pose[:, 0] - s * pose[:, 1], y + s * pose[:, 0] + c * pose[:, 1]))
    way = np.hypot(*(there - at).T)
    for n, (title, values) in enumerate((("before", found.before), ("after", found.after))):
        axes = canvas.add_subplot(1, 2, n + 1)
        axes.scatter(way[~found.used], 100.0 * values[~found.used], s=2, color="0.8", label="not used")
        axes.scatter(way[found.used], 100.0 * values[found.used], s=2, c=found.rows.lamp[found.used], cmap="tab20")
        axes.set(title=title, xlabel="distance from below the lamp, m", ylim=(-60.0, 60.0))
        axes.axhline(0.0, color="k", linewidth=0.5)
    canvas.axes[0].set_ylabel("received against expected, %")
    return _save(canvas, path)


def draw_survey(result: Surveyed, path: Path) -> str:
    """Plots the lamps with their sigmas over the trajectory driven; returns a line for the user."""
    canvas = _canvas((7.0, 7.0))
    if canvas is None:
        return _MISSING
    axes = canvas.add_subplot()
    rows = result.found.rows
    axes.scatter(rows.pose[:, 0], rows.pose[:, 1], s=1, color="0.8", label="driven")
    for lamp, sigma in zip(result.found.survey.lamps, result.sigma, strict=True):
        axes.errorbar(lamp.x, lamp.y, xerr=sigma[0], yerr=sigma[1], fmt="o", color="C1", markersize=4)
        axes.annotate(f"{lamp.lamp_id} ({lamp.code})", (lamp.x, lamp.y), fontsize=7)
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal", title="lamps: number (code)")
    return _save(canvas, path)


def draw_wheels(fit: WheelFit, path: Path) -> str:
    """Plots odometry minus lidar, step by step, before and after; returns a line for the user."""
    canvas = _canvas((9.0, 6.0))
    if canvas is None:
        return _MISSING
    grid = canvas.subplots(2, 2, sharex=True, sharey="row")
    for n, (title, off) in enumerate((("before", fit.off_before), ("after", fit.off_after))):
        way, turn = grid[0, n], grid[1, n]
        way.plot(1e3 * off[:, 0], ".", markersize=3, label="ahead")
        way.plot(1e3 * off[:, 1], ".", markersize=3, label="to the left")
        turn.plot(np.degrees(off[:, 2]), ".", markersize=3, color="C2")
        way.set(title=title)
        turn.set(xlabel="step of the drive")
        for axes in (way, turn):
            axes.axhline(0.0, color="k", linewidth=0.5)
    grid[0, 0].set_ylabel("odometry minus lidar, mm")
    grid[1, 0].set_ylabel("odometry minus lidar, deg")
    grid[0, 0].legend()
    return _save(canvas, path)


def _canvas(inches: tuple[float, float]) -> Any:
    """Returns an empty figure; None without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return None
    return Figure(figsize=inches, dpi=110, layout="constrained")


def _save(canvas: Any, path: Path) -> str:
    try:
        canvas.savefig(path)
    except OSError as error:
        return f"no plot: cannot write {path}: {error.strerror}"
    return f"plot: {path}"
