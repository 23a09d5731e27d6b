"""Plays a replay file to one browser, with its own time and speed."""

from __future__ import annotations

import asyncio
import math
from typing import Any, Final, TypeGuard

import msgspec

from taps.view.replay_file import ReplayFile
from taps.view.viewers import LOOPS, PAST_FAULTS, ROWS, Tile, Viewer, frame

TICK_S: Final = 0.04
LOOK_S: Final = 0.2
SLOWEST, FASTEST = 0.1, 60.0
EMPTY: Final = b""
"""An empty tile."""
UNKNOWN: Final = -2
"""Index of a tile that was queued at a seek: its state in the browser is unknown, so it is sent again."""


class _Piece(msgspec.Struct):
    data: msgspec.Raw


_piece: Final = msgspec.msgpack.Decoder(_Piece).decode


class ReplayPlayer:
    """The playback position of one browser.

    Attributes:
        at: time shown. speed: relative to real time. paused: whether playback is paused.
    """

    def __init__(self, film: ReplayFile, viewer: Viewer) -> None:
        self.at, self.speed, self.paused = 0.0, 1.0, False
        self._film, self._viewer = film, viewer
        self._shown: dict[Tile, int] = {}
        self._begun = self._scene = False

    async def run(self) -> None:
        """Play until cancelled."""
        loop = asyncio.get_running_loop()
        before, looked = loop.time(), -LOOK_S
        self._introduce()
        while True:
            now = loop.time()
            if now - looked >= LOOK_S:
                looked = now
                self._film.refresh()
                self._send_status()
            if self._begun:
                if not self.paused:
                    self.advance(now - before)
            elif self._film.tracks["pose"].times:
                self.seek(self._film.t_first)
            before = now
            await asyncio.sleep(TICK_S)

    def control(self, message: Any) -> None:
        """Apply a control message: ``at`` (a time), ``speed``, ``paused``; invalid values are ignored."""
        if not isinstance(message, dict):
            return
        speed, at, paused = message.get("speed"), message.get("at"), message.get("paused")
        if _is_number(speed):
            self.speed = min(max(float(speed), SLOWEST), FASTEST)
        if isinstance(paused, bool):
            self.paused = paused
        if not self._film.tracks["pose"].times:
            pass  # nothing to show yet: playback begins with the first pose
        elif _is_number(at):
            self.seek(float(at))
        elif paused is False and self._film.done and self.at >= self._film.t_last:
            self.seek(self._film.t_first)  # from the beginning again
        self._send_status()

    def seek(self, at: float) -> None:
        """Jump to a time, with the history up to it."""
        film, viewer = self._film, self._viewer
        self._begun = True
        self.at = min(max(at, film.t_first), film.t_last)
        self._shown.update(dict.fromkeys(viewer.clear(), UNKNOWN))
        self._introduce()
        viewer.put("rewound", frame("rewound", None), once=True)
        viewer.put("row", _join(self._past("row", ROWS)), once=True)
        if loops := self._past("loop", LOOPS):  # as history, not as new events
            viewer.put("loops", frame("loops", [_piece(loop).data for loop in loops]), once=True)
        if faults := self._past("faults", PAST_FAULTS):
            viewer.put("past", frame("past", [_piece(fault).data for fault in faults]), once=True)
        self._latest(-math.inf)
        self._tiles()

    def _past(self, kind: str, most: int) -> list[bytes]:
        """The latest messages of a kind up to now."""
        track = self._film.tracks[kind]
        until = track.upto(self.at)
        return [self._film.piece(track, index) for index in range(max(0, until - most), until)]

    def advance(self, seconds: float) -> None:
        """Advance playback by ``seconds`` of real time."""
        before, self.at = self.at, min(self.at + seconds * self.speed, self._film.t_last)
        if self.at > before:
            self._events(before)
            self._latest(before)
            self._tiles()

    def _events(self, before: float) -> None:
        for kind in ("state", "loop", "row"):
            track = self._film.tracks[kind]
            for index in range(track.upto(before), track.upto(self.at)):
                self._viewer.put(kind, self._film.piece(track, index), once=True)

    def _latest(self, before: float) -> None:
        for kind in ("scan", "pose", "lights", "statistics", "faults"):
            track = self._film.tracks[kind]
            index = track.upto(self.at) - 1
            if index >= 0 and track.times[index] > before:
                self._viewer.put(kind, self._film.piece(track, index))

    def _tiles(self) -> None:
        """Send the tiles that differ from those shown."""
        film = self._film
        changed = []
        for place, track in film.tiles.items():
            index = track.upto(self.at) - 1
            if index != self._shown.get(place, -1):
                self._shown[place] = index
                changed.append((place, EMPTY if index < 0 else film.tile(track, index)))
        if changed:
            self._viewer.put_tiles(film.about, changed)

    def _introduce(self) -> None:
        """Send the connection state and the scene."""
        self._viewer.put("daemon", frame("daemon", {"session": 1, "up": True, "why": ""}), once=True)
        self._scene = self._film.scene is not None
        if self._scene:
            self._viewer.put("scene", frame("scene", self._film.scene), once=True)

    def _send_status(self) -> None:
        film = self._film
        if film.scene is not None and not self._scene:
            self._introduce()
        status = {"t_first": film.t_first, "t_last": film.t_last, "at": self.at, "done": film.done, "error": film.error}
        self._viewer.put("film", frame("film", {**status, "paused": self.paused, "speed": self.speed}))


def _join(pieces: list[bytes]) -> bytes:
    """Join encoded frames to one frame of the topic ``many``."""
    head = b"\x82\xa5topic\xa4many\xa4data" + b"\xdd" + len(pieces).to_bytes(4, "big")
    return head + b"".join(pieces)


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
