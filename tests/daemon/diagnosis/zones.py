"""The place whose time it is, for what tells local times."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

BERLIN = "CET-1CEST,M3.5.0,M10.5.0/3"
"""Summer time ends on 2026-10-25 at 03:00."""


@contextmanager
def local_time(monkeypatch: pytest.MonkeyPatch, zone: str) -> Iterator[None]:
    """Meanwhile it is that of a ``zone``, as POSIX writes one."""
    try:
        with monkeypatch.context() as there:
            there.setenv("TZ", zone)
            time.tzset()
            yield
    finally:
        time.tzset()
