"""Each file operation of a start fails once, and the power is cut at any of them: a part of all; all by command.

`python -m tests.faults.failing_calls calls` and `cuts` try all of them.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.faults.failing_calls import CUTS, preloaded, unsynced

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


@needs_compiler
def test_a_start_in_which_one_call_fails_comes_to_its_end() -> None:
    done = preloaded(["calls", "0.05"])
    found = json.loads(done.stdout)
    assert found["wrong"] == []
    assert found["calls"] > 50
    assert found["started"] > 20


@needs_compiler
def test_a_power_cut_leaves_a_start_and_the_map() -> None:
    done = preloaded(["cuts", "0.2"])
    found = json.loads(done.stdout)
    assert found["wrong"] == []
    assert found["cuts"] == found["started"] == round(0.2 * CUTS)


@needs_compiler
@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("what", ["calls", "cuts"])
def test_every_call_and_every_cut(what: str) -> None:
    assert json.loads(preloaded([what]).stdout)["wrong"] == []


def test_what_was_written_and_not_synced_is_what_a_cut_damages(tmp_path: Path) -> None:
    for name in "abcd":
        (tmp_path / name).touch()
    trace = [
        *(f"write\t{tmp_path}/{name}\t" for name in ("a", "b", "part", "other")),
        *(f"sync\t{tmp_path}/{name}\t" for name in ("b", "other")),
        *(f"rename\t{tmp_path}/{name}\t{tmp_path}/{to}" for name, to in (("part", "c"), ("other", "d"))),
    ]
    assert unsynced(trace) == [tmp_path / "a", tmp_path / "c"]
    assert unsynced(trace, lying=True) == [tmp_path / name for name in "abcd"]
