"""Map store: the folder of map files in generations, of which the newest good one is loaded.

A map is written under a temporary name, synced, renamed, read back and compared; only then are older generations
deleted. A power cut, or a kill at any moment, therefore leaves the old map or the new one. A damaged file is renamed
with the suffix ``.broken``; the newest few of these stay.

Of the map in use, the store keeps the two newest generations, of which one may fail. It also keeps the one with which
this run started. That one is the last that a whole run has confirmed, should this run spoil the map. Of every other map
(RESET starts one, and each building has its own) the newest good generation is kept, of the seven latest maps. A file
is deleted only after it and the newer ones that replace it have been read (`daemon.maps.generations`). A file that
cannot be read now counts as no generation and stays.
"""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Final

from daemon.devices.light_setup import Lights
from daemon.maps.container import MOST_BYTES, BadMap, Damaged, Foreign
from daemon.maps.generations import (
    BROKEN,
    BROKEN_NAME,
    CROWDED,
    NAME,
    Examination,
    Generation,
    Problem,
    newest_number,
    problem_of,
    said,
    superfluous,
    verify,
    words_of,
)
from daemon.maps.schema import OtherBuilding, Stored, against_survey, read
from daemon.maps.start_trial import LEFT_OUT, MOST, StartTrial
from daemon.system.atomic_file import sync_folder, write_whole
from daemon.system.folder_lock import FolderLock
from daemon.system.regular_file import read_regular

log = logging.getLogger(__name__)

