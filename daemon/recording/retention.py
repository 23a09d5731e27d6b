"""Retention of a recording: writes checkpoints, removes the oldest segments, and makes dumps. Runs in its own thread.

A replay can start at the beginning of a recording, and at every segment with a checkpoint. Retention therefore removes
everything before such a segment, and never the last of them. A dump is a folder of links to the present segments. It
costs next to nothing until the ring removes them; from then on it occupies their room. If the disk has too little
room, dumps are removed first. Segments are removed after them, because a dump may hold their room.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import math
import os
import queue
import re
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from daemon.devices.light_setup import RESIDUALS
from daemon.maps.store import START
from daemon.system.atomic_file import sync_folder, write_whole
from daemon.system.callbacks import OnDone
from hal.replay.recording import STATE_SUFFIX, SUFFIX, segment_name, state_name

if TYPE_CHECKING:  # the estimator is loaded in a thread, by the warm-up
    from daemon.recording.checkpoint import Taken

log = logging.getLogger(__name__)

DUMP: Final = "dump-"
"""Prefix of the folders of dumps; the time follows."""
ABOUT: Final = "dump.json"
DUMPS: Final = 8
"""Number of latest dumps kept after faults and after runs that died."""
ASKED: Final = "asked"
"""Reason of a requested dump."""
ASKED_DUMPS: Final = 4
"""Number of requested dumps kept; repeated requests do not displace those of faults."""
DUMP_S: Final = 600.0
"""Time that a dump of a whole recording reaches back, s."""
MAP_SUFFIX: Final = ".lumimap"
"""Suffix of the initial map, and of the maps that the run switched to."""
SWITCHED: Final = f"switch-*{MAP_SUFFIX}"
"""Pattern of the maps that the run switched to; each is needed as long as the cycle that loaded it is kept."""
SWITCH_S: Final = 60.0
"""Longest time from writing a map's file to the cycle that loads it, s."""
RING: Final = "ring"
"""File in a ring's folder, locked during the run; empty until the run has ended as intended."""
MB_A_MINUTE: Final = 24
"""Upper limit of a ring, MB/min: twice the data of a lidar with 1081 beams at 40 Hz and a photodiode."""
LEAST_BYTES: Final = 256 << 20
"""Smallest upper limit of a ring, bytes: maps may be large."""
RESERVE_BYTES: Final = 512 << 20
"""Room that a recording leaves on its disk, bytes; maps are stored there, too."""
BREATH_S: Final = 0.0005
"""Pause between two slices of nodes, s."""
CLOSE_S: Final = 5.0


class Begun(NamedTuple):
    """A segment that begins with a checkpoint: the captured state, the lidar line, and the header.

    Attributes:
        t_mono: time of the capture, s. taken: captured state; None if there is none.
    """

    number: int
    t_mono: float
    taken: Taken | None
    line: bytes
    header: dict[str, Any]


@dataclass(slots=True)
class _Segment:
    """A present segment; ``t_mono``: its start, s, if it begins with a checkpoint."""

    bytes: int = 0
    t_mono: float = math.nan
    state: bool = False


