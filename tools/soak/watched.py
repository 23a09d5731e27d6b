"""What is watched in a soak: one row after the other, a verdict over the slopes, a graph."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from stat import S_ISREG
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.ci.figures import Figure, bounded

Array = npt.NDArray[np.float64]

OF_PROCESS: Final = ("resident_mb", "descriptors", "threads")
ON_DISK: Final = ("stored_files", "stored_mb")
TIMES: Final = ("median_ms", "p99_ms", "worst_ms")
ROWS: Final = ("hours", *OF_PROCESS, *ON_DISK, *TIMES)
KEPT: Final = ("keyframes", "submaps", "loops")
SLOPE_MB_H: Final = 0.5
CYCLE_SLOPE_PER_H: Final = 0.05
"""Largest growth of the median cycle in an hour, as a share of it."""
SETTLED: Final = 1.0 / 3.0
"""Share of a run that does not count: start, first laps, caches. Twenty minutes of an hour."""


@dataclass(slots=True)
class Watch:
    """Rows of :data:`ROWS`, the times since the row before; ``kept``: of each, :data:`KEPT` of the map, if known.

    ``folder``: where the process stores files; None: nowhere.
    """

    rows: list[tuple[float, ...]] = field(default_factory=list)
    kept: list[tuple[float, ...]] = field(default_factory=list)
    folder: Path | None = None

    def take(self, hours: float, pid: int, times_ms: tuple[float, float, float], kept: tuple[float, ...] = ()) -> None:
        """One row, about a process, and what its map holds where that is known."""
        self.rows.append((hours, *process(pid), *stored(self.folder), *times_ms))
        self.kept.append(kept)

    def column(self, name: str) -> Array:
        """One of :data:`ROWS`."""
        return np.array([row[ROWS.index(name)] for row in self.rows])

    def line(self) -> str:
        """The latest row for people."""
        named = [*zip(ROWS, self.rows[-1], strict=True), *zip(KEPT, self.kept[-1], strict=False)]
        return "  ".join(f"{name} {value:.4g}" for name, value in named)

    def figures(self, command: str) -> list[Figure]:
        """Slopes by least squares, and the growth of what must not grow, after the run has settled."""
        hours = self.column("hours")
        after = hours >= SETTLED * hours[-1]
        slope = {name: float(np.polyfit(hours[after], self.column(name)[after], 1)[0]) for name in ROWS}
        grown = {name: growth(self.column(name)[after]) for name in ("descriptors", "threads")}
        cycle = slope["median_ms"] / float(np.median(self.column("median_ms")[after]))
        rows = [Figure("hours", float(hours[-1]), "h", command=command)]
        rows.append(bounded("memory, slope", slope["resident_mb"], "MB/h", f"<= {SLOPE_MB_H:g}", command))
        rows.append(Figure("memory at the end", float(self.column("resident_mb")[-1]), "MB", command=command))
        rows += [bounded(f"{name}, growth", grown[name], "", "<= 0", command) for name in grown]
        rows += [Figure(f"{name}, slope", slope[name], f"{unit}/h", command=command) for name, unit in _STORED]
        rows.append(bounded("cycle, slope of the median", cycle, "1/h", f"<= {CYCLE_SLOPE_PER_H:g}", command))
        rows += [
            Figure(f"cycle, {name} of the last row", float(self.column(f"{name}_ms")[-1]), "ms", command=command)
            for name in ("median", "p99", "worst")
        ]
        kept = np.array(self.kept)
        for name, column in zip(KEPT, kept.T if kept.size else (), strict=False):
            rows.append(Figure(f"{name} at the end", float(column[-1]), "", command=command))
            per_hour = float(np.polyfit(hours[after], column[after], 1)[0])
            rows.append(Figure(f"{name}, slope", per_hour, "1/h", command=command))
        return rows

    def draw(self, path: Path) -> None:
        """Memory, descriptors, threads and files, and times over the hours."""
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        hours = self.column("hours")
        figure, axes = plt.subplots(3, 1, figsize=(7.0, 6.0), sharex=True, layout="constrained")
        for place, (names, label) in enumerate(
            ((("resident_mb", "stored_mb"), "MB"), (("descriptors", "threads", "stored_files"), "count"), (TIMES, "ms"))
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


_STORED: Final = (("stored_files", "1"), ("stored_mb", "MB"))


def growth(counts: Array) -> float:
    """Median of the last third less that of the first: a file that is open for a moment is no growth."""
    third = max(1, len(counts) // 3)
    return float(np.median(counts[-third:]) - np.median(counts[:third]))


def stored(folder: Path | None) -> tuple[float, float]:
    """Number of the files below a folder, and their size in MB; a file with several names is one.

    A file that goes meanwhile does not count.
    """
    sizes: dict[tuple[int, int], int] = {}
    for path in () if folder is None else folder.rglob("*"):
        try:
            found = path.lstat()
        except OSError:
            continue
        if S_ISREG(found.st_mode):
            sizes[found.st_dev, found.st_ino] = found.st_size
    return float(len(sizes)), sum(sizes.values()) / 1e6


def process(pid: int) -> tuple[float, float, float]:
    """Resident memory in MB, open descriptors, threads.

    Raises:
        OSError: it has ended.
    """
    here = Path("/proc") / str(pid)
    pages = int((here / "statm").read_text(encoding="ascii").split()[1])
    descriptors, threads = len(list((here / "fd").iterdir())), len(list((here / "task").iterdir()))
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6, float(descriptors), float(threads)
