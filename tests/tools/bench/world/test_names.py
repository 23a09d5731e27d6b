"""What a played world is compared by: names of what is expected, digests of scenarios, and where things went."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tools.bench.report.result import Figure, Result
from tools.bench.world import __main__ as world
from tools.bench.world.__main__ import main
from tools.bench.world.scenario import Scenario, ScenarioError, load
from tools.bench.world.stage import Ends

ERROR = '[[expect]]\nwhat = "error"\nat_most = 0.1\nuntil = 9.0\n'
TRACKING = '[[expect]]\nwhat = "state"\nis = ["TRACKING"]\nfrom = 16.0\nwithin = 10.0\n'
NEVER = '[[expect]]\nwhat = "never"\nis = ["LOST", "NO_LIDAR"]\n'
ENDS = ["--modbus", "127.0.0.1:9", "--lidar", "pty:x"]


def file(tmp_path: Path, text: str, name: str = "mine.toml") -> Path:
    made = tmp_path / name
    made.parent.mkdir(exist_ok=True)
    made.write_text(text)
    return made


def test_what_is_expected_is_named_by_what_it_is_about(tmp_path: Path) -> None:
    """Another one before it, or a wider bound, leaves it the name that a baseline has."""
    names = load(file(tmp_path, ERROR + TRACKING)).names
    assert names == ["mine.error-until-9", "mine.state-TRACKING-from-16"]
    more = load(file(tmp_path, NEVER + ERROR.replace("0.1", "0.3") + TRACKING)).names
    assert more == ["mine.never-LOST-NO_LIDAR", *names]


def test_two_that_differ_only_in_a_bound_are_told_apart_by_it(tmp_path: Path) -> None:
    narrow = TRACKING.replace("10.0", "3.0")
    assert load(file(tmp_path, narrow + ERROR + TRACKING)).names == [
        "mine.state-TRACKING-from-16-within-s-3",
        "mine.error-until-9",
        "mine.state-TRACKING-from-16-within-s-10",
    ]
    with pytest.raises(
        ScenarioError, match=r"expect\[2\]: the same as expect\[0\] \(error-until-9-at-most-0\.1\); leave"
    ):
        load(file(tmp_path, ERROR + NEVER + ERROR))


def test_two_scenarios_of_one_name_are_refused_before_the_drive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(world, "tried", lambda *_: pytest.fail("nothing may be driven"))
    one, other = file(tmp_path, ERROR, "a/mine.toml"), file(tmp_path, NEVER, "b/mine.toml")
    assert main([str(one), "lap", str(other), *ENDS]) == 2
    assert f"mine: {one} and {other} are both called so: name one of them otherwise" in capsys.readouterr().out
    assert main(["lap", "cable", "lap", *ENDS]) == 2
    assert "lap: named twice: a run plays it once" in capsys.readouterr().out


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drives take no time, and what is measured is the same each time."""

    def tried(scenario: Scenario, ends: Ends, twin: bool) -> list[Result]:
        return [Result(name, name, True, 1.0, "", figures=(Figure("it", 1.0),)) for name in scenario.names]

    monkeypatch.setattr(world, "tried", tried)


@pytest.mark.usefixtures("played")
def test_another_text_or_other_options_are_said_where_runs_are_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = file(tmp_path, ERROR)
    words = [str(one), "lap", *ENDS, "--out"]
    assert main([*words, str(tmp_path / "w1")]) == 0
    about = json.loads((tmp_path / "w1" / "results.json").read_text())["about"]
    assert about["scenarios"].startswith(ERROR)
    assert main([*words, str(tmp_path / "w2"), "--against", str(tmp_path / "w1")]) == 0
    assert "differs" not in capsys.readouterr().out
    one.write_text("[world]\nspeed = 0.3\n" + ERROR)
    more = ["--odometry", "udp://127.0.0.1:9", "--against", str(tmp_path / "w1")]
    assert main([*words, str(tmp_path / "w3"), *more]) == 0
    said = capsys.readouterr().out
    assert "scenario mine differs, and so may figures: " in said
    assert f"; {about['scenario mine']} then" in said
    assert "odometry differs, and so may figures: udp://127.0.0.1:9; - then" in said
    assert "scenario lap differs" not in said
    assert main(["lap", *ENDS, "--out", str(tmp_path / "w4"), "--against", str(tmp_path / "w3")]) == 0
    said = capsys.readouterr().out
    assert "odometry differs" in said
    assert "scenario mine" not in said, "it was not played now"


@pytest.mark.usefixtures("played")
def test_what_was_played_is_told_as_it_was_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that is changed or gone by the end of a drive of hours."""
    one = file(tmp_path, ERROR)
    before = world.tried

    def tried(*given: object) -> list[Result]:
        one.unlink()
        return [replace(result, seconds=2.0) for result in before(*given)]  # type: ignore[arg-type]  # as it is called

    monkeypatch.setattr(world, "tried", tried)
    assert main([str(one), *ENDS, "--out", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "results.json").read_text())["about"]["scenarios"] == ERROR


@pytest.mark.usefixtures("played")
def test_a_baseline_is_not_overwritten_by_the_run_that_is_compared_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["lap", *ENDS, "--out", str(tmp_path / "w1")]
    assert main(words) == 0
    kept = (tmp_path / "w1" / "results.json").read_text()
    monkeypatch.setattr(world, "tried", lambda *_: pytest.fail("nothing may be driven"))
    (tmp_path / "w2").symlink_to(tmp_path / "w1")
    for against in ("w1", "w1/results.json", "w2"):
        assert main([*words, "--against", str(tmp_path / against)]) == 2
        assert "would overwrite it; name another folder with --out" in capsys.readouterr().out
    assert (tmp_path / "w1" / "results.json").read_text() == kept
