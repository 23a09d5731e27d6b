"""A stored map with which every start comes to grief: after three in a row the generation before it has its turn.

Such a file is good by all that can be told from it, and meets a defect of the software. A service that is started again
and again with it would never come up; without it the robot works, and the file is there for who mends the defect. What
counts are starts since the computer was switched on: a battery that fails says nothing of a map.
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

    def begin(self, map_id: int) -> None:
        """A start begins with a map.

        Raises:
            Fatal: as many before it have come to grief. What is tried next begins anew.
        """
        boot = _boot()
        head = f"{map_id:08x} {boot} "
        before = self._before(head)
        again = before >= MOST
        with contextlib.suppress(OSError):
            self._path.write_text(f"{head}{0 if again else before + 1}\n", encoding="ascii")
        self._open = True
        if again:
            raise Fatal

    def proved(self) -> None:
        """This start has lasted, or was ended in order."""
        if self._open:
            self._open = False
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)

    def _before(self, head: str) -> int:
        try:
            said = self._path.read_text(encoding="ascii")
            return int(said[len(head) :]) if said.startswith(head) else 0
        except (OSError, ValueError):
            return 0


def _boot() -> str:
    """Which run of the computer this is; "-" where it does not say."""
    try:
        return BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return "-"
