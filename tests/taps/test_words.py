"""Commands of the taps: what is missing is named, with what to do."""

import argparse
import sys

import pytest

from daemon.cli import tap_parsers
from daemon.system import extras

ARGS = argparse.Namespace(config=None, set=[], print_config=False)


def test_a_missing_extra_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert tap_parsers.needing("view", "tests.taps.wanting", "main")(ARGS) == 1
    said = capsys.readouterr().err
    assert "needs a_library_that_nobody_has" in said
    assert "pip install 'lumiloop[view]'" in said


def test_where_there_is_no_pip_the_systems_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    assert extras.how_to_install("view") == f"python3 -m pip --python {sys.executable} install 'lumiloop[view]'"


def test_what_is_missing_of_our_own_is_a_defect() -> None:
    with pytest.raises(ModuleNotFoundError):
        tap_parsers.needing("view", "taps.of_tomorrow", "main")(ARGS)
