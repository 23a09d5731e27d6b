"""Replays of real logs, each run once however many tests look at it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from daemon.replay.log_replay import Outcome
from tests.logs.catalog import replayed
from tests.logs.entries import BY_NAME

Replayed = Callable[[str], Outcome]


@pytest.fixture(scope="session")
def outcome_of(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Replayed:
    """The replay of a log by its name; skips where the folder of real logs is not set."""
    known: dict[str, Outcome] = {}

    def get(name: str) -> Outcome:
        if name not in known:
            entry = BY_NAME[name]
            root: Path | None = request.getfixturevalue("log_root") if entry.source else None
            known[name] = replayed(entry, root, tmp_path_factory.mktemp(name))
        return known[name]

    return get
