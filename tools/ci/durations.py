"""pytest plugin (``-p tools.ci.durations``): keep the seconds of each test file in pytest's cache for `tools.ci.quick`.

A run that was narrowed (``-k``, a single test) or broken off keeps nothing: its sums would be too small.
"""

from __future__ import annotations

import contextlib
import json
from collections import defaultdict
from pathlib import Path
from typing import Final

import pytest

KEY: Final = "lumiloop/durations"


class Recorder:
    """Adds up the durations of the reports, by test file."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._seconds: defaultdict[str, float] = defaultdict(float)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add one phase of one test."""
        self._seconds[report.nodeid.partition("::")[0]] += report.duration

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the sums beside those of earlier runs; files that are gone are dropped."""
        cache = self._config.cache
        if cache is None or _narrowed(self._config) or session.shouldstop or session.shouldfail:
            return
        now = {name: round(seconds, 3) for name, seconds in self._seconds.items()}
        kept = read(self._config.rootpath) | now
        cache.set(KEY, {name: kept[name] for name in sorted(kept) if (self._config.rootpath / name).is_file()})


def _narrowed(config: pytest.Config) -> bool:
    return bool(config.option.keyword) or any("::" in word for word in config.args)


def pytest_configure(config: pytest.Config) -> None:
    """Register the recorder; a worker of pytest-xdist leaves it to the controller."""
    if not hasattr(config, "workerinput") and getattr(config, "cache", None) is not None:
        config.pluginmanager.register(Recorder(config), "lumiloop durations")


def read(root: Path) -> dict[str, float]:
    """Seconds by test file; empty where no run has kept them."""
    with contextlib.suppress(OSError, TypeError, ValueError):
        kept = json.loads((root / ".pytest_cache" / "v" / KEY).read_text())
        return {str(name): float(seconds) for name, seconds in dict(kept).items()}
    return {}
