"""Shows a film to one browser: its own time, its own speed."""

from __future__ import annotations

import asyncio
import math
from typing import Any, Final, TypeGuard

import msgspec

from taps.view.replay_file import Film
from taps.view.viewers import LOOPS, ROWS, Tile, Viewer, frame

TICK_S: Final = 0.04
LOOK_S: Final = 0.2
SLOWEST, FASTEST = 0.1, 60.0
EMPTY: Final = b""
"""Stands for a tile in which there is nothing yet."""
UNTOLD: Final = -2
"""What is shown of a tile that was on its way when the time leapt: nobody knows, so it is told again."""


class _Piece(msgspec.Struct):
    data: msgspec.Raw


_piece: Final = msgspec.msgpack.Decoder(_Piece).decode


class Player:
    """Where one browser is in a film.

    Attributes:
        at: instant that is shown. speed: times real time. paused: it stands.
    """

    def __init__(self, film: Film, viewer: Viewer) -> None:
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
                self._film.look()
                self._tell()
            if self._begun:
                if not self.paused:
                    self.go_on(now - before)
            elif self._film.reels["pose"].times:
                self.seek(self._film.t_first)
            before = now
            await asyncio.sleep(TICK_S)

    def told(self, words: Any) -> None:
        """What the page wants: ``at`` (an instant), ``speed``, ``paused``; what is nonsense is left out."""
        if not isinstance(words, dict):
            return
        speed, at, paused = words.get("speed"), words.get("at"), words.get("paused")
        if _is_number(speed):
            self.speed = min(max(float(speed), SLOWEST), FASTEST)
        if isinstance(paused, bool):
            self.paused = paused
        if not self._film.reels["pose"].times:
            pass  # nothing to be shown yet: it begins with the first pose
        elif _is_number(at):
            self.seek(float(at))
        elif paused is False and self._film.done and self.at >= self._film.t_last:
            self.seek(self._film.t_first)  # from the beginning again
        self._tell()

    def seek(self, at: float) -> None:
        """Show an instant, as if one had watched until then."""
        film, viewer = self._film, self._viewer
        self._begun = True
        self.at = min(max(at, film.t_first), film.t_last)
        self._shown.update(dict.fromkeys(viewer.forget(), UNTOLD))
        self._introduce()
        viewer.put("rewound", frame("rewound", None), once=True)
        viewer.put("row", _together(self._past("row", ROWS)), once=True)
        if loops := self._past("loop", LOOPS):  # as what has been, not as what happens now
            viewer.put("loops", frame("loops", [_piece(loop).data for loop in loops]), once=True)
        self._latest(-math.inf)
        self._tiles()

    def _past(self, kind: str, most: int) -> list[bytes]:
        """The latest pieces of a kind by now."""
        reel = self._film.reels[kind]
        until = reel.upto(self.at)
        return [self._film.piece(reel, index) for index in range(max(0, until - most), until)]

    def go_on(self, seconds: float) -> None:
        """Some time has passed."""
        before, self.at = self.at, min(self.at + seconds * self.speed, self._film.t_last)
        if self.at > before:
            self._events(before)
            self._latest(before)
            self._tiles()

    def _events(self, before: float) -> None:
        for kind in ("state", "loop", "row"):
            reel = self._film.reels[kind]
            for index in range(reel.upto(before), reel.upto(self.at)):
                self._viewer.put(kind, self._film.piece(reel, index), once=True)

    def _latest(self, before: float) -> None:
        for kind in ("scan", "pose", "lights", "statistics", "faults"):
            reel = self._film.reels[kind]
            index = reel.upto(self.at) - 1
            if index >= 0 and reel.times[index] > before:
                self._viewer.put(kind, self._film.piece(reel, index))

    def _tiles(self) -> None:
        """Tiles that are others at this instant than what was shown."""
        film = self._film
        changed = []
        for place, reel in film.tiles.items():
            index = reel.upto(self.at) - 1
            if index != self._shown.get(place, -1):
                self._shown[place] = index
                changed.append((place, EMPTY if index < 0 else film.tile(reel, index)))
        if changed:
            self._viewer.put_tiles(film.about, changed)

    def _introduce(self) -> None:
        """That there is something to see, and what the robot was like."""
        self._viewer.put("daemon", frame("daemon", {"session": 1, "up": True, "why": ""}), once=True)
        self._scene = self._film.scene is not None
        if self._scene:
            self._viewer.put("scene", frame("scene", self._film.scene), once=True)

    def _tell(self) -> None:
        film = self._film
        if film.scene is not None and not self._scene:
            self._introduce()
        told = {"t_first": film.t_first, "t_last": film.t_last, "at": self.at, "done": film.done, "error": film.error}
        self._viewer.put("film", frame("film", {**told, "paused": self.paused, "speed": self.speed}))


def _together(pieces: list[bytes]) -> bytes:
    """Several frames as one of the topic ``many``: frames already encoded, one after the other."""
    head = b"\x82\xa5topic\xa4many\xa4data" + b"\xdd" + len(pieces).to_bytes(4, "big")
    return head + b"".join(pieces)


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
