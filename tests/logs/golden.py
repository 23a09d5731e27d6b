"""Golden trajectories: small text files that say where the robot was, when replay was last blessed, and why.

A change of the estimator changes them; the change is then looked at, and blessed in the same commit with its reason.
Of each log there are two files: the poses as they are at the end, and as they were published live (``NAME.live``),
which no loop that is closed later has put right. A file holds one pose in many and a digest of all. Kernels compiled
for another processor round differently, so the tight tolerance counts only where versions and processor are those of
the blessing. On another machine the tight one counts against a reference of its own, where one was made
(``bless --here``); it is not committed.
"""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import llvmlite.binding
import numpy as np
import numpy.typing as npt

from daemon.replay.results import Trajectory, tum
from daemon.replay.trajectories import Ledger
from daemon.system.versions import versions
from estimator.result import Loop

Array = npt.NDArray[np.float64]

FOLDER: Final = Path(__file__).parent / "golden"
HERE: Final = Path(__file__).parents[2] / "out" / "golden"
"""References of this machine."""
TIGHT_M: Final = 1e-6
REMEDY: Final = "python -m tests.logs.bless --reason TEXT"
LOOSE_M: Final = 1e-3
"""On another processor, or with other versions: and the same loops."""


@dataclass(frozen=True)
class Golden:
    """A blessed trajectory: facts of the blessing, stamps (n,), poses (n, 3)."""

    facts: dict[str, str]
    stamps: Array
    poses: Array


def environment() -> str:
    """Whatever may change the last bits of a result."""
    found = versions()
    parts = ("python", "numpy", "numba", "llvmlite", "scipy", "machine")
    cpu = os.environ.get("NUMBA_CPU_NAME") or llvmlite.binding.get_host_cpu_name()
    return " ".join(f"{part}={found[part]}" for part in parts) + f" cpu={cpu}"


def facts_of(trajectory: Trajectory, loops: Sequence[Loop], log: str, reason: str) -> dict[str, str]:
    """What is written above the poses."""
    return {
        "log": log,
        "reason": reason,
        "environment": environment(),
        "poses": str(len(trajectory.stamps)),
        "loops": loops_of(loops),
        "digest": digest(trajectory),
    }


def loops_of(loops: Sequence[Loop]) -> str:
    """How many were closed, and between which keyframes."""
    pairs = " ".join(f"{loop.keyframe_new}-{loop.keyframe_old}" for loop in loops)
    return f"{len(loops)} {hashlib.sha256(pairs.encode()).hexdigest()[:16]}"


@dataclass(frozen=True)
class Verdict:
    """Of one replay against its golden file: whether it may stay, and in words by how much it differs."""

    same: bool
    said: str


def judged(blessed: Golden, trajectory: Trajectory, loops: Sequence[Loop], every: int) -> Verdict:
    """To the last digit where it was blessed on such a machine, else to a millimetre and by the same loops."""
    off = largest_difference(blessed, trajectory, every)
    here = blessed.facts["environment"] == environment()
    wrong = []
    if blessed.facts["poses"] != str(len(trajectory.stamps)):
        wrong.append(f"{len(trajectory.stamps)} poses, {blessed.facts['poses']} when blessed")
    limit = TIGHT_M if here else LOOSE_M
    if not off <= limit:
        wrong.append(f"moved by up to {off:.6f} m, {begun(blessed, trajectory, every, limit)}")
    if blessed.facts["loops"] != loops_of(loops):
        wrong.append(f"loops {loops_of(loops)}, {blessed.facts['loops']} when blessed")
    if here and blessed.facts["digest"] != digest(trajectory):
        wrong.append("poses between those that are kept differ")
    where = "same machine" if here else "another processor, or other versions"
    said = f"{where}: {'; '.join(wrong)} since {blessed.facts['reason']!r}" if wrong else f"{where}: {off:.6f} m"
    return Verdict(not wrong, said)


def both(name: str, ledger: Ledger) -> dict[str, Trajectory]:
    """By the names of their files: the poses at the end, and those published live, with their states."""
    return {name: ledger.final(), f"{name}.live": ledger.online()}


def held(name: str, ledger: Ledger, every: int) -> Verdict:
    """Of one replay: both of its trajectories against what was blessed; see :func:`compared`."""
    loops = [loop for _, loop in ledger.loops]
    verdicts = [compared(file, told, loops, every) for file, told in both(name, ledger).items()]
    return Verdict(all(one.same for one in verdicts), "; live, ".join(one.said for one in verdicts))


def compared(name: str, trajectory: Trajectory, loops: Sequence[Loop], every: int) -> Verdict:
    """With the committed file; where that is of another machine also with this one's reference, if there is one.

    Raises:
        Damaged: one of the files is none.
    """
    blessed = load(name)
    verdict = judged(blessed, trajectory, loops, every)
    if blessed.facts["environment"] == environment():
        return verdict
    if not (HERE / f"{name}.txt").exists() or (own := load(name, HERE)).facts["environment"] != environment():
        return Verdict(verdict.same, f"{verdict.said} (to 1 mm only; bless --here keeps a reference of this one)")
    here = judged(own, trajectory, loops, every)
    return Verdict(verdict.same and here.same, f"{verdict.said}; by this machine's own reference, {here.said}")


