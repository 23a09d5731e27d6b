"""The logs whose replay is watched, committed ones of the simulator and real ones, and how replay gets to read each."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.config import Config
from daemon.ledger import Ledger
from daemon.replay import Outcome, replay
from tests.daemon.replay.room import carmen, drive
from tests.logs import made
from tools import convert


@dataclass(frozen=True)
class Entry:
    """One log.

    Attributes:
        name: of its golden file. source: below the folder of real logs; empty for the simulator's.
        sha256: of the source, so that a golden trajectory is never held against another log.
        every: one pose in so many is kept in the golden file.
        heavy: replayed in the full test run only.
    """

    name: str
    source: str
    sha256: str
    every: int
    heavy: bool = False


ENTRIES: Final = (
    Entry("room", "", "", 10),
    Entry("laps", "", "", 10),
    Entry("lamps", "", "", 4),
    Entry("intel", "intel/intel.clf.gz", "969f6eb0dc4c9af9995ca45b1885ebadaa4aa7c8cfe813250b675e1a007061b7", 200),
    Entry(
        "aces", "aces/aces.clf.gz", "6c65d4fe04e5192b1658fefb2b05cef796cf8cf53de6bccca444a141c6d95361", 120, heavy=True
    ),
    Entry("exp1", "urg04lx/exp1.dat.gz", "8838567e3dbc46d8c18a8277d1b144da45e54a2ed82b636a8924cac1c8bff893", 15),
    Entry(
        "exp2",
        "urg04lx/exp2.dat.gz",
        "c073238f80c6f46d97640f8f109903f619719c05369c47bf088989cb8a36f012",
        15,
        heavy=True,
    ),
    Entry(
        "utm", "utm30lx/scans.npz", "3a90217af1f7aab62ec3529ad9362c7cd53533a16c7176b877f93825e9e38220", 20, heavy=True
    ),
    Entry("scip", "scip/example_urg_04lx.logr", "75b1b5155beaa438ca33630eef1c368b816305405400184fdfe0f662829a5218", 1),
)
BY_NAME: Final = {entry.name: entry for entry in ENTRIES}


class OtherLog(AssertionError):
    """The source is not there, or is not the log that was blessed; the text says which."""


def prepared(entry: Entry, root: Path | None, folder: Path) -> Path:
    """The log as replay reads it; converted or made in ``folder`` where it has to be.

    Raises:
        OtherLog: the source is not the log that was blessed.
    """
    if entry.name in made.MADE:
        return made.unpacked(entry.name, folder)
    if not entry.source:
        return carmen(folder / "room.log", drive())
    assert root is not None
    source = root / entry.source
    try:
        digest = hashlib.sha256(source.read_bytes()).hexdigest()
    except OSError as error:
        raise OtherLog(f"{source}: {error.strerror}; LUMILOOP_DATA names the folder of real logs") from error
    if digest != entry.sha256:
        raise OtherLog(f"{source} is another log than the one that was blessed: its SHA-256 is {digest}")
    if source.suffix == ".npz" or ".dat" in source.name:
        log = folder / f"{entry.name}.log"
        assert convert.main([str(source), str(log)]) == 0
        return log
    return source


def replayed(entry: Entry, root: Path | None, folder: Path) -> Outcome:
    """The log through the pipeline as a stranger's: no configuration, no recorded caps."""
    outcome = replay(prepared(entry, root, folder), Config())
    assert not outcome.stopped
    return outcome


def origin(entry: Entry) -> str:
    """What the golden poses are of, so that they are never held against another log."""
    if entry.name in made.MADE:
        return hashlib.sha256(made.packed(entry.name).read_bytes()).hexdigest()
    return entry.sha256 or "made by tests/daemon/replay/room.py"


def ledger_of(outcome: Outcome) -> Ledger:
    """Everything that was kept."""
    return outcome.rerun.ledger
