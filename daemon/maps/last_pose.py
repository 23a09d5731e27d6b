"""Last pose file, stored beside the maps, for the start after a kill or a power cut.

The map is saved every few minutes, the pose up to five times a second while the robot moves, and never at rest.
The file has two slots that are written alternately, each with a checksum and a number. A kill during a write leaves the
other one. A thread writes; a disk that hangs costs the stored pose and nothing else.
The file is synced to the disk at most every ten seconds. Memory cards wear, and after a power loss an operator is
present anyway to switch the robot on.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import os
import stat
import struct
import threading
import time
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from daemon.snapshot import GUESSED, Snapshot, State
from daemon.system.atomic_file import defect_in, reason_of, sync_folder
from daemon.system.patience import within
from daemon.system.regular_file import read_regular

log = logging.getLogger(__name__)

FILE: Final = "last-pose"
ASIDE: Final = ".broken"
MOVED_M: Final = 0.02
MOVED_RAD: Final = 0.01
"""Smallest change in rad that is written."""
WRITE_S: Final = 0.2
SYNC_S: Final = 10.0
RETRY_S: Final = 5.0
CLOSE_S: Final = 1.0
READ_S: Final = 2.0
"""Longest wait for the file at the start, s."""
MOST_BYTES: Final = 4096
"""Largest size of the file in bytes; later versions may append slots."""
SURE: Final = (State.TRACKING, State.DEGRADED)

Pose = tuple[float, float, float]

_SLOT: Final = struct.Struct("<4sIQdddd?3x")
_CRC: Final = struct.Struct("<I")
_MAGIC: Final = b"LLP1"
_SLOT_BYTES: Final = 64


@dataclass(frozen=True, slots=True)
class Remembered:
    """Content of one slot.

    Attributes:
        map_id: of the map that contains the pose. pose: (x, y, yaw), m and rad, None: not available.
        t_utc: time of writing, seconds since 1970. number: counts all writes.
    """

    map_id: int
    pose: Pose | None
    t_utc: float
    number: int = 0


def packed(told: Remembered) -> bytes:
    """Encode a slot of the file."""
    x, y, yaw = told.pose or (0.0, 0.0, 0.0)
    body = _SLOT.pack(_MAGIC, told.map_id, told.number, x, y, yaw, told.t_utc, told.pose is not None)
    return (body + _CRC.pack(zlib.crc32(body))).ljust(_SLOT_BYTES, b"\0")


def unpacked(slot: bytes) -> Remembered | None:
    """Decode a slot; None where it is damaged or incomplete after a kill."""
    body, check = slot[: _SLOT.size], slot[_SLOT.size : _SLOT.size + _CRC.size]
    if len(check) < _CRC.size or _CRC.unpack(check)[0] != zlib.crc32(body):
        return None
    magic, map_id, number, x, y, yaw, t_utc, known = _SLOT.unpack(body)
    if magic != _MAGIC or not all(map(math.isfinite, (x, y, yaw, t_utc))):
        return None
    return Remembered(map_id, (x, y, yaw) if known else None, t_utc, number)


def read(path: Path) -> Remembered | None:
    """The latest complete slot; None where there is none. An unreadable file is logged and ignored."""
    try:
        content = within(READ_S, partial(read_regular, path, MOST_BYTES))[: 2 * _SLOT_BYTES]
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        log.warning("%s cannot be read: %s; the daemon searches the whole map for the pose", path, error.strerror)
        return None
    slots = [unpacked(content[at : at + _SLOT_BYTES]) for at in (0, _SLOT_BYTES)]
    good = [slot for slot in slots if slot is not None]
    if content and not good:
        log.warning("%s is damaged; the whole map is searched for the robot", path)
    return max(good, key=lambda slot: slot.number, default=None)


def _may_write(folder: Path) -> bool:
    """Whether files can be created in a folder, or in the nearest one that exists."""
    there = next((one for one in (folder, *folder.parents) if one.exists()), folder)
    return os.access(there, os.W_OK)


def _opened(path: Path) -> int:
    """File descriptor of the file for writing; what is no regular file is replaced.

    Raises:
        OSError: it cannot be opened or created.
    """
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISREG(path.lstat().st_mode):
            path.replace(path.with_name(path.name + ASIDE))
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)


class LastPose:
    """Stores the pose of a running daemon; :meth:`on_snapshot` is a sink of the cycle.

    Attributes:
        before: slot of the previous run; None: none. error: reason why the pose cannot be stored, empty on success.
        busy_since: start of the write in progress (`time.monotonic`, s), None: none.
    """

    def __init__(self, folder: Path, otherwise: Path | None = None) -> None:
        """Read the stored slot; nothing is written before :meth:`start`.

        Args:
            folder: of the maps.
            otherwise: folder that is used if the first is not writable.
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
        self._unsynced: Remembered | None = None  # written, but not synced
        self._thread: threading.Thread | None = None

    def of_map(self, map_id: int) -> Pose | None:
        """The pose of the previous run in this map; None if it had none."""
        return self.before.pose if self.before is not None and self.before.map_id == map_id else None

    def start(self) -> None:
        """Start the writing thread."""
        self._thread = threading.Thread(target=self._work, name="lumiloop-pose", daemon=True)
        self._thread.start()

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Store the pose of a snapshot if it has changed; returns at once.

        A pose that this run has lost is deleted. The previous run's pose stays until this run has found its own,
        because it may be killed again.
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
        """Write the latest pose, waiting at most one second; idempotent."""
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
        """Write the newest pose, if there is one, and sync the file from time to time.

        After a failure the file is synced at once, because otherwise a recovery of the disk stays undetected.
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
        except Exception as error:  # noqa: BLE001  no memory, or a defect, must not end the thread either; the error is reported
            self._say(f"{self.path}: {reason_of(error)}", defect_in(error))
            with self._lock:
                self._next = self._next or told or self._unsynced
            self._close()
        else:
            self._say("" if told is not None or not self.error else self.error)
        finally:
            self.busy_since = None

    def _write(self, told: Remembered) -> None:
        if self._file >= 0 and os.fstat(self._file).st_nlink == 0:  # deleted meanwhile
            self._close()
        if self._file < 0:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _opened(self.path)
            sync_folder(self.path.parent)
        slot, at = packed(told), _SLOT_BYTES * (told.number % 2)
        if os.pwrite(self._file, slot, at) < len(slot):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._unsynced = told

    def _close(self) -> None:
        """Close the file; the next write opens it again."""
        file, self._file, self._unsynced = self._file, -1, None
        if file >= 0:
            with contextlib.suppress(OSError):
                os.close(file)

    def _say(self, error: str, defect: Exception | None = None) -> None:
        if error and not self.error:
            level = logging.INFO if defect is None else logging.WARNING  # the fault is the warning
            log.log(
                level,
                "the pose cannot be stored for the next start: %s; the daemon tries again",
                error,
                exc_info=defect,
            )
        elif self.error and not error:
            log.info("the pose is stored for the next start again")
        self.error = error
