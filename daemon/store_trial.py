"""A stored map with which every start comes to grief: after three in a row the generation before it has its turn.

Such a file is good by all that can be told from it, and meets a defect of the software. A service that is started again
and again with it would never come up; without it the robot works, and the file is there for who mends the defect. What
counts are starts since the computer was switched on, a battery that fails says nothing of a map, and those that have
come as far as to begin with it: nor does a cache or a folder for a recording that has no room. Where the starts without
any map come to grief as well, it was not the maps: they are put back.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from daemon.store_file import Damaged

NAME: Final = "starts"
"""File in the folder of maps: a map's identity, the boot, how many starts began with it that are not proved, and the
files that have been set aside since the last one that was."""
NONE: Final = "-"
"""In place of an identity: the start began without a map."""
MOST: Final = 3
PROOF_S: Final = 10.0
"""A start that has lasted so long since its map was loaded is none that the map has ended."""
BOOT: Final = Path("/proc/sys/kernel/random/boot_id")


class Fatal(Damaged):
    """Nothing is wrong with it, but no start outlives it."""

    remedy = "it is kept for whoever mends that, and done without; under its old name it is tried again"

    def __init__(self) -> None:
        super().__init__(f"{MOST} starts in a row have begun with it, and none has lasted for {PROOF_S:g} s")


class Innocent(Exception):
    """Starts without the maps that were set aside have come to grief as well.

    Attributes:
        names: the files that are to be put back. None of them goes again before a start has lasted.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        super().__init__(f"{MOST} starts in a row without {', '.join(names)} have not lasted either")
        self.names = names


class Trial:
    """Counts starts, in a file. Where it cannot be written, none counts."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._open = False
        self._next: Told | None = None

    def judge(self, map_id: int | None) -> None:
        """A map is about to be used, or there is none.

        Where one was set aside in this run of the computer, and no start has lasted since, another map is not the next
        one to go: what ends every start is something else then.

        Raises:
            Fatal: as many starts with it have come to grief. What is tried next begins anew.
            Innocent: it is no better without what was set aside.
        """
        mine, told = NONE if map_id is None else f"{map_id:08x}", self._before()
        self._open, self._next = True, None
        if told.boot != _boot():
            told = Told(mine, _boot())
        elif told.of != mine and told.aside:
            told = replace(told, of=NONE, count=told.count if told.of == NONE else 0)
        elif told.of != mine and told.count == 0:
            return
        elif told.of != mine:
            told = Told(mine, told.boot)
        if told.of == NONE and not told.aside:
            return
        if told.count >= MOST and told.of != NONE and self._wrote(replace(told, count=0)):
            raise Fatal
        if told.count >= MOST and told.of == NONE and self._wrote(Told(NONE, told.boot)):
            raise Innocent(told.aside)
        self._next = replace(told, count=told.count + 1)

    def begin(self) -> None:
        """The estimator is about to begin with it: what ends this start from now on may be the map."""
        if self._next is not None:
            self._wrote(self._next)

    def set_aside(self, name: str) -> None:
        """The file with which no start has lasted is called so from now on."""
        told = self._before()
        self._wrote(replace(told, aside=(*told.aside, name)))

    def proved(self) -> None:
        """This start has lasted, or was ended in order."""
        if self._open:
            self._open = False
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)

    def _wrote(self, told: Told) -> bool:
        words = "\n".join((f"{told.of} {told.boot} {told.count}", *told.aside, ""))
        try:
            self._path.write_text(words, encoding="utf-8", errors="surrogateescape")
        except OSError:
            return False
        return True

    def _before(self) -> Told:
        """What the file tells; of no map and no run where it cannot be read."""
        try:
            first, *aside = self._path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
            of, boot, count = first.split()
            return Told(of, boot, int(count), tuple(aside))
        except (OSError, ValueError):
            return Told()


@dataclass(frozen=True, slots=True)
class Told:
    """What the file holds.

    Attributes:
        of: the map, :data:`NONE` for starts without those set aside. boot: the run of the computer. count: of starts.
        aside: names of files.
    """

    of: str = ""
    boot: str = ""
    count: int = 0
    aside: tuple[str, ...] = ()


def _boot() -> str:
    """Which run of the computer this is; "-" where it does not say."""
    try:
        return BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return "-"
