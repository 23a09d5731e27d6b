"""The logs whose replay is watched, committed ones of the simulator and real ones, and how replay gets to read each."""

import hashlib
from pathlib import Path

from daemon.config.schema import Config
from daemon.replay import convert
from daemon.replay.log_replay import Outcome, replay
from daemon.replay.sources import open_log
from daemon.replay.trajectories import Ledger
from tests.daemon.replay.room import carmen, drive
from tests.logs import made
from tests.logs.entries import Entry


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
        convert.convert(source, log)
        return log
    return source


def replayed(entry: Entry, root: Path | None, folder: Path) -> Outcome:
    """The log through the pipeline as a stranger's: no configuration, no recorded caps."""
    outcome = replay(open_log(prepared(entry, root, folder)), Config())
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
