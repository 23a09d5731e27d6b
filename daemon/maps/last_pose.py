"""The pose as it was last, kept beside the maps, for the start after a kill or a power cut.

The map is saved every few minutes, the pose as the robot drives: up to five times a second, never while it stands.
The file has two slots that are written in turn, each with a check sum and a number, so that a kill in mid-write leaves
the one before. A thread writes; a disk that hangs costs the memory of the pose and nothing else. The disk itself is
made to keep it every ten seconds at most: memory cards wear, and a robot that lost its power has been switched on by
a person anyway.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import struct
import threading
import time
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.snapshot import GUESSED, Snapshot, State
from daemon.system.atomic_file import defect_in, reason_of, sync_folder

log = logging.getLogger(__name__)

FILE: Final = "last-pose"
MOVED_M: Final = 0.02
MOVED_RAD: Final = 0.01
"""Less is not worth writing."""
WRITE_S: Final = 0.2
SYNC_S: Final = 10.0
RETRY_S: Final = 5.0
CLOSE_S: Final = 1.0
SURE: Final = (State.TRACKING, State.DEGRADED)

Pose = tuple[float, float, float]

_SLOT: Final = struct.Struct("<4sIQdddd?3x")
_CRC: Final = struct.Struct("<I")
_MAGIC: Final = b"LLP1"
_SLOT_BYTES: Final = 64


@dataclass(frozen=True, slots=True)
class Remembered:
    """What was kept.

    Attributes:
        map_id: of the map that the pose is in. pose: (x, y, yaw), m and rad, None: it was not known.
        t_utc: when, seconds since 1970. number: counts what was ever kept.
    """

    map_id: int
    pose: Pose | None
    t_utc: float
    number: int = 0


def packed(told: Remembered) -> bytes:
    """A slot of the file."""
    x, y, yaw = told.pose or (0.0, 0.0, 0.0)
    body = _SLOT.pack(_MAGIC, told.map_id, told.number, x, y, yaw, told.t_utc, told.pose is not None)
    return (body + _CRC.pack(zlib.crc32(body))).ljust(_SLOT_BYTES, b"\0")


def unpacked(slot: bytes) -> Remembered | None:
    """What a slot holds; None where it is damaged, or was cut short by a kill."""
    body, check = slot[: _SLOT.size], slot[_SLOT.size : _SLOT.size + _CRC.size]
    if len(check) < _CRC.size or _CRC.unpack(check)[0] != zlib.crc32(body):
        return None
    magic, map_id, number, x, y, yaw, t_utc, known = _SLOT.unpack(body)
    if magic != _MAGIC or not all(map(math.isfinite, (x, y, yaw, t_utc))):
        return None
    return Remembered(map_id, (x, y, yaw) if known else None, t_utc, number)


def read(path: Path) -> Remembered | None:
    """The latest whole slot; None where there is none. What cannot be read is said and passed over."""
    try:
        content = path.read_bytes()[: 2 * _SLOT_BYTES]
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        log.warning("%s cannot be read: %s; the robot is looked for in the whole map", path, error.strerror)
        return None
    slots = [unpacked(content[at : at + _SLOT_BYTES]) for at in (0, _SLOT_BYTES)]
    return max((slot for slot in slots if slot is not None), key=lambda slot: slot.number, default=None)


def _may_write(folder: Path) -> bool:
    """Whether files can be made in a folder, or where it is to be made."""
    there = next((one for one in (folder, *folder.parents) if one.exists()), folder)
    return os.access(there, os.W_OK)


class LastPose:
    """Keeps the pose of a running daemon; :meth:`take` is a sink of the cycle.

    Attributes:
        before: what the run before has kept; None: nothing. error: why nothing can be kept, empty while all is well.
        busy_since: when the write began that has not ended yet (`time.monotonic`), None: there is none.
    """

    def __init__(self, folder: Path, otherwise: Path | None = None) -> None:
        """Read what is there; nothing is written before :meth:`start`.

        Args:
            folder: of the maps.
            otherwise: where it is kept if nothing may be written there.
        """
        self.path = (folder if otherwise is None or _may_write(folder) else otherwise) / FILE
        self.before = read(self.path)
        self.error = ""
        self.busy_since: float | None = None
        self._number = 0 if self.before is None else self.before.number
        self._kept: Remembered | None = None
        self._due = 0.0
        self._next: Remembered | None = None
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stop = False
        self._file, self._synced = -1, time.monotonic()
        self._unsynced: Remembered | None = None  # written, and not on the disk for sure
        self._thread: threading.Thread | None = None

    def of_map(self, map_id: int) -> Pose | None:
        """The pose that the run before has left in this map, if it knew one."""
        return self.before.pose if self.before is not None and self.before.map_id == map_id else None

    def start(self) -> None:
        """Begin to write."""
        self._thread = threading.Thread(target=self._work, name="lumiloop-pose", daemon=True)
        self._thread.start()

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Keep the pose of a snapshot if it is news; returns at once.

        A pose that this run has lost is forgotten. One that it has not found yet is left: it may be killed again.
        """
        if snapshot.state in SURE and snapshot.pose is not None:
            if snapshot.t_sent >= self._due and self._is_news(snapshot.map_id, snapshot.pose):
                self._put(Remembered(snapshot.map_id, snapshot.pose, snapshot.t_utc), snapshot.t_sent)
        elif snapshot.state in GUESSED and self._kept is not None and self._kept.pose is not None:
            self._put(Remembered(snapshot.map_id, None, snapshot.t_utc), snapshot.t_sent)

    def _is_news(self, map_id: int, pose: Pose) -> bool:
        kept = self._kept
        if kept is None or kept.pose is None or kept.map_id != map_id:
            return True
        away = math.hypot(pose[0] - kept.pose[0], pose[1] - kept.pose[1])
        return away > MOVED_M or abs(math.remainder(pose[2] - kept.pose[2], math.tau)) > MOVED_RAD

    def _put(self, told: Remembered, now: float) -> None:
        self._number += 1
        self._kept = Remembered(told.map_id, told.pose, told.t_utc, self._number)
        self._due = now + WRITE_S
        with self._lock:
            self._next = self._kept
        self._wake.set()

    def close(self) -> None:
        """Write what is left, for a second at most; idempotent."""
        self._stop = True
        self._wake.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    # in the thread

    def _work(self) -> None:
        while not self._stop:
            self._wake.wait(RETRY_S if self.error else SYNC_S if self._unsynced else None)
            self._wake.clear()
            self._turn()
        self._turn()
        self._close()

    def _turn(self) -> None:
        """Write the newest pose, if there is one, and now and then see to it that the disk has it.

        After a failure the disk has to have it at once, else nobody knows whether it works again.
        """
        with self._lock:
            told, self._next = self._next, None
        self.busy_since = time.monotonic()
        try:
            if told is not None:
                self._write(told)
            overdue = time.monotonic() - self._synced >= SYNC_S
            if self._unsynced is not None and (self._stop or self.error or overdue):
                os.fdatasync(self._file)
                self._unsynced, self._synced = None, time.monotonic()
        except Exception as error:  # noqa: BLE001  no memory, or a defect, must not end the thread either; it is told
            self._say(f"{self.path}: {reason_of(error)}", defect_in(error))
            with self._lock:
                self._next = self._next or told or self._unsynced
            self._close()
        else:
            self._say("" if told is not None or not self.error else self.error)
        finally:
            self.busy_since = None

    def _write(self, told: Remembered) -> None:
        if self._file < 0:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            sync_folder(self.path.parent)
        os.pwrite(self._file, packed(told), _SLOT_BYTES * (told.number % 2))
        self._unsynced = told

    def _close(self) -> None:
        """Let go of the file; the next write opens it anew."""
        file, self._file, self._unsynced = self._file, -1, None
        if file >= 0:
            with contextlib.suppress(OSError):
                os.close(file)

    def _say(self, error: str, defect: Exception | None = None) -> None:
        if error and not self.error:
            level = logging.INFO if defect is None else logging.WARNING  # the fault warns
            log.log(level, "the pose cannot be kept for the next start: %s; it is tried again", error, exc_info=defect)
        elif self.error and not error:
            log.info("the pose is kept for the next start again")
        self.error = error
