"""A film of a recording, as `taps.view.replay_recorder` writes it: pieces of what the stream would tell, by time.

It can be read while it grows. Only where each piece lies is kept in memory.
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
"""Before each piece: its time, its kind, its length."""
DIED: Final = "the replay has died before its end (no memory, or no room in the folder of temporary files?)"

_tile: Final = msgspec.msgpack.Decoder(tuple[int, int, bytes, dict[str, float]]).decode


@dataclass(slots=True)
class Reel:
    """The pieces of one kind: when, and where in the file."""

    times: array[float] = field(default_factory=lambda: array("d"))
    offsets: array[int] = field(default_factory=lambda: array("q"))
    lengths: array[int] = field(default_factory=lambda: array("l"))

    def upto(self, t: float) -> int:
        """How many there are until an instant."""
        return bisect_right(self.times, t)


class Film:
    """A film that is being made, read from its file.

    Attributes:
        source: the recording. reels: by kind. tiles: of the map, a reel each. about: of the map's tiles.
        t_first, t_last: instants that can be shown; equal before there are any. done: it is whole.
        error: why it has ended before the recording did, empty otherwise.
        scene: what a page is told of the robot that was recorded, None until it is known.

    Args:
        source: the recording. file: the film's. making: whether somebody is at it still; a maker that has died, for
            lack of memory or room on the disk perhaps, has not written how it ended.
    """

    def __init__(self, source: Path, file: Path, making: Callable[[], bool] = lambda: True) -> None:
        self.source = source
        self._making = making
        self.reels: dict[str, Reel] = {kind: Reel() for kind in KINDS}
        self.tiles: dict[Tile, Reel] = {}
        self.about: dict[str, object] = {}
        self.t_first = self.t_last = 0.0
        self.done, self.error = False, ""
        self.scene: dict[str, object] | None = None
        self._file = os.open(file, os.O_RDONLY)
        self._read = 0

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def look(self) -> None:
        """Take in what has been added since."""
        making = self._making()  # asked before: what it wrote last is there by then
        self._take_in()
        if not making and not self.done:
            self.done, self.error = True, DIED

    def _take_in(self) -> None:
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

    def piece(self, reel: Reel, index: int) -> bytes:
        """One piece's bytes."""
        return os.pread(self._file, reel.lengths[index], reel.offsets[index])

    def tile(self, reel: Reel, index: int) -> bytes:
        """One tile's cells, deflated."""
        return _tile(self.piece(reel, index))[2]

    def _add(self, kind: str, t: float, at: int, length: int) -> None:
        if kind == "end":
            self.done, self.error = True, os.pread(self._file, length, at).decode()
            return
        if kind == "scene":
            self.scene = msgspec.msgpack.decode(os.pread(self._file, length, at))
            return
        reel = self.reels[kind]
        if kind == "map":
            column, row, _, about = _tile(os.pread(self._file, length, at))
            self.about = dict(about)
            reel = self.tiles.setdefault((column, row), Reel())
        reel.times.append(t)
        reel.offsets.append(at)
        reel.lengths.append(length)
        if kind == "pose":
            self.t_first = self.t_first or t
            self.t_last = t