class Flight:
    """Manages the folder of one recording.

    Attributes:
        error: why the latest checkpoint or dump could not be stored; empty without trouble.
        state_bytes: size of the latest checkpoint. dumps: written so far.
    """

    def __init__(self, folder: Path, keep_s: float = math.inf) -> None:
        """``keep_s``: least time that the recording reaches back, s; infinite: as far as the disk has room."""
        self.error = ""
        self.state_bytes = self.dumps = 0
        self._folder = folder
        self._keep_s = keep_s
        self._most = math.inf if math.isinf(keep_s) else max(LEAST_BYTES, (MB_A_MINUTE << 20) * keep_s / 60.0)
        self._segments: dict[int, _Segment] = {0: _Segment(t_mono=-math.inf, state=True)}
        self._said_full = self._owed = False
        self._made: Path | None = None  # the newest dump, None if not known
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._ring = -1
        self._mark_ring()
        self._thread = threading.Thread(target=self._work, name="lumiloop-flight", daemon=True)
        self._thread.start()

    def _mark_ring(self) -> None:
        """Marks the folder as a ring where it is one: at the start, or once the folder exists."""
        if self._ring < 0 and not math.isinf(self._keep_s):
            with contextlib.suppress(OSError):  # the recording itself reports errors of the disk
                self._ring, self._made = _begin_ring(self._folder)

    def prepare(self) -> None:
        """Loads the remaining modules after the estimator, so that no cycle has to."""
        self._tasks.put(_load)

    def closed(self, number: int, path: Path) -> None:
        """Counts the bytes of a complete segment."""
        self._tasks.put(partial(self._take_away, number, path))

    def begun(self, begun: Begun) -> None:
        """Queues the checkpoint of a new segment for writing."""
        self._tasks.put(partial(self._keep, begun))

    def dump(self, about: dict[str, Any], on_done: OnDone) -> None:
        """Makes a dump; ``on_done``: called in the retention thread with an empty text or the error."""
        self._tasks.put(partial(self._dump, about, on_done))

    def close(self, ended: bool) -> None:
        """Finishes pending work, for at most :data:`CLOSE_S`. ``ended``: the run ended as intended.

        Otherwise, or if a requested dump is missing, the next start keeps the ring as a dump: only it has the data.
        """
        self._tasks.put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():  # it still writes: the ring stays locked until it has finished
            log.warning("%s: the recording is not completely written; the next start keeps it as a dump", self._folder)
            return
        if self._ring >= 0:
            if ended and not self._owed:
                with contextlib.suppress(OSError):
                    os.write(self._ring, b"ended\n")
            os.close(self._ring)
            self._ring = -1

    def _work(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # the cycle has precedence on a busy processor
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        while (task := self._tasks.get()) is not None:
            try:
                self._mark_ring()
                task()
            except Exception:  # a defect here must not end the recording; it is logged in full
                log.exception("the folder of the recording cannot be managed")
                self.error = "an internal error, read the log"

    def _keep(self, begun: Begun) -> None:
        """Writes a checkpoint and removes what is too old."""
        segment = self._segments.setdefault(begun.number, _Segment())
        segment.t_mono = begun.t_mono
        if begun.taken is None:
            self._prune(begun.t_mono)
            return
        from daemon.recording.checkpoint import CannotTake
        from daemon.recording.state_file import write_state

        nodes, breathe = begun.taken.nodes(), partial(time.sleep, BREATH_S)
        try:
            self.state_bytes = write_state(
                self._folder / state_name(begun.number), begun.header, begun.line, nodes, breathe
            )
        except (OSError, CannotTake) as error:
            self._fail("a checkpoint", error, "; the recording replays from an older one")
            self._prune(begun.t_mono)
            return
        segment.state = True
        segment.bytes += self.state_bytes
        self.error = ""
        self._prune(begun.t_mono)

    def _fail(self, what: str, error: Exception, follows: str = "") -> None:
        said = (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
        if not self.error:
            log.error("%s cannot be stored in %s: %s%s", what, self._folder, said, follows)
        self.error = f"{what}: {said}"

    def _take_away(self, number: int, path: Path) -> None:
        with contextlib.suppress(OSError):
            self._segments.setdefault(number, _Segment()).bytes += path.stat().st_size

    def _prune(self, now: float) -> None:
        """Removes what is older than configured, then what has no room: dumps before segments.

        If no checkpoint can be made, a ring of twice its limit continues without its beginning. It must not fill the
        disk that stores the maps.
        """
        starts = [number for number, segment in sorted(self._segments.items()) if segment.state]
        old = [number for number in starts if self._segments[number].t_mono <= now - self._keep_s]
        if old:
            self._remove_before(old[-1])
        lacks = self._lacks_room()
        for start in starts:
            if start > min(self._segments) and (self._bytes() > self._most or (lacks and self._lacking() > 0)):
                self._remove_before(start)
        while len(self._segments) > 1 and self._bytes() > 2.0 * self._most:
            self._remove_before(sorted(self._segments)[1])

    def _bytes(self) -> int:
        return sum(segment.bytes for segment in self._segments.values())

    def _lacking(self) -> int:
        """Returns the room that is missing on the disk, bytes; 0 or less if none is missing."""
        try:
            room = shutil.disk_usage(self._folder).free
        except OSError:
            return 0
        if room < RESERVE_BYTES and not self._said_full:
            what = "the oldest dumps and then the oldest segments are removed from now on"
            log.warning("%s has %d MB of free space: %s", self._folder, room >> 20, what)
            self._said_full = True
        return RESERVE_BYTES - room

    def _lacks_room(self) -> bool:
        """Removes dumps if room is missing; True if it still is. The disk may free their room only later."""
        lacking = self._lacking()
        with contextlib.suppress(OSError):  # a dump that cannot be removed: segments are removed instead
            for dump in _spare_dumps(self._folder.parent, self._made) if lacking > 0 else ():
                held = _held_alone(dump)
                shutil.rmtree(dump)
                lacking -= held
                log.warning("%s was removed, because the disk has too little free space", dump)
                if lacking <= 0:
                    break
        return lacking > 0

    def _remove_before(self, first: int) -> None:
        ended = -math.inf
        for number in [number for number in self._segments if number < first]:
            del self._segments[number]
            with contextlib.suppress(OSError):
                ended = max(ended, (self._folder / segment_name(number)).stat().st_mtime)
            for name in (segment_name(number), state_name(number)):
                with contextlib.suppress(OSError):
                    (self._folder / name).unlink(missing_ok=True)
        for path in self._folder.glob(SWITCHED):  # a robot that uses a lift switches maps all day
            with contextlib.suppress(OSError):
                if path.stat().st_mtime < ended - SWITCH_S:
                    path.unlink()

    def _dump(self, about: dict[str, Any], on_done: OnDone) -> None:
        reason = "an internal error, read the log"
        try:
            reason = self._dumped(about)
        finally:  # the client gets a result in every case
            self._owed = bool(reason)
            on_done(reason)

    def _dumped(self, about: dict[str, Any]) -> str:
        """Makes a dump; returns an empty text, or the reason of the failure."""
        name = f"{DUMP}{about['at']}-{about['reason']}"
        try:
            names = self._names(self._dump_from(float(about["t_mono"])))
            made = _linked(self._folder, names, self._folder.parent / name, about)
            self._made = made
            _prune_dumps(self._folder.parent, made)
        except OSError as error:
            self._fail("a dump", error)
            return f"{self._folder.parent}: {error.strerror or error}"
        self.dumps += 1
        log.info("flight recorder: %s (%s)", made, about["why"])
        return ""

    def _dump_from(self, now: float) -> int:
        """Returns the number of the first segment of a dump."""
        reach = min(self._keep_s, DUMP_S) if math.isinf(self._keep_s) else self._keep_s
        starts = [number for number, segment in sorted(self._segments.items()) if segment.state]
        old = [number for number in starts if self._segments[number].t_mono <= now - reach]
        return old[-1] if old else min(starts, default=0)

    def _names(self, begin: int) -> list[str]:
        """Returns the file names of a dump; the segment that is being written is one of them."""
        there = sorted(path.name for path in self._folder.iterdir())
        names = [name for suffix in (SUFFIX, STATE_SUFFIX) for name in there if _numbered(name, suffix) >= begin]
        maps = [name for name in there if name.endswith(MAP_SUFFIX) and not (name == START and begin > 0)]
        return [*names, *(name for name in there if name == RESIDUALS), *maps]


def _numbered(name: str, suffix: str) -> int:
    """Returns the number of a segment or checkpoint file; -1 for any other file."""
    stem = name.removesuffix(suffix)
    return int(stem) if stem != name and stem.isdecimal() else -1


def _load() -> None:
    import_module("daemon.recording.state_file")


def _linked(source: Path, names: list[str], target: Path, about: dict[str, Any]) -> Path:
    """Makes a folder with links to the files, or copies where links are impossible; it appears as a whole."""
    target = _free(target)
    beside = target.with_name(f".{target.name}.part")
    beside.mkdir(parents=True)
    try:
        for name in names:
            try:
                os.link(source / name, beside / name)
            except OSError:
                shutil.copyfile(source / name, beside / name)
        write_whole(beside / ABOUT, (json.dumps(about, indent=2, sort_keys=True) + "\n").encode())
        beside.replace(target)
    except OSError:
        shutil.rmtree(beside, ignore_errors=True)
        raise
    sync_folder(target.parent)
    return target


def _free(path: Path) -> Path:
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.name}-{number}")
    return free


def _prune_dumps(parent: Path, made: Path) -> None:
    """Removes the oldest dumps by name, requested ones separately; keeps ``made``, as the clock may not be set."""
    asked = _was_asked(made)
    others = sorted(path for path in parent.glob(f"{DUMP}*") if path != made and _was_asked(path) == asked)
    for old in others[: 1 - (ASKED_DUMPS if asked else DUMPS)]:
        shutil.rmtree(old, ignore_errors=True)


def _spare_dumps(parent: Path, made: Path | None) -> list[Path]:
    """Returns the dumps that may be removed to make room, oldest first and requested ones last.

    The newest dump is never among them: the one ``made`` by this run, or else the last by a clock that may have been
    set.
    """
    dumps = sorted((path.stat().st_mtime, path.name, path) for path in parent.glob(f"{DUMP}*") if path.is_dir())
    newest = made if made is not None and made.exists() else dumps[-1][2] if dumps else None
    return sorted((path for _, _, path in dumps if path != newest), key=_was_asked)


def _held_alone(dump: Path) -> int:
    """Returns the bytes on the disk that only this dump occupies."""
    return sum(512 * one.st_blocks for one in map(Path.stat, dump.iterdir()) if one.st_nlink == 1)


def _was_asked(dump: Path) -> bool:
    return re.search(rf"-{ASKED}(-\d+)?$", dump.name) is not None


def _begin_ring(folder: Path) -> tuple[int, Path | None]:
    """Marks a folder as an active ring and handles the rings of earlier runs.

    Returns the lock and the dump made of one.
    """
    made = None
    for other in sorted(folder.parent.glob(f"*/{RING}")):
        if other.parent != folder:
            made = _see_to(other) or made
    handle = os.open(folder / RING, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return handle, made


def _see_to(mark: Path) -> Path | None:
    """Handles the ring of an earlier run: removes it after an intended end, otherwise makes it a dump."""
    kept: Path | None = None
    try:
        with mark.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if file.read():
                shutil.rmtree(mark.parent, ignore_errors=True)
                return None
        kept = mark.parent
        if not kept.name.startswith(DUMP):  # otherwise it was moved, and a power cut left its mark
            kept = _free(mark.parent.with_name(f"{DUMP}{mark.parent.name}-died"))
            mark.parent.rename(kept)
        (kept / RING).unlink()
        sync_folder(kept.parent)
        log.warning("the last run ended abnormally, or one of its dumps is missing; its recording is in %s", kept)
        _prune_dumps(kept.parent, kept)
    except OSError as error:
        log.warning("%s: the ring of an earlier run cannot be made a dump: %s", mark.parent, error.strerror)
    return kept
