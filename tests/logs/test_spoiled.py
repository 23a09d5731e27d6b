"""A real drive, spoiled as robots in the field spoil theirs: while wheels are right, the place is never given up."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from daemon.config.schema import Config
from daemon.replay.convert import convert
from daemon.replay.log_replay import replay
from daemon.replay.results import Trajectory
from daemon.replay.sources import open_log
from daemon.snapshot import GUESSED, State
from tests.logs.catalog import ledger_of

Lines = list[list[str]]
Spoil = Callable[[Lines], Lines]

AFTER_S = 5.0
"""Time (s) after the start from which no pose may be a guess."""


def every(count: int) -> Spoil:
    """A lidar that turns more slowly."""
    return lambda scans: scans[::count]


def gap(seconds: float) -> Spoil:
    """Nothing is received for a while, in the middle of the drive."""
    return lambda scans: scans[: len(scans) // 2] + scans[len(scans) // 2 + round(10 * seconds) :]


def swapped(scans: Lines) -> Lines:
    """Every tenth pair arrives in the wrong order."""
    for k in range(0, len(scans) - 1, 10):
        scans[k], scans[k + 1] = scans[k + 1], scans[k]
    return scans


def set_back(scans: Lines) -> Lines:
    """The clock is set back by 3 s once."""
    for scan in scans[len(scans) // 2 :]:
        scan[-3] = f"{float(scan[-3]) - 3.0:.6f}"
        scan[-1] = f"{float(scan[-1]) - 3.0:.6f}"
    return scans


def glitch(at: int, yaw: float, readings: int = 1) -> Spoil:
    """The wheels' heading is wrong in one reading."""

    def spoil(scans: Lines) -> Lines:
        for scan in scans[at : at + readings]:
            count = int(scan[8])
            robot = 9 + count + 1 + int(scan[9 + count]) + 3
            scan[robot + 2] = f"{float(scan[robot + 2]) + yaw:.6f}"
        return scans

    return spoil


def blocked(at: int, scans_blocked: int, share: float) -> Spoil:
    """A share of each scan's beams, side by side, has no return for a while."""

    def spoil(scans: Lines) -> Lines:
        for k, scan in enumerate(scans[at : at + scans_blocked]):
            count = int(scan[8])
            first = 9 + (37 * k) % max(1, round(count * (1.0 - share)))
            scan[first : first + round(count * share)] = ["0.000"] * round(count * share)
        return scans

    return spoil


KINDS: dict[str, Spoil] = {
    "clean": lambda scans: scans,
    "5 Hz": every(2),
    "3.3 Hz": every(3),
    "2 Hz": every(5),
    "gap of 5 s": gap(5.0),
    "gap of 10 s": gap(10.0),
    "swapped": swapped,
    "clock set back": set_back,
    "glitch": glitch(150, 2.0),
    "two glitches": glitch(300, 0.9, 2),
    "blocked": blocked(200, 12, 0.85),
}


@pytest.fixture(scope="session")
def drive(log_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    log = tmp_path_factory.mktemp("spoiled") / "exp2.clf"
    convert(log_root / "urg04lx" / "exp2.dat.gz", log)
    return log


def run(drive: Path, spoil: Spoil, path: Path) -> Trajectory:
    lines = [line.split() for line in drive.read_text().splitlines()]
    scans = [line for line in lines if line and line[0] == "ROBOTLASER1"]
    rest = [line for line in lines if not line or line[0] != "ROBOTLASER1"]
    path.write_text("".join(" ".join(line) + "\n" for line in rest + spoil(scans)))
    return ledger_of(replay(open_log(path), Config())).online()


@pytest.mark.parametrize("kind", KINDS)
def test_a_place_is_not_given_up_while_the_wheels_are_right(drive: Path, tmp_path: Path, kind: str) -> None:
    told = run(drive, KINDS[kind], tmp_path / "a.clf")
    late = told.stamps > told.stamps[0] + AFTER_S
    assert told.states is not None
    states = [State(int(state)) for state in told.states[late].tolist()]
    assert not [state.name for state in states if state in GUESSED]
    assert State.TRACKING in states


@pytest.mark.parametrize("kind", ["glitch", "two glitches", "swapped", "clock set back"])
def test_a_wrong_reading_costs_centimetres(drive: Path, tmp_path: Path, kind: str) -> None:
    clean = run(drive, KINDS["clean"], tmp_path / "clean.clf").poses
    spoiled = run(drive, KINDS[kind], tmp_path / "a.clf").poses
    assert np.median(np.hypot(*(clean - spoiled)[:, :2].T)) <= 0.3
