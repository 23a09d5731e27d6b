"""What is watched in a soak: one row after the other, a verdict over the slopes, a graph."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.ci.figures import Figure, bounded

Array = npt.NDArray[np.float64]

ROWS: Final = ("hours", "resident_mb", "files", "threads", "median_ms", "p99_ms", "worst_ms")
KEPT: Final = ("keyframes", "submaps", "loops")
SLOPE_MB_H: Final = 0.5
SETTLED: Final = 1.0 / 3.0
"""Share of a run that does not count: start, first laps, caches. Twenty minutes of an hour."""


@dataclass(slots=True)
class Watch:
    """Rows of :data:`ROWS`, the times since the row before; ``kept``: of each, :data:`KEPT` of the map, if known."""

    rows: list[tuple[float, ...]] = field(default_factory=list)
    kept: list[tuple[float, ...]] = field(default_factory=list)

    def take(self, hours: float, pid: int, times_ms: tuple[float, float, float], kept: tuple[float, ...] = ()) -> None:
        """One row, about a process, and what its map holds where that is known."""
        self.rows.append((hours, *process(pid), *times_ms))
        self.kept.append(kept)

    def column(self, name: str) -> Array:
        """One of :data:`ROWS`."""
        return np.array([row[ROWS.index(name)] for row in self.rows])

    def line(self) -> str:
        """The latest row for people."""
        named = [*zip(ROWS, self.rows[-1], strict=True), *zip(KEPT, self.kept[-1], strict=False)]
        return "  ".join(f"{name} {value:.4g}" for name, value in named)

    def figures(self, command: str) -> list[Figure]:
        """Slopes by least squares, and the least and most of what must not change, after the run has settled."""
        hours = self.column("hours")
        after = hours >= SETTLED * hours[-1]
        slope = float(np.polyfit(hours[after], self.column("resident_mb")[after], 1)[0])
        spread = {name: float(np.ptp(self.column(name)[after])) for name in ("files", "threads")}
        rows = [Figure("hours", float(hours[-1]), "h", command=command)]
        rows.append(bounded("memory, slope", slope, "MB/h", f"<= {SLOPE_MB_H:g}", command))
        rows.append(Figure("memory at the end", float(self.column("resident_mb")[-1]), "MB", command=command))
        rows += [bounded(f"{name}, most less least", spread[name], "", "<= 0", command) for name in spread]
        rows += [
            Figure(f"cycle, {name} of the last row", float(self.column(f"{name}_ms")[-1]), "ms", command=command)
            for name in ("median", "p99", "worst")
        ]
        kept = np.array(self.kept)
        for name, column in zip(KEPT, kept.T if kept.size else (), strict=False):
            rows.append(Figure(f"{name} at the end", float(column[-1]), "", command=command))
            grown = float(np.polyfit(hours[after], column[after], 1)[0])
            rows.append(Figure(f"{name}, slope", grown, "1/h", command=command))
        return rows

    def draw(self, path: Path) -> None:
        """Memory, files and threads, and times over the hours."""
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        hours = self.column("hours")
        figure, axes = plt.subplots(3, 1, figsize=(7.0, 6.0), sharex=True, layout="constrained")
        for place, (names, label) in enumerate(
            ((("resident_mb",), "MB"), (("files", "threads"), "count"), (("median_ms", "p99_ms", "worst_ms"), "ms"))
        ):
            for name in names:
                axes[place].plot(hours, self.column(name), label=name)
            axes[place].set_ylabel(label)
            axes[place].set_ylim(bottom=0.0)
            axes[place].grid(visible=True, alpha=0.3)
            axes[place].legend()
        axes[-1].set_xlabel("hours")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=100)
        plt.close(figure)


def process(pid: int) -> tuple[float, float, float]:
    """Resident memory in MB, open files, threads.

    Raises:
        OSError: it has ended.
    """
    here = Path("/proc") / str(pid)
    pages = int((here / "statm").read_text(encoding="ascii").split()[1])
    files, threads = len(list((here / "fd").iterdir())), len(list((here / "task").iterdir()))
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6, float(files), float(threads)
