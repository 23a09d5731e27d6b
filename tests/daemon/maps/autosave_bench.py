"""The autosaver of maps with its clock, its folder and its robot in hand."""

import asyncio
from dataclasses import dataclass, field
from pathlib import Path

from daemon.maps.autosave import About, MapAutosaver
from daemon.maps.store import Start, Store
from estimator.state import State
from estimator.stored_map import restored
from tests.daemon.support.map_maker import Shape, image


@dataclass
class Clock:
    t: float = 100.0

    def now(self) -> float:
        return self.t

    def utc(self) -> float:
        return 1.5e9 + self.t


@dataclass
class Bench:
    """An autosaver with everything around it in hand."""

    folder: Path
    state: State | None = field(default_factory=lambda: restored(image(Shape())))
    about: About = field(default_factory=lambda: About("robot", "digest"))
    start: Start | None = None
    map_id: int = 0x77
    clock: Clock = field(default_factory=Clock)
    told: list[str] = field(default_factory=list)
    kept: bool = True

    def __post_init__(self) -> None:
        self.store = Store(self.folder) if self.kept else None
        self.autosaver = MapAutosaver(
            self.store, self.start, lambda: self.state, lambda: self.map_id, self.about, self.clock
        )

    async def turn(self, seconds: float = 0.0) -> None:
        """Let so much time go by, one beat, and whatever save it has begun."""
        self.clock.t += seconds
        self.autosaver._go_on()
        await asyncio.wait_for(self.autosaver._over.wait(), 20.0)

    def drive(self) -> None:
        assert self.state is not None
        self.state.map.next_key += 1
        self.state.map.parts.detached = None

    @property
    def files(self) -> int:
        return len(list(self.folder.glob("*.lumimap"))) if self.folder.is_dir() else 0