def digest(trajectory: Trajectory) -> str:
    """Of the whole trajectory as it is written, so to 1e-6 m."""
    return hashlib.sha256(tum(trajectory)).hexdigest()


def thinned(trajectory: Trajectory, every: int) -> tuple[Array, Array]:
    """One pose in ``every``, and the last one."""
    chosen = np.unique(np.append(np.arange(0, len(trajectory.stamps), every), len(trajectory.stamps) - 1))
    return trajectory.stamps[chosen], trajectory.poses[chosen]


def save(name: str, trajectory: Trajectory, every: int, facts: dict[str, str], folder: Path | None = None) -> Path:
    """Write a golden file; ``folder``: other than the committed ones'."""
    stamps, poses = thinned(trajectory, every)
    lines = [f"# {key}: {value}" for key, value in facts.items()]
    lines += [f"{t:.6f} {x:.6f} {y:.6f} {yaw:.6f}" for t, (x, y, yaw) in zip(stamps, poses.tolist(), strict=True)]
    folder = folder or FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


class Damaged(Exception):
    """A golden file cannot be read; names the file and the remedy."""


FACTS: Final = ("environment", "poses", "loops", "digest", "reason")


def load(name: str, folder: Path | None = None) -> Golden:
    """Read a golden file; ``folder``: other than the committed ones'.

    Raises:
        Damaged: it is none.
    """
    path = (folder or FOLDER) / f"{name}.txt"
    facts = {}
    try:
        text = path.read_text()
    except FileNotFoundError as error:
        raise Damaged(f"{path}: no such file; git checkout it, or bless it anew: {REMEDY}") from error
    for line in text.splitlines():
        if line.startswith("# "):
            key, _, value = line[2:].partition(": ")
            facts[key] = value
    lacks = [fact for fact in FACTS if fact not in facts]
    try:
        rows = np.loadtxt(path, comments="#", ndmin=2)
    except ValueError as error:
        raise Damaged(f"{path}: {error}; git checkout it, or bless it anew: {REMEDY}") from error
    if lacks or rows.shape[1:] != (4,):
        lacking = f"no line {lacks[0]!r}" if lacks else f"{rows.shape[1]} columns, there must be 4"
        raise Damaged(f"{path}: {lacking}; git checkout it, or bless it anew: {REMEDY}")
    return Golden(facts, rows[:, 0], rows[:, 1:])


def largest_difference(golden: Golden, trajectory: Trajectory, every: int, motion: bool = False) -> float:
    """Metres (a radian counts as a metre) between the blessed poses and these; infinite where the stamps differ.

    ``motion``: between the motions from each kept pose to the next, which forget what was long ago.
    """
    stamps, poses = thinned(trajectory, every)
    if _other_stamp(golden, stamps) is not None:
        return float("inf")
    off = _motion(poses) - _motion(golden.poses) if motion else poses - golden.poses
    return float(_metres(off).max(initial=0.0))


def begun(golden: Golden, trajectory: Trajectory, every: int, limit: float) -> str:
    """In words: the first kept pose that is off by more than ``limit`` m, or the first stamp that is another one.

    These are poses as they are at the end: a loop moves what was before it, too.
    """
    stamps, poses = thinned(trajectory, every)
    other = _other_stamp(golden, stamps)
    if other is not None:
        now, then = (f"{of[other]:.6f}" if other < len(of) else "no more" for of in (stamps, golden.stamps))
        return f"kept stamp {other} is the first that differs: {now}, {then} when blessed"
    metres = _metres(poses - golden.poses)
    first = int(np.argmax(~(metres <= limit)))  # what is no number is off, too
    after = f", {stamps[first - 1]:.6f} was the last as blessed" if first else ""
    return f"first at stamp {stamps[first]:.6f} by {metres[first]:.6f} m{after}"


def _other_stamp(golden: Golden, stamps: Array) -> int | None:
    """The first kept stamp that is not the blessed one; None: all are the same."""
    both = min(len(stamps), len(golden.stamps))
    differ = np.flatnonzero(np.abs(stamps[:both] - golden.stamps[:both]) > 2e-6)
    if differ.size:
        return int(differ[0])
    return None if len(stamps) == len(golden.stamps) else both


def _metres(off: Array) -> Array:
    """Of each difference of two poses, a radian for a metre."""
    turn = np.remainder(off[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(np.maximum(np.hypot(off[:, 0], off[:, 1]), np.abs(turn)))


def _motion(poses: Array) -> Array:
    """Each pose but the first as seen from the one before."""
    before, step = poses[:-1], np.diff(poses, axis=0)
    cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
    x, y = cos * step[:, 0] + sin * step[:, 1], cos * step[:, 1] - sin * step[:, 0]
    return np.column_stack([x, y, step[:, 2]])
