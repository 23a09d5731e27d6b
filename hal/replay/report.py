"""The report of a log reader: used records, skipped records with reasons, assumptions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

_LINES_KEPT: Final = 5


@dataclass(slots=True)
class Skipped:
    """One reason for skipping: count and first places (line numbers, or byte offsets of a binary log)."""

    count: int = 0
    first: list[int] = field(default_factory=list)


@dataclass(slots=True)
class LogReport:
    """Findings of one reader.

    Attributes:
        used: number of records read, by kind. skipped: by reason. notes: one sentence each, worst first.
    """

    used: dict[str, int] = field(default_factory=dict)
    skipped: dict[str, Skipped] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def skip(self, where: int, reason: str) -> None:
        """Count one skipped record at a line number or offset."""
        entry = self.skipped.setdefault(reason, Skipped())
        entry.count += 1
        if len(entry.first) < _LINES_KEPT:
            entry.first.append(where)

    def use(self, kind: str, count: int = 1) -> None:
        """Count records of one kind that were read."""
        self.used[kind] = self.used.get(kind, 0) + count

    def sentences(self) -> list[str]:
        """Everything found, one sentence each, for a person."""
        sentences = list(self.notes)
        for reason, entry in self.skipped.items():
            places = ", ".join(map(str, entry.first)) + (", ..." if entry.count > len(entry.first) else "")
            sentences.append(f"skipped {entry.count}: {reason} (at {places})")
        return sentences

    def as_dict(self) -> dict[str, object]:
        """Plain data for `summary.json`."""
        skipped = {reason: {"count": entry.count, "first": entry.first} for reason, entry in self.skipped.items()}
        return {"used": dict(self.used), "skipped": skipped, "notes": list(self.notes)}
