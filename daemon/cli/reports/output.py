"""Printing of reports, and the parts that several of them have."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from enum import IntEnum
from typing import Any

from daemon.publish.modbus.points import Value


def print_report(command: str, content: Mapping[str, Any], version: int = 1, indent: int | None = None) -> None:
    """Print a report on stdout; its schema is ``lumiloop.COMMAND/VERSION``."""
    sys.stdout.write(json.dumps({"schema": f"lumiloop.{command}/{version}", **content}, indent=indent) + "\n")
    sys.stdout.flush()


def meaning(subject: str, number: int) -> dict[str, Any]:
    """A reason or a fault with its meaning and remedy; those of a newer daemon have neither."""
    from daemon.health.faults import FAULTS
    from daemon.health.reasons import REASONS

    tables: Mapping[str, Mapping[Any, tuple[str, str]]] = {"reason": REASONS, "fault": FAULTS}
    text, remedy = tables[subject].get(number, (None, None))
    return {"number": number, "meaning": text, "remedy": remedy or None}


def pose(values: Sequence[float | None]) -> dict[str, float] | None:
    """A pose (m, m, rad) or its sigmas; None where nothing of it is known."""
    if all(value is None for value in values):
        return None
    return dict(zip(("x_m", "y_m", "yaw_rad"), values, strict=True))  # type: ignore[arg-type]  # none or all are known


def zoned(utc: float | None) -> str | None:
    """A time in seconds since the Unix epoch as ISO 8601 in UTC; None stays None."""
    return None if utc is None else datetime.fromtimestamp(utc, UTC).isoformat(timespec="milliseconds")


def name_of(table: type[IntEnum], number: Value) -> str | None:
    """The name of a number; that of a newer daemon is the number itself."""
    if number is None:
        return None
    try:
        return table(int(number)).name
    except ValueError:
        return str(int(number))
