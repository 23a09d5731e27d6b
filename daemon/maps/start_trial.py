"""Guard against a stored map with which every start fails: after three failures the generation before it is used.

Such a file passes every check, but triggers a defect of the software. A service that restarts with it again and again
would never come up; without it the robot works.
Only starts since the computer was switched on count, because a failing battery is not the map's fault. Only starts that
reached the estimator count: a full disk for the kernel cache or a recording is not the map's fault either.

An excluded file stays in place until a start without it has lasted, which is the evidence against it. Only then it is
moved aside (`daemon.maps.store`). Where three starts without any map do not last either, all files are tried again, and
so on in turn.
"""

from __future__ import annotations

import contextlib
import json
import logging
from pathlib import Path
from typing import Annotated, Final

import msgspec
from msgspec.structs import replace

from daemon.system.atomic_file import write_whole
from daemon.system.regular_file import read_regular

log = logging.getLogger(__name__)

NAME: Final = "starts"
"""Name of the JSON file with the counts, in the folder of maps."""
MOST: Final = 3
MOST_STARTS: Final = 1 << 31
"""Largest plausible count."""
MOST_OUT: Final = 1000
"""Largest number of excluded files."""
MOST_BYTES: Final = 1 << 20
"""Largest size of the file in bytes."""
PROOF_S: Final = 10.0
"""Time in s since loading the map after which the map cannot be the cause of a failure."""
BOOT: Final = Path("/proc/sys/kernel/random/boot_id")
LEFT_OUT: Final = (
    f"{MOST} starts in a row with this map have failed within {PROOF_S:g} s. The daemon starts without it, "
    "and moves it aside after a successful start"
)


Count = Annotated[int, msgspec.Meta(ge=0, le=MOST_STARTS)]
FileName = Annotated[str, msgspec.Meta(pattern=r"^[^/]*\.lumimap\Z")]


class StartAttempts(msgspec.Struct, frozen=True):
    """Content of the file.

    Attributes:
        boot: boot ID of the computer. of: name of the file with which the starts began, empty: none. count: consecutive
            starts that have not lasted. out: names of excluded files.
    """

    boot: str = ""
    of: str = ""
    count: Count = 0
    out: Annotated[tuple[FileName, ...], msgspec.Meta(max_length=MOST_OUT)] = ()


class StartTrial:
    """Counts starts, in a file. Where it cannot be written, none counts.

    Attributes:
        out: names of the excluded files.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._told, self._begun = StartAttempts(), False
        self.out: tuple[str, ...] = ()

    def read(self) -> None:
        """Read the counts of earlier starts since the computer was switched on."""
        boot = _boot()
        try:
            before = msgspec.convert(json.loads(read_regular(self._path, MOST_BYTES)), StartAttempts)
        except FileNotFoundError:
            before = StartAttempts()
        except (OSError, ValueError, RecursionError) as error:  # ValueError: not JSON, or other values than declared
            wrong = f"cannot be read: {error.strerror}" if isinstance(error, OSError) else "is damaged"
            log.warning("%s %s; the count of starts begins at zero", self._path, wrong)
            before = StartAttempts()
        self._told = before if before.boot == boot else StartAttempts(boot)
        self.out = self._told.out

    def changes(self, name: str) -> bool:
        """Register this start's file (empty: none); return whether it is excluded and another has to be chosen.

        The count of the next choice starts at zero.
        """
        told = self._told if self._told.of == name else replace(self._told, of=name, count=0)
        out = (*told.out, name) if name else ()
        if told.count < MOST or out == told.out or not self._wrote(replace(told, count=0, out=out)):
            self._told = told
            return False
        self.out = out
        return True

    def begin(self) -> None:
        """Count this start: from now on, its failure may be caused by the map."""
        if self._told.of or self._told.out:
            self._begun = self._wrote(replace(self._told, count=self._told.count + 1))

    def ended(self) -> None:
        """Undo the count of this start: it was stopped on request before it had lasted."""
        if self._begun:
            self._begun = False
            self._wrote(replace(self._told, count=self._told.count - 1))

    def lasted(self) -> tuple[str, ...]:
        """Clear all counts, because this start has lasted; return the files excluded from it."""
        out, self.out, self._begun = self.out, (), False
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        return out

    def _wrote(self, told: StartAttempts) -> bool:
        try:
            write_whole(self._path, json.dumps(msgspec.to_builtins(told)).encode())
        except OSError:
            return False
        self._told = told
        return True


def _boot() -> str:
    """Boot ID of the computer; "-" where it is not available."""
    try:
        return BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return "-"
