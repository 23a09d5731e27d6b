"""A stored map with which every start comes to grief: after three in a row the generation before it has its turn.

Such a file is good by all that can be told from it, and meets a defect of the software. A service that is started again
and again with it would never come up; without it the robot works, and the file is there for who mends the defect. What
counts are starts since the computer was switched on, a battery that fails says nothing of a map, and those that have
come as far as to begin with it: nor does a cache or a folder for a recording that has no room.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final

from daemon.store_file import Damaged

NAME: Final = "starts"
"""File in the folder of maps: a map's identity, the boot, and how many starts began with it that are not proved."""
MOST: Final = 3
PROOF_S: Final = 10.0
"""A start that has lasted so long since its map was loaded is none that the map has ended."""
BOOT: Final = Path("/proc/sys/kernel/random/boot_id")


class Fatal(Damaged):
    """Nothing is wrong with it, but no start outlives it."""

    remedy = "it is kept for whoever mends that, and done without; under its old name it is tried again"

    def __init__(self) -> None:
        super().__init__(f"{MOST} starts in a row have begun with it, and none has lasted for {PROOF_S:g} s")


class Trial:
    """Counts starts, in a file. Where it cannot be written, none counts."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._open = False
        self._next = ""

    def judge(self, map_id: int) -> None:
        """A map is about to be used.

        Where one was set aside in this run of the computer, and no start has lasted since, another map is not the next
        one to go: what ends every start is something else then.

        Raises:
            Fatal: as many starts with it have come to grief. What is tried next begins anew.
        """
        boot = _boot()
        map_of, run, before = self._before()
        mine, self._open, self._next = f"{map_id:08x}", True, ""
        if run != boot or (map_of != mine and before > 0):
            before = 0
        elif map_of != mine:
            return
        if before >= MOST and self._wrote(f"{mine} {boot} 0\n"):
            raise Fatal
        self._next = f"{mine} {boot} {before + 1}\n"

    def begin(self) -> None:
        """The estimator is about to begin with it: what ends this start from now on may be the map."""
        if self._next:
            self._wrote(self._next)

    def proved(self) -> None:
        """This start has lasted, or was ended in order."""
        if self._open:
            self._open = False
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)

    def _wrote(self, said: str) -> bool:
        try:
            self._path.write_text(said, encoding="ascii")
        except OSError:
            return False
        return True

    def _before(self) -> tuple[str, str, int]:
        """Map, run of the computer and count that the file tells of; empty where it cannot be read."""
        try:
            map_of, run, count = self._path.read_text(encoding="ascii").split()
            return map_of, run, int(count)
        except (OSError, ValueError):
            return "", "", 0


def _boot() -> str:
    """Which run of the computer this is; "-" where it does not say."""
    try:
        return BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return "-"
