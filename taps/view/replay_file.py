"""The replay file of a recording: the stream's messages by time, as `taps.view.replay_recorder` writes them.

It can be read while it grows. Only the offsets of the messages are kept in memory.
"""

from __future__ import annotations

import os
import struct
from array import array
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec

from taps.view.viewers import Tile

KINDS: Final = ("pose", "lights", "scan", "statistics", "loop", "state", "faults", "row", "map", "scene", "end")
HEAD: Final = struct.Struct("<dBI")
"""Head of each message: time, kind, length."""
DIED: Final = "the replay process has ended early; check free memory and the folder of temporary files"

_tile: Final = msgspec.msgpack.Decoder(tuple[int, int, bytes, dict[str, float]]).decode


def end_message(t_mono: float, error: str) -> bytes:
    """The message at the end of a file, with the reason where that is before the recording's end."""
    return message(t_mono, "end", error.encode())


def message(t_mono: float, kind: str, body: bytes) -> bytes:
    """One message of a file."""
    return HEAD.pack(t_mono, KINDS.index(kind), len(body)) + body


@dataclass(slots=True)
class Track:
    """Times and file offsets of the messages of one kind."""

    times: array[float] = field(default_factory=lambda: array("d"))
    offsets: array[int] = field(default_factory=lambda: array("q"))
    lengths: array[int] = field(default_factory=lambda: array("l"))

    def upto(self, t: float) -> int:
        """Number of messages up to a time."""
        return bisect_right(self.times, t)


class ReplayFile:
    """Reader of a replay file that another process may still be writing.

    Attributes:
        source: the recording. tracks: by kind. tiles: of the map, a track each. about: common data of the tiles.
        t_first, t_last: first and last time that can be shown; equal before there are any. done: the file is complete.
        error: why it ended before the recording, empty otherwise.
        scene: of the recorded robot, for the page; None until known.

    Args:
        source: the recording. file: the replay file. making: returns whether the writer is alive; a writer that died,
            for lack of memory or disk space perhaps, leaves no end message.
    """

    def __init__(self, source: Path, file: Path, making: Callable[[], bool] = lambda: True) -> None:
        self.source = source
        self._making = making
        self.tracks: dict[str, Track] = {kind: Track() for kind in KINDS}
        self.tiles: dict[Tile, Track] = {}
        self.about: dict[str, object] = {}
        self.t_first = self.t_last = 0.0
        self.done, self.error = False, ""
        self.scene: dict[str, object] | None = None
        self._file = os.open(file, os.O_RDONLY)
        self._read = 0

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def refresh(self) -> None:
        """Index the messages added since the last call."""
        making = self._making()  # checked first: its last messages are then in the file
        self._index()
        if not making and not self.done:
            self.done, self.error = True, DIED

    def _index(self) -> None:
        while not self.done:
            head = os.pread(self._file, HEAD.size, self._read)
            if len(head) < HEAD.size:
                return
            t, number, length = HEAD.unpack(head)
            at = self._read + HEAD.size
            if os.fstat(self._file).st_size < at + length:
                return
            self._read = at + length
            self._add(KINDS[number], t, at, length)

    def piece(self, track: Track, index: int) -> bytes:
        """The bytes of one message."""
        return os.pread(self._file, track.lengths[index], track.offsets[index])

    def tile(self, track: Track, index: int) -> bytes:
        """One tile's cells, deflated."""
        return _tile(self.piece(track, index))[2]

    def _add(self, kind: str, t: float, at: int, length: int) -> None:
        if kind == "end":
            self.done, self.error = True, os.pread(self._file, length, at).decode()
            return
        if kind == "scene":
            self.scene = msgspec.msgpack.decode(os.pread(self._file, length, at))
            return
        track = self.tracks[kind]
        if kind == "map":
            column, row, _, about = _tile(os.pread(self._file, length, at))
            self.about = dict(about)
            track = self.tiles.setdefault((column, row), Track())
        track.times.append(t)
        track.offsets.append(at)
        track.lengths.append(length)
        if kind == "pose":
            self.t_first = self.t_first or t
            self.t_last = t
