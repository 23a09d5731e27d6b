"""Output formats of results for other tools: trajectories as TUM and KITTI text, and a folder of whole files.

Each file appears whole or not at all: it is written beside its final path and then moved there.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.snapshot import GUESSED, State
from estimator import Array

_PROBE: Final = ".lumiloop-probe"
DOUBTFUL: Final = 0.1
"""Share of unconfirmed poses above which a result is doubtful as a whole."""
_TUM_HEAD: Final = "# timestamp x y z qx qy qz qw\n"


class OutputRefused(Exception):
    """A result cannot be written; the text names the file or folder, the cause and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Stamps (n,) in s, poses (n, 3) as (x, y, yaw) in m, m, rad, and published states (n,); None: any."""

    stamps: Array
    poses: Array
    states: npt.NDArray[np.int64] | None = None

    def ordered(self) -> Trajectory:
        """Returns the poses in ascending order of stamps, one per stamp: see :func:`written_rows`."""
        rows = written_rows(self.stamps)
        return Trajectory(self.stamps[rows], self.poses[rows], None if self.states is None else self.states[rows])

    def guesses(self) -> list[str]:
        """Returns for every pose the state in which it is unconfirmed; empty for a confirmed one."""
        if self.states is None:
            return [""] * len(self.stamps)
        return [State(state).name if state in GUESSED else "" for state in self.states.tolist()]


def written_stamp(stamp: float) -> float:
    """Returns a stamp, s, as a file has it: to the microsecond."""
    return round(stamp, 6)


def written_rows(stamps: Array) -> npt.NDArray[np.int64]:
    """Returns the rows that a trajectory file has, in its order: ascending by stamp, one per :func:`written_stamp`.

    Of several poses of one instant the last one stays: it includes a correction that arrived later.
    """
    written = np.array([written_stamp(stamp) for stamp in stamps.tolist()])
    order = np.argsort(written, kind="stable")
    later = np.diff(written[order], append=np.inf) > 0.0
    return order[later]


class Folder:
    """Output folder, made and tested before any work is done."""

    def __init__(self, path: Path) -> None:
        """Makes the folder if it does not exist.

        Raises:
            OutputRefused: it is a file, may not be written, or has no room.
        """
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise OutputRefused(f"{path} is a file; name a folder for the results") from error
        except OSError as error:
            raise OutputRefused(f"cannot create {path}: {error.strerror}; name a folder with write access") from error
        try:
            (path / _PROBE).write_bytes(b"may be written")
            (path / _PROBE).unlink()
        except OSError as error:
            raise OutputRefused(
                f"cannot write to {path}: {error.strerror}; free space or name another folder"
            ) from error

    def demand(self, name: str) -> None:
        """Checks that a file of that name could be written; an existing file stays.

        Raises:
            OutputRefused: it is a folder, the name is too long, or it may not be accessed.
        """
        final, beside = self._places(name)
        try:
            taken = final.is_dir()  # raises for some errors
            beside.touch()
            beside.unlink()
        except OSError as error:
            raise OutputRefused(f"cannot write {final}: {error.strerror}; name another file") from error
        if taken:
            raise OutputRefused(f"{final} is a folder; name a file in it")

    def write(self, name: str, data: bytes) -> None:
        """Writes one file.

        Raises:
            OutputRefused: no room, or no permission; an existing file stays.
        """
        final, beside = self._places(name)
        try:
            beside.write_bytes(data)
            beside.replace(final)
        except OSError as error:
            with contextlib.suppress(OSError):
                beside.unlink(missing_ok=True)
            raise OutputRefused(f"cannot write {final}: {error.strerror}; free space or name another folder") from error

    def _places(self, name: str) -> tuple[Path, Path]:
        """Returns the final path of a file, and the path that it is first written to."""
        return self.path / name, self.path / f".{name}.part"

    def write_each(self, files: Iterable[tuple[str, bytes]]) -> None:
        """Writes files by name; a file that cannot be written does not prevent the others.

        Raises:
            OutputRefused: for the first failed file, after all were tried; names the others.
        """
        refused: list[tuple[str, OutputRefused]] = []
        for name, data in files:
            try:
                self.write(name, data)
            except OutputRefused as error:
                refused.append((name, error))
        if refused:
            others = ", ".join(name for name, _ in refused[1:])
            first = refused[0][1]
            raise OutputRefused(f"{first}; {others} could not be written either" if others else str(first)) from first


def tum(trajectory: Trajectory) -> bytes:
    """Returns TUM text: ``t x y z qx qy qz qw``, one pose a line, one per stamp, ascending by stamp.

    An unconfirmed pose is a comment, ``# STATE t x y ...``, so that an
    evaluation uses confirmed poses only.
    """
    told = trajectory.ordered()
    half = 0.5 * told.poses[:, 2]
    x, y = told.poses[:, 0].tolist(), told.poses[:, 1].tolist()
    columns = (told.guesses(), told.stamps.tolist(), x, y, np.sin(half).tolist(), np.cos(half).tolist())
    lines = [
        f"{guess and f'# {guess} '}{t:.6f} {x:.6f} {y:.6f} 0 0 0 {s:.9f} {c:.9f}\n"
        for guess, t, x, y, s, c in zip(*columns, strict=True)
    ]
    return (_TUM_HEAD + "".join(lines)).encode()


def guessed(told: Trajectory) -> str:
    """Returns a sentence with the number of unconfirmed poses; empty if there are none."""
    guesses = told.guesses()
    states = Counter(filter(None, guesses))
    if not states:
        return ""
    named = ", ".join(f"{state} {count}" for state, count in states.most_common())
    last = f"; the last one too ({guesses[-1]})" if guesses[-1] else ""
    return f"{states.total()} of {len(guesses)} poses are unconfirmed ({named}){last}"


def doubt(told: Trajectory) -> str:
    """Returns a warning if more than :data:`DOUBTFUL` of the poses are unconfirmed; empty otherwise."""
    share = sum(map(bool, told.guesses())) / max(1, len(told.stamps))
    if share <= DOUBTFUL:
        return ""
    return f"{100.0 * share:.0f} % of the poses are unconfirmed; do not use this trajectory or its map"


def kitti(trajectory: Trajectory) -> bytes:
    """Returns KITTI text: the upper three rows of each pose's matrix in one line, without stamps.

    The poses are those of the TUM text, in the same order. The format has no comments, so unconfirmed poses are
    omitted.
    """
    told = trajectory.ordered()
    poses = told.poses[[not guess for guess in told.guesses()]]
    c, s = np.cos(poses[:, 2]).tolist(), np.sin(poses[:, 2]).tolist()
    rows = zip(c, s, poses[:, 0].tolist(), poses[:, 1].tolist(), strict=True)
    return "".join(
        f"{c:.9f} {-s + 0.0:.9f} 0 {x:.6f} {s:.9f} {c:.9f} 0 {y:.6f} 0 0 1 0\n" for c, s, x, y in rows
    ).encode()
