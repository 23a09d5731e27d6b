"""The comparison of two architectures: what counts as the same, and what is said where something is missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tools.bench.system import aarch64


def test_numbers_are_compared_by_kind() -> None:
    here = {"poses": [1.0, 2.0, 3.0], "codes": [5.0]}
    rows = aarch64.compared(here, {"poses": [1.0, 2.0, 3.0 + 1e-12], "codes": [5.0]})
    assert [row.ok for row in rows] == [True, True]
    rows = aarch64.compared(here, {"poses": [1.0, 2.0, 3.0], "codes": [6.0]})
    assert [row.ok for row in rows] == [True, False]


def test_nothing_may_be_missing() -> None:
    with pytest.raises(RuntimeError, match="other numbers"):
        aarch64.compared({"poses": [1.0, 2.0]}, {"poses": [1.0]})


def test_a_tool_that_is_not_there_is_named_with_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda tool: None)
    with pytest.raises(aarch64.Missing, match="apt-get install qemu-user-static"):
        aarch64.run(tmp_path)


def test_what_cannot_be_fetched_is_said() -> None:
    with pytest.raises(aarch64.Missing, match="is there a network"):
        aarch64.fetched("false")
