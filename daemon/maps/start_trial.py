"""Guard against a stored map with which every start fails: after three failures the generation before it is used.

Such a file is good by all that can be told from it, and meets a defect of the software. A service that is started again
and again with it would never come up; without it the robot works. What counts are starts since the computer was
switched on, a battery that fails says nothing of a map, and those that have come as far as to begin: a cache or a
folder for a recording that has no room says nothing either.

What is left out stays where it is until a start without it has lasted, which is what speaks against it: only then it is
moved aside (`daemon.maps.store`). Where three starts without any map do not last either, all are tried again, and so on
in turn.
"""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from daemon.system.atomic_file import write_whole

NAME: Final = "starts"
"""File in the folder of maps: what has been counted, as JSON."""
MOST: Final = 3
PROOF_S: Final = 10.0
"""A start that has lasted so long since its map was loaded is none that the map has ended."""
BOOT: Final = Path("/proc/sys/kernel/random/boot_id")
LEFT_OUT: Final = (
    f"{MOST} starts in a row have begun with it, and none has lasted for {PROOF_S:g} s; it is left out, and moved "
    "aside, for whoever mends that, once a start without it has lasted"
)


@dataclass(frozen=True, slots=True)
class StartAttempts:
    """What the file holds.

    Attributes:
        boot: the run of the computer. of: the file that starts have begun with, empty: with none. count: of starts in a
            row that have not lasted. out: files that are left out.
    """

    boot: str = ""
    of: str = ""
    count: int = 0
    out: tuple[str, ...] = ()


class StartTrial:
    """Counts starts, in a file. Where it cannot be written, none counts.

    Attributes:
        out: names of the files that are left out.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._told, self._begun = StartAttempts(), False
        self.out: tuple[str, ...] = ()

    def read(self) -> None:
        """Take up what earlier starts of this run of the computer have come to."""
        boot = _boot()
        try:
            told = json.loads(self._path.read_text(encoding="ascii"))
            before = StartAttempts(str(told["boot"]), str(told["of"]), int(told["count"]), tuple(map(str, told["out"])))
        except (OSError, ValueError, KeyError, TypeError):
            before = StartAttempts()
        self._told = before if before.boot == boot else StartAttempts(boot)
        self.out = self._told.out

    def changes(self, name: str) -> bool:
        """This start would begin with this file, empty: with none. Whether it shall choose anew, out of others.

        Where it may, what is chosen then has as many starts as this had.
        """
        told = self._told if self._told.of == name else replace(self._told, of=name, count=0)
        out = (*told.out, name) if name else ()
        if told.count < MOST or out == told.out or not self._wrote(replace(told, count=0, out=out)):
            self._told = told
            return False
        self.out = out
        return True

    def begin(self) -> None:
        """The estimator is about to begin: what ends this start from now on may be the map."""
        if self._told.of or self._told.out:
            self._begun = self._wrote(replace(self._told, count=self._told.count + 1))

    def ended(self) -> None:
        """Somebody has ended this start before it had lasted, so it says nothing."""
        if self._begun:
            self._begun = False
            self._wrote(replace(self._told, count=self._told.count - 1))

    def lasted(self) -> tuple[str, ...]:
        """This start has: no other one counts any more. Returns what it has done without."""
        out, self.out, self._begun = self.out, (), False
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        return out

    def _wrote(self, told: StartAttempts) -> bool:
        try:
            write_whole(self._path, json.dumps(asdict(told)).encode())
        except OSError:
            return False
        self._told = told
        return True


def _boot() -> str:
    """Which run of the computer this is; "-" where it does not say."""
    try:
        return BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return "-"
