"""What an experiment hands back, and how its work is spread over the cores of a machine.

An experiment is a module of this package with ``run(quick: bool, work: Work) -> Report``. It raises :class:`Skipped`
where something outside is missing (recorded data). With ``quick`` it does a small part of the same, in seconds, so that
a test can run it.
"""

import hashlib
import json
import math
import multiprocessing
import os
import pickle
import re
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, TypeVar

from tools.ci.figures import Figure

Item = TypeVar("Item")
Result = TypeVar("Result")
Cell = str | float | int

COMMAND: Final = "python -m tools.experiments --only"
ROOT: Final = Path(__file__).parents[3]
BAR: Final = 30
"""Characters of a progress bar."""


class Skipped(RuntimeError):
    """The experiment cannot run here; the message says what is missing."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows under a head; numbers keep their full digits in JSON and are shown with four."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def text(self) -> str:
        """Aligned for a terminal, the first column to the left, numbers to the right."""
        cells = [list(self.head), *([_shown(cell) for cell in row] for row in self.rows)]
        widths = [max(len(row[i]) for row in cells) for i in range(len(self.head))]
        lines = [
            "  ".join(cell.rjust(width) if i else cell.ljust(width) for i, (cell, width) in enumerate(pairs)).rstrip()
            for pairs in (list(zip(row, widths, strict=True)) for row in cells)
        ]
        return "\n".join([self.title, *lines])


def _shown(cell: Cell) -> str:
    return cell if isinstance(cell, str) else str(cell) if isinstance(cell, int) else f"{cell:.4g}"


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawing: ``draw`` gets an empty matplotlib figure; saved as ``<name>.png``."""

    name: str
    draw: Callable[[Any], None]
    inches: tuple[float, float] = (7.0, 4.5)


@dataclass(frozen=True, slots=True)
class Report:
    """Everything one experiment found.

    Attributes:
        figures: single numbers, judged where the project has a bound for them. seeds: of every random generator used.
        notes: sentences that must stand beside the numbers (conditions, caveats).
    """

    figures: tuple[Figure, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    seeds: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()


class Work:
    """Spreads independent trials over processes and says on stderr how far they are.

    Args:
        jobs: processes; 1 runs everything here, in order, which is also what a debugger wants.
        progress: whether to write to stderr at all.
        trials: how many an experiment that repeats something at random is to make; 0: as many as it thinks fit.
        rows: those that an experiment of several rows is to make; empty: all.
    """

    def __init__(self, jobs: int = 1, progress: bool = False, trials: int = 0, rows: tuple[str, ...] = ()) -> None:
        if jobs < 1:
            raise ValueError(f"jobs = {jobs}: at least one process is needed")
        self.jobs, self.progress, self.trials, self.rows = jobs, progress, trials, rows
        self._shown_at = -math.inf

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], label: str = "", keep: Path | None = None
    ) -> list[Result]:
        """``[function(item) for item in items]``, in that order; both must be importable by other processes.

        ``keep``: a folder in which each result is stored when it is done; a run that was interrupted goes on there.

        Raises:
            whatever ``function`` raises.
        """
        trials = list(items)
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            function = partial(_kept, function, keep)
        if self.jobs == 1 or len(trials) < 2:
            return self._collect(map(function, trials), len(trials), label)
        # spawn: a fork would copy threads' locks; each child imports afresh, with kernels from the cache
        with ProcessPoolExecutor(min(self.jobs, len(trials)), multiprocessing.get_context("spawn"), _gentle) as pool:
            return self._collect(pool.map(function, trials), len(trials), label)

    def _collect(self, results: Iterable[Result], total: int, label: str) -> list[Result]:
        done: list[Result] = []
        for result in results:
            done.append(result)
            self._show(label, len(done), total)
        return done

    def _show(self, label: str, done: int, total: int) -> None:
        now = time.monotonic()
        if self.progress and (done == total or now - self._shown_at > 1.0):
            self._shown_at = now
            bar = ("#" * (BAR * done // total)).ljust(BAR, ".")
            sys.stderr.write(f"\r  {bar} {done}/{total} {label}\x1b[K" + ("\n" if done == total else ""))
            sys.stderr.flush()


def _kept(function: Callable[[Item], Result], folder: Path, item: Item) -> Result:
    """The result that is stored for an item; else it is made, and stored."""
    path = folder / f"{re.sub(r'[^A-Za-z0-9.]+', '-', repr(item)).strip('-')}.pickle"
    if path.exists():
        result: Result = pickle.loads(path.read_bytes())  # made by this code, under a digest of it
        return result
    result = function(item)
    path.with_suffix(".new").write_bytes(pickle.dumps(result))
    path.with_suffix(".new").replace(path)
    return result


@cache
def code(*patterns: str) -> str:
    """A digest of source files of this tree: what was made by other code is not taken for what this one would make."""
    whole = hashlib.sha256()
    for pattern in patterns:
        for path in sorted(ROOT.glob(pattern)):
            whole.update(path.read_bytes())
    return whole.hexdigest()[:12]


def _gentle() -> None:
    """A worker gives way to whatever else the machine does."""
    os.nice(5)


def save(name: str, report: Report, facts: dict[str, object], folder: Path) -> list[Path]:
    """Write the pictures and, last of all, ``<name>.json``; returns what was written, the JSON first.

    ``facts`` (command, seconds, quick) go in front. Without matplotlib the pictures are left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures = draw(report, folder)
    data: dict[str, object] = {
        **facts,
        "seeds": list(report.seeds),
        "pictures": [path.name for path in pictures],
        "notes": list(report.notes),
        "figures": [asdict(f) | {"value": _plain(f.value)} for f in report.figures],
        "tables": [
            {"title": t.title, "head": t.head, "rows": [[_plain(c) for c in r] for r in t.rows]} for t in report.tables
        ],
    }
    path = folder / f"{name}.json"
    path.with_suffix(".new").write_text(json.dumps(data, indent=1) + "\n")
    path.with_suffix(".new").replace(path)
    return [path, *pictures]


def draw(report: Report, folder: Path) -> list[Path]:
    """The pictures as PNG of 64 colours, which is a third of the size; none without matplotlib."""
    try:
        from matplotlib.figure import Figure as Canvas
        from PIL import Image  # comes with matplotlib
    except ImportError:
        return []
    paths = []
    for picture in report.pictures:
        canvas = Canvas(figsize=picture.inches, dpi=110, layout="constrained")
        picture.draw(canvas)
        paths.append(folder / f"{picture.name}.png")
        canvas.savefig(paths[-1])
        with Image.open(paths[-1]) as image:
            image.convert("RGB").quantize(64).save(paths[-1], optimize=True)
    return paths


def _plain(value: Cell) -> Cell | None:
    """A number JSON can hold (numpy's scalars cannot be; NaN and infinity become null)."""
    if isinstance(value, str):
        return value
    if not isinstance(value, float):
        return int(value)
    return float(value) if math.isfinite(value) else None
