"""Which logs are watched. Imports nothing of the estimator: a command tells its names before that is compiled."""

import argparse
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

VARIABLE: Final = "LUMILOOP_DATA"
NO_DATA: Final = f"{VARIABLE} does not name the folder of real logs"


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


class NotThere(Exception):
    """There is no log of that name, or what is to be the folder of real ones is none; the text says so."""


def data_folder(entries: list[Entry]) -> Path | None:
    """Where real logs are, as the environment says; None: it does not, or none of these is one.

    Raises:
        NotThere: what it names is no folder.
    """
    named = os.environ.get(VARIABLE)
    if not named or not any(entry.source for entry in entries):
        return None
    if not Path(named).is_dir():
        raise NotThere(
            f"{VARIABLE}={named}: no such folder; unset it, or name the one with intel/, aces/ and the others"
        )
    return Path(named)


def chosen(names: list[str]) -> list[Entry]:
    """Those of these names, all where there is none.

    Raises:
        NotThere: there is no log of one of these names.
    """
    if unknown := sorted(set(names) - set(BY_NAME)):
        raise NotThere(f"no such log: {', '.join(unknown)}; there are {', '.join(BY_NAME)}")
    return [entry for entry in ENTRIES if not names or entry.name in names]


def asked(parser: argparse.ArgumentParser, names: list[str]) -> tuple[list[Entry], Path | None]:
    """What a command was asked for, and where real logs are; ends it with a text where one of them is not there.

    The estimator is loaded with it, which says that it is compiled where it is, unless nothing can be replayed.
    """
    try:
        entries = chosen(names)
        data = data_folder(entries)
    except NotThere as error:
        parser.error(str(error))
    if data is not None or not all(entry.source for entry in entries):
        from daemon.runtime import warmup
        from daemon.system import console

        warmup.load_aloud(console.say, "warm", warmup.load)
    return entries, data
