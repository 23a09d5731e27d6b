"""Results as files that other tools read: trajectories (TUM), grid maps (map_server), a picture.

Each file appears whole or not at all: it is written beside its place and moved there.
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
_TUM_HEAD: Final = "# timestamp x y z qx qy qz qw\n"


class OutputRefused(Exception):
    """A result cannot be written; the text names the file or folder, why, and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Stamps in seconds (n,), poses (x, y, yaw) (n, 3), and the states in which they were published (n,), None: any."""

    stamps: Array
    poses: Array
    states: npt.NDArray[np.int64] | None = None

    def ordered(self) -> Trajectory:
        """The same, ascending by stamp, equal stamps in their given order."""
        order = np.argsort(self.stamps, kind="stable")
        return Trajectory(self.stamps[order], self.poses[order], None if self.states is None else self.states[order])

    def guesses(self) -> list[str]:
        """For every pose the state in which it is a guess; empty: it is none."""
        if self.states is None:
            return [""] * len(self.stamps)
        return [State(state).name if state in GUESSED else "" for state in self.states.tolist()]


class Folder:
    """Where results go; made and tried before any work is done for them."""

    def __init__(self, path: Path) -> None:
        """Make the folder if it is not there.

        Raises:
            OutputRefused: it is a file, may not be written, or has no room.
        """
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise OutputRefused(f"{path} is a file; name a folder for the results") from error
        except OSError as error:
            raise OutputRefused(f"cannot make {path}: {error.strerror}; name a folder that you may write") from error
        try:
            (path / _PROBE).write_bytes(b"may be written")
            (path / _PROBE).unlink()
        except OSError as error:
            raise OutputRefused(
                f"cannot write to {path}: {error.strerror}; free space or name another folder"
            ) from error

    def demand(self, name: str) -> None:
        """Try whether a file of that name could be put in place; what is there stays.

        Raises:
            OutputRefused: it is a folder, the name is too long, or may not be looked at.
        """
        final, beside = self._places(name)
        try:
            taken = final.is_dir()  # which tells of some errors by raising them
            beside.touch()
            beside.unlink()
        except OSError as error:
            raise OutputRefused(f"cannot write {final}: {error.strerror}; name another file") from error
        if taken:
            raise OutputRefused(f"{final} is a folder; name a file in it")

    def write(self, name: str, data: bytes) -> None:
        """Put one file in place.

        Raises:
            OutputRefused: no room, no permission; what was there before stays.
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
        """Where a file goes, and where it is written first."""
        return self.path / name, self.path / f".{name}.part"

    def write_each(self, files: Iterable[tuple[str, bytes]]) -> None:
        """Put files in place by name; one that cannot be written keeps none of the others away.

        Raises:
            OutputRefused: for the first that was refused, after all were tried; names the others.
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
            raise OutputRefused(f"{first}; nor could {others} be written" if others else str(first)) from first


def tum(trajectory: Trajectory) -> bytes:
    """TUM text: ``t x y z qx qy qz qw``, one pose a line, ascending by stamp (equal stamps in their given order).

    A guess is a remark, ``# STATE t x y ...``: who reads the file compares what was said to be known.
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
    """How many of the poses say where the robot may be, not where it is, as a sentence; empty: none does."""
    guesses = told.guesses()
    states = Counter(filter(None, guesses))
    if not states:
        return ""
    named = ", ".join(f"{state} {count}" for state, count in states.most_common())
    last = f"; the last one too ({guesses[-1]})" if guesses[-1] else ""
    return f"{states.total()} of {len(guesses)} poses are guesses, their place was not known ({named}){last}"


def kitti(trajectory: Trajectory) -> bytes:
    """KITTI text: the upper three rows of each pose's matrix in one line, ascending by stamp; it has no stamps.

    It has no remarks either: guesses are left out.
    """
    told = trajectory.ordered()
    poses = told.poses[[not guess for guess in told.guesses()]]
    c, s = np.cos(poses[:, 2]).tolist(), np.sin(poses[:, 2]).tolist()
    rows = zip(c, s, poses[:, 0].tolist(), poses[:, 1].tolist(), strict=True)
    return "".join(
        f"{c:.9f} {-s + 0.0:.9f} 0 {x:.6f} {s:.9f} {c:.9f} 0 {y:.6f} 0 0 1 0\n" for c, s, x, y in rows
    ).encode()