MOST_BROKEN: Final = 8
"""Number of files kept for diagnosis that a failing disk has damaged during a save."""
START: Final = "start.lumimap"
"""File name of the initial map in a recording's folder."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """The map with which a run starts.

    Attributes:
        content: of the file. stored: the decoded map. changed: lamps whose gains are not used, because the survey has
            changed since. localise: the map is only used, and never changed.
    """

    content: bytes
    stored: Stored
    changed: frozenset[int] = frozenset()
    localise: bool = False


Judge = Callable[[Stored], tuple[str, frozenset[int]]]
"""Check of a map against the configured survey: see `daemon.maps.schema.against_survey`."""


def unjudged(stored: Stored) -> tuple[str, frozenset[int]]:
    """Check for a configuration without a survey: every map fits."""
    return "", frozenset()


def judge_for(lights: Lights | None) -> Judge:
    """Check of maps against the configured light setup."""
    return unjudged if lights is None else partial(against_survey, survey=lights.survey)


class Store:
    """A folder of maps, used by one process at a time.

    Attributes:
        damaged: a map was found and could not be used. left_out: a map is excluded, because no start with it has
            lasted.
        trouble: reason why `claim` could not lock the folder.
        trial: start trial of the initial map, for a run that has locked the folder.
    """

    def __init__(self, folder: Path, mend: bool = True) -> None:
        """Nothing is touched yet. ``mend``: damaged files may be moved aside."""
        self.folder = folder
        self._mend = mend
        self.damaged = self.left_out = False
        self._origin: Path | None = None
        self._examined = Examination()
        self._lock = FolderLock(folder)
        self.trouble = ""
        self.trial: Final = StartTrial(folder)

    @property
    def refused(self) -> bool:
        """Whether there is a map that is not used."""
        return self.damaged or self.left_out

    def claim(self) -> None:
        """Lock the folder for this process before there is a map to save, so that an obstacle is reported at once.

        It may be called again; an unchanged obstacle is not reported again.
        """
        try:
            self._use()
        except OSError as error:
            before, self.trouble = self.trouble, f"{self.folder}: {said(error)}"
            if self.trouble != before:
                log.error("no map can be stored in %s; correct that, or name another `map.folder`", self.trouble)

    def generations(self) -> list[Generation]:
        """All map files, newest first."""
        try:
            paths = sorted(self.folder.glob("*.lumimap")) if self.folder.is_dir() else []
            if not paths and self.folder.exists():
                os.scandir(self.folder).close()  # raises the reason why nothing can be listed
        except FileNotFoundError:
            return []
        found = []
        for foreign, path in enumerate(paths):
            match = NAME.fullmatch(path.name)
            found.append(Generation(int(match[2]), int(match[1], 16), path) if match else Generation(0, ~foreign, path))
        return sorted(found, key=lambda one: one.number, reverse=True)

    def load(self, judge: Judge = unjudged) -> Start | None:
        """The newest good map that fits; None where there is none. An unusable file is logged.

        Where a generation is damaged, the one before it counts. Another map than the latest is used only if the latest
        belongs to another building: after a RESET, the old map must not return by itself.
        A file with a name of the operator's choice is no generation of anything: where it is damaged, the next one
        counts.
        """
        if self._lock.held:
            self.trial.read()
        while True:
            start, before = self._newest(judge), self.trial.out
            name = self._origin.name if start is not None and self._origin is not None else ""
            if not self._lock.held or not self.trial.changes(name):
                return start
            if not self.trial.out:
                them = ", ".join(before)
                log.warning(
                    "%s: %d starts without %s have failed too; the daemon tries the map again", self.folder, MOST, them
                )

    def _newest(self, judge: Judge) -> Start | None:
        """As :meth:`load`, without the excluded files."""
        self._origin, self.left_out = None, False
        try:
            generations = self.generations()
        except OSError as error:
            log.error(
                "maps in %s cannot be read: %s; correct that, or name another `map.folder`", self.folder, said(error)
            )
            self.damaged = True
            return None
        by_map = sorted(generations, key=lambda one: (newest_number(generations, one.map_id), one.number), reverse=True)
        looked = set[int]()
        for map_id, files in groupby(by_map, key=lambda one: one.map_id):
            looked.add(map_id)
            elsewhere, refused = True, False
            for generation in files:
                if generation.path.name in self.trial.out:
                    log.error("%s is refused: %s", generation.path, LEFT_OUT)
                    elsewhere, refused, self.left_out = False, True, True
                    continue
                try:
                    start = self._read(generation, judge)
                except OtherBuilding as error:
                    self._refuse(generation.path, error)
                except (BadMap, OSError, MemoryError) as error:
                    self._refuse(generation.path, error)
                    elsewhere, refused = not generation.number, True  # a file placed by the operator is no generation
                else:
                    if refused:
                        log.warning("%s is used, the newest valid generation of this map", generation.path)
                    self._origin = generation.path
                    return start
            if not elsewhere:
                others = ", ".join(sorted(one.path.name for one in generations if one.map_id not in looked))
                if others:
                    log.warning(
                        "%s: files of other maps are not used: %s; to use one, move the others away",
                        self.folder,
                        others,
                    )
                break
        return None

    def lasted(self) -> None:
        """Record that this run has lasted: its excluded files are moved aside, all others count as good."""
        if not self._lock.held:
            return
        for name in self.trial.lasted():
            with contextlib.suppress(OSError):
                aside = (self.folder / name).replace(self.folder / (name + BROKEN))
                log.warning("%s: the start without this map was successful; the file is kept for inspection", aside)

    def identity(self, generation: Generation) -> int:
        """Identity of the map in a file: from its name, or from the content of a file that an operator placed there.

        Negative: such a file cannot be read as a map.
        """
        if generation.number:
            return generation.map_id
        try:
            return read(read_regular(generation.path, MOST_BYTES)).meta.map_id
        except (BadMap, OSError, MemoryError):
            return generation.map_id

    def load_map(self, map_id: int, judge: Judge = unjudged) -> Start:
        """The newest good generation of one map.

        Raises:
            BadMap: none is good, or it belongs to another building. OSError: it cannot be read.
        """
        failure: BadMap | OSError = Foreign(f"no map {map_id:08x} in {self.folder}")
        for generation in self.generations():
            if self.identity(generation) == map_id:
                try:
                    start = self._read(generation, judge)
                except (BadMap, OSError) as error:
                    log.error("%s is refused: %s", generation.path, error)
                    self._examined.found(generation.path, error)
                    failure = error
                else:
                    self._origin = generation.path
                    return start
        raise failure

    def _read(self, generation: Generation, judge: Judge) -> Start:
        content = read_regular(generation.path, MOST_BYTES)
        stored = read(content)
        self._examined.found(generation.path, None)
        if generation.number and stored.meta.map_id != generation.map_id:
            raise Foreign(f"it contains map {stored.meta.map_id:08x}, which differs from its name")
        words, changed = judge(stored)
        if words:
            log.warning("%s: %s; the daemon discards their learned gains and uses the map", generation.path, words)
        if stored.isolated:
            log.warning(
                "%s: %d submaps have no edge to the others and are not used",
                self._copy_aside(generation.path, content),
                stored.isolated,
            )
        return Start(content, stored, changed)

    def refuse(self, error: BadMap) -> None:
        """Log why the loaded map cannot be used after all, and move its file aside."""
        if self._origin is not None:
            self._refuse(self._origin, error)
            self._origin = None

    def _copy_aside(self, path: Path, content: bytes) -> Path:
        """Copy a split map aside for diagnosis: the next save lacks a part of it."""
        aside = path.with_name(path.name + ".torn")
        with contextlib.suppress(OSError):
            if self._mend and not aside.exists():
                write_whole(aside, content)
            return aside if aside.exists() else path
        return path

    def _refuse(self, path: Path, error: Problem) -> None:
        """Log why a file is not used; a damaged one is moved aside."""
        self.damaged = True
        self._examined.found(path, error)
        if not isinstance(error, BadMap):
            log.error(
                "%s cannot be read: %s. The daemon keeps the file; correct that, or move it away", path, words_of(error)
            )
            return
        where = path
        if self._mend and isinstance(error, Damaged | Foreign):
            aside = path.with_name(path.name + BROKEN)
            with contextlib.suppress(OSError):
                where = path.replace(aside)
        log.error("%s is refused: %s; %s", where, error, error.remedy)

    def save(self, content: bytes, map_id: int) -> Path:
        """Write a generation, verify it by reading it back, then delete older ones; return its path.

        Raises:
            OSError: it cannot be written or read, or another process uses the folder; the files before it stay.
            BadMap: the content read back differs from the written one; the file is moved aside.
        """
        self._use()
        path = self.folder / f"map-{map_id:08x}-{self._next():08d}.lumimap"
        write_whole(path, content)
        try:
            verify(path, content)
        except BadMap:
            path.replace(path.with_name(path.name + BROKEN))
            self._drop_broken()
            raise
        self._examined.found(path, None)
        self._let_go(map_id)
        return path

    def _drop_broken(self) -> None:
        """Delete the oldest of many damaged files: with a failing disk they would fill it up.

        A good one was moved aside for another reason, and stays.
        """
        found = [(int(match[2]), path) for path in self.folder.iterdir() if (match := BROKEN_NAME.fullmatch(path.name))]
        for _, path in sorted(found)[:-MOST_BROKEN]:
            if isinstance(problem_of(path), Damaged):
                log.warning("%s is removed, because %d damaged maps are newer", path, MOST_BROKEN)
                path.unlink(missing_ok=True)

    def _use(self) -> None:
        """Create and lock the folder if necessary; temporary files of a killed process are deleted."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if self._lock.take():
            try:
                tempfile.TemporaryFile(dir=self.folder).close()  # raises the reason why nothing can be saved
            except OSError:
                self._lock.close()
                raise
            self._drop_parts()
        self.trouble = ""

    def _drop_parts(self) -> None:
        for part in self.folder.glob(".map-*.part"):
            try:
                part.unlink(missing_ok=True)
            except OSError as error:  # harmless: the next map has another name
                log.warning("%s cannot be removed: %s; the file remains", part, said(error))

    def _next(self) -> int:
        """Number above all that were ever used, damaged files included."""
        numbers = [int(match[2]) for path in self.folder.iterdir() if (match := NAME.match(path.name))]
        return 1 + max(numbers, default=0)

    def _let_go(self, map_id: int) -> None:
        for generation, why in list(superfluous(self.generations(), map_id, self._origin, self._examined)):
            log.log(logging.WARNING if why == CROWDED else logging.INFO, "%s is deleted: %s", generation.path, why)
            try:
                generation.path.unlink(missing_ok=True)
            except OSError as error:
                log.warning("%s cannot be deleted: %s; the file remains", generation.path, said(error))
        sync_folder(self.folder)

    def close(self) -> None:
        """Unlock the folder; idempotent."""
        self._lock.close()
