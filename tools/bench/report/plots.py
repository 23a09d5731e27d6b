"""Pictures for a report: what is to be drawn as plain data, and matplotlib's SVG of it."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

MOST_POINTS: Final = 1500


@dataclass(frozen=True, slots=True)
class Series:
    """One line of a picture; where a value is not finite, the line is broken.

    Attributes:
        kind: ``line``, ``dots``, ``bars`` (from the axis up), or ``marks`` (upright lines at ``x``; ``y`` is not used).
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    kind: Literal["line", "dots", "bars", "marks"] = "line"


@dataclass(frozen=True, slots=True)
class Plot:
    """A picture: title, what its axes show, what is drawn. ``square``: a metre is as long in both directions."""

    title: str
    x: str
    y: str
    series: tuple[Series, ...]
    square: bool = False


def histogram(title: str, x: str, values: Sequence[float], bins: int = 40) -> Plot:
    """How often values occur; what is not finite is left out."""
    kept = np.asarray(values, dtype=np.float64)
    kept = kept[np.isfinite(kept)]
    counts, edges = np.histogram(kept, bins=bins) if kept.size else (np.zeros(1), np.array([0.0, 1.0]))
    middles = 0.5 * (edges[:-1] + edges[1:])
    return Plot(title, x, "number", (Series("", middles.tolist(), counts.tolist(), "bars"),))


def svg(plot: Plot) -> str:
    """The picture as an SVG element."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=(7.0, 3.2), layout="constrained")
        axes = figure.add_subplot()
        for number, one in enumerate(plot.series):
            _draw(axes, one, f"C{number}")
        for write, text in ((axes.set_title, plot.title), (axes.set_xlabel, plot.x), (axes.set_ylabel, plot.y)):
            write(text, parse_math=False)
        axes.grid(visible=True, alpha=0.3)
        if plot.square:
            axes.set_aspect("equal", adjustable="datalim")
        if any(one.name for one in plot.series):
            axes.legend()
        out = io.StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()[out.getvalue().index("<svg") :]


def _draw(axes: Any, one: Series, colour: str) -> None:
    step = max(1, -(-len(one.x) // MOST_POINTS))
    x = np.asarray(one.x, dtype=np.float64)[::step]
    y = np.zeros_like(x) if one.kind == "marks" else np.asarray(one.y, dtype=np.float64)[::step]
    good = np.isfinite(x) & np.isfinite(y)
    if one.kind == "line":
        axes.plot(x, np.where(good, y, np.nan), color=colour, linewidth=1.2, label=one.name)
    elif one.kind == "dots":
        axes.plot(x[good], y[good], ".", color=colour, markersize=3, label=one.name)
    elif one.kind == "bars":
        axes.bar(x[good], y[good], width=np.diff(x[good]).min() if good.sum() > 1 else 0.8, color=colour)
    else:
        for at in x[good]:
            axes.axvline(at, color=colour, linestyle="--", linewidth=1.0)
        axes.plot([], [], "--", color=colour, label=one.name)
