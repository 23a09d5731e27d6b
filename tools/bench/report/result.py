"""Results of a run on a bench: what was tried, its figures and pictures, and whose report it is."""

import math
from dataclasses import dataclass
from typing import Literal

from tools.bench.report.plots import Plot


@dataclass(frozen=True, slots=True)
class Figure:
    """A number that was measured.

    Attributes:
        worse: which way is worse; empty: neither, it is only told. share: by how much it may be worse than in another
            run, as a share of the value then. room: and by so much in its own unit besides.
    """

    name: str
    value: float
    unit: str = ""
    worse: Literal["more", "less", ""] = ""
    share: float = 0.25
    room: float = 0.0

    def __str__(self) -> str:
        return f"{self.name}: {self.value:.4g} {self.unit}".rstrip()

    def lost(self, old: float) -> bool:
        """Whether it is worse than it was then; what could not be measured any more is."""
        if math.isnan(self.value):
            return bool(self.worse) and not math.isnan(old)
        allowed = self.share * abs(old) + self.room
        return {"more": self.value > old + allowed, "less": self.value < old - allowed, "": False}[self.worse]


@dataclass(frozen=True, slots=True)
class Result:
    """Of one thing that was tried: its name, title, whether it passed, seconds, what was seen or what was wrong.

    Attributes:
        skipped: why it was not tried; empty: it was. fake: it was tried on a fake, and says nothing of a device.
    """

    name: str
    title: str
    passed: bool
    seconds: float
    said: str
    skipped: str = ""
    figures: tuple[Figure, ...] = ()
    plots: tuple[Plot, ...] = ()
    fake: bool = False

    @property
    def outcome(self) -> str:
        """In a word."""
        return "skipped" if self.skipped else "passed" if self.passed else "FAILED"


@dataclass(frozen=True, slots=True)
class Seen:
    """What one thing that passed has shown."""

    said: str
    figures: tuple[Figure, ...] = ()
    plots: tuple[Plot, ...] = ()


@dataclass(frozen=True, slots=True)
class About:
    """Whose report it is: the bench's name (``bench-vm``), its title, and facts of the run by name."""

    name: str
    title: str
    facts: dict[str, str]
