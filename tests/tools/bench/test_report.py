"""The report of all benches: what it says, what it keeps, and what it finds worse than before."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from daemon.system.versions import versions
from tools.bench.report.against import CannotCompare, Compared, read, regressions
from tools.bench.report.page import CannotReport, demand_apart, demand_room, facts, junit, page, write
from tools.bench.report.plots import Plot, Series, histogram, svg
from tools.bench.report.result import About, Figure, Result

NOISE = Figure("noise", 10.0, "mm", "more")
GOOD = Result("boots", "Debian boots", True, 20.0, "up after 20 s", figures=(NOISE,))
BAD = Result("drives", "A lap", False, 31.0, "0.300 m\nlog <of> the daemon")
LEFT = Result("walks", "A walk", True, 0.0, "", skipped="needs motion")
ABOUT = About("bench-vm", "Virtual bench", {"version": "1", "configuration": "[lidar]\n<x>"})


def kept(tmp_path: Path, *results: Result) -> Path:
    write(tmp_path, list(results), ABOUT)
    return tmp_path / "results.json"


def test_the_report_names_what_failed_and_what_was_not_tried(tmp_path: Path) -> None:
    suite = ElementTree.fromstring(junit([GOOD, BAD, LEFT], "bench-vm"))
    assert [suite.get(key) for key in ("tests", "failures", "skipped")] == ["3", "1", "1"]
    assert [case.get("name") for case in suite if case.find("failure") is not None] == ["drives"]
    assert [case.get("name") for case in suite if case.find("skipped") is not None] == ["walks"]
    assert suite.find(".//property[@name='noise']").get("value") == "10 mm"  # type: ignore[union-attr]  # it is there
    text = page([GOOD, BAD, LEFT], ABOUT, Compared())
    assert "Virtual bench: 1 of 3 passed, 1 not tried" in text
    assert "log &lt;of&gt; the daemon" in text
    assert "[lidar]\n&lt;x&gt;" in text
    assert write(tmp_path, [GOOD, BAD, LEFT], ABOUT) == Compared()
    assert json.loads((tmp_path / "results.json").read_text())["results"][0]["name"] == "boots"


def test_what_a_device_says_cannot_break_the_xml() -> None:
    ElementTree.fromstring(junit([replace(BAD, said="garbage \x00\x1b from the line")], "hil"))


def test_a_run_is_compared_with_another(tmp_path: Path) -> None:
    slow = replace(GOOD, seconds=60.0)
    fine = replace(BAD, passed=True)
    before = read(kept(tmp_path, GOOD, fine), "bench-vm").results
    worse = {"drives": ["drives passed then"]}
    assert regressions([slow, BAD], before) == worse, "the machine may be to blame for seconds"
    assert regressions([GOOD, fine], before) == {}
    assert regressions([replace(LEFT, name="boots")], before) == {
        "boots": ["boots passed then, and was not tried now: needs motion"]
    }
    compared = write(tmp_path / "now", [slow, BAD], ABOUT, read(tmp_path, "bench-vm"))
    assert compared.worse == ["drives passed then"]
    assert compared.closing()[-1] == "FAILED: 1 worse than before"
    written = (tmp_path / "now" / "report.html").read_text()
    assert "drives passed then" in written
    assert "60.0 (20.0 then)" in written


def test_what_is_worse_is_a_failure_for_machines_too(tmp_path: Path) -> None:
    """A figure of what has passed, and what passed then and was not tried now; what has failed is counted once."""
    before = [replace(one, passed=True, skipped="") for one in (GOOD, BAD, LEFT)]
    file = kept(tmp_path, *before)
    slower = replace(GOOD, figures=(replace(NOISE, value=90.0),))
    new = replace(GOOD, name="flies")
    compared = write(tmp_path / "now", [slower, BAD, LEFT, new], ABOUT, read(file, "bench-vm"))
    assert len(compared.worse) == 3
    suite = ElementTree.parse(tmp_path / "now" / "junit.xml").getroot()
    assert [suite.get(key) for key in ("tests", "failures", "skipped")] == ["4", "3", "0"]
    told = {case.get("name"): case.find("failure") for case in suite}
    assert told["flies"] is None
    texts = {name: (one.get("message"), one.text) for name, one in told.items() if one is not None}
    assert texts["boots"] == ("worse than before: boots: noise: 90 mm, 10 then", f"up after 20 s\n{texts['boots'][0]}")
    assert texts["drives"] == ("0.300 m", f"{BAD.said}\nworse than before: drives passed then")
    assert texts["walks"][0] == "worse than before: walks passed then, and was not tried now: needs motion"


def test_a_report_does_not_overwrite_the_one_it_is_compared_with(tmp_path: Path) -> None:
    before = read(kept(tmp_path, GOOD), "bench-vm")
    with pytest.raises(
        CannotReport, match=r"results\.json is to be compared with, .* another folder with --hil-report"
    ):
        demand_apart(tmp_path / "x" / "..", before, "--hil-report")
    demand_apart(tmp_path / "x", before)
    demand_apart(tmp_path, None)
    (tmp_path / "results.json").rename(tmp_path / "old.json")
    demand_apart(tmp_path, read(tmp_path / "old.json", "bench-vm"))


def test_other_words_of_a_run_are_said_and_a_whole_file_by_its_digest(tmp_path: Path) -> None:
    then = {"have": "-", "walk-s": "60.0", "configuration": "[lidar]\na = 1\n", "scenario lap": "1f", "load": "1"}
    write(tmp_path, [GOOD], replace(ABOUT, facts=then))
    now = {"have": "light", "walk-s": "90.0", "configuration": "[lidar]\na = 2\n", "scenario lap": "2e", "load": "9"}
    told = write(tmp_path / "now", [GOOD], replace(ABOUT, facts=now), read(tmp_path, "bench-vm")).told
    assert [line.partition(" differs")[0] for line in told[1:]] == ["have", "walk-s", "configuration", "scenario lap"]
    assert all("\n" not in line for line in told)
    assert told[-1] == "scenario lap differs, and so may figures: 2e; 1f then"


def test_a_figure_that_is_not_measured_any_more_is_worse(tmp_path: Path) -> None:
    told = Figure("temperature", 31.0, "deg C")
    before = read(kept(tmp_path, replace(GOOD, figures=(NOISE, told))), "bench-vm").results
    gone = {"boots": ["boots: noise is not measured any more, 10 then"]}
    assert regressions([replace(GOOD, figures=())], before) == gone
    assert regressions([replace(GOOD, figures=(NOISE,))], before) == {}
    failed = replace(GOOD, figures=(), passed=False)
    assert regressions([failed], before) == {"boots": ["boots passed then"]}


@pytest.mark.parametrize(
    ("worse", "value", "lost"),
    [
        ("more", 12.6, True),
        ("more", 12.4, False),
        ("less", 7.4, True),
        ("less", 99.0, False),
        ("", 99.0, False),
        ("more", math.nan, True),
        ("less", math.nan, True),
        ("", math.nan, False),
    ],
)
def test_a_figure_is_worse_in_its_own_direction(worse: str, value: float, lost: bool, tmp_path: Path) -> None:
    before = read(kept(tmp_path, GOOD), "bench-vm").results
    now = replace(GOOD, figures=(replace(NOISE, value=value, worse=worse),))
    assert bool(regressions([now], before)) is lost
    assert f"({10:.4g} then)" in page([now], ABOUT, Compared(), read(tmp_path, "bench-vm"))


def test_what_was_not_measured_then_is_not_worse_now() -> None:
    assert not replace(NOISE, value=10.0).lost(math.nan)
    assert not replace(NOISE, value=math.nan).lost(math.nan)


def test_room_allows_what_is_small(tmp_path: Path) -> None:
    figure = Figure("lost scans", 0.0, worse="more", room=2.0)
    before = read(kept(tmp_path, replace(GOOD, figures=(figure,))), "bench-vm").results
    assert not regressions([replace(GOOD, figures=(replace(figure, value=2.0),))], before)
    assert regressions([replace(GOOD, figures=(replace(figure, value=3.0),))], before)


@pytest.mark.parametrize("text", ["{}", "[1]", "x", '{"results": [], "about": 3}'])
def test_what_cannot_be_compared_with_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "old.json").write_text(text)
    with pytest.raises(CannotCompare, match="no results of a bench"):
        read(tmp_path / "old.json", "bench-vm")
    with pytest.raises(CannotCompare, match=r"name the results\.json"):
        read(tmp_path / "none.json", "bench-vm")


def test_another_benchs_report_is_refused(tmp_path: Path) -> None:
    kept(tmp_path, GOOD)
    with pytest.raises(CannotCompare, match="is a report of bench-vm, and this is hil"):
        read(tmp_path, "hil")
    before = read(tmp_path, "bench-vm")
    before.demand(["boots", "drives"])
    before.demand([])
    with pytest.raises(CannotCompare, match=r"nothing of what is to be tried now \(drives\); it has boots"):
        before.demand(["drives"])


def test_a_run_that_has_tried_none_of_it_is_refused(tmp_path: Path) -> None:
    """Nothing could become worse than what was skipped; one that was tried is enough."""
    kept(tmp_path, GOOD, LEFT, replace(LEFT, name="turns"))
    before = read(tmp_path, "bench-vm")
    with pytest.raises(CannotCompare, match=r"nothing of what is to be tried now: turns, walks was skipped then; name"):
        before.demand(["walks", "turns", "flies"])
    before.demand(["walks", "boots"])


def test_an_older_report_that_names_no_bench_is_taken_and_that_is_said(tmp_path: Path) -> None:
    old = json.loads(kept(tmp_path, GOOD).read_text())
    del old["bench"]
    (tmp_path / "results.json").write_text(json.dumps(old))
    compared = write(tmp_path / "now", [GOOD], ABOUT, read(tmp_path, "bench-vm"))
    assert "does not say of which bench it is" in compared.told[1]


def test_what_could_be_compared_is_said_and_what_could_not(tmp_path: Path) -> None:
    """In the terminal and in the page; where another device or computer may be the reason for a difference, too."""
    write(tmp_path, [GOOD, LEFT], replace(ABOUT, facts={"lidar": "/dev/ttyACM0", "adc": "fake", "load": "1"}))
    more = replace(GOOD, figures=(NOISE, replace(NOISE, name="drift")))
    about = replace(ABOUT, facts={"lidar": "tcp://h", "adc": "fake", "load": "9"})
    compared = write(tmp_path / "now", [more, BAD], about, read(tmp_path, "bench-vm"))
    assert compared.told == (
        f"compared with {tmp_path}/results.json: 1 of 2 outcomes, 1 of 2 figures; not in the other: drives, "
        "boots: drift; only in the other: walks",
        "lidar differs, and so may figures: tcp://h; /dev/ttyACM0 then",
    )
    assert compared.closing() == list(compared.told)
    text = (tmp_path / "now" / "report.html").read_text()
    assert all(line in text for line in compared.told)


def test_where_no_report_can_be_written_is_said_beforehand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    demand_room(tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()
    (tmp_path / "file").touch()
    for place in (tmp_path / "file", tmp_path / "file" / "out", Path("/proc/out")):
        with pytest.raises(CannotReport, match=f"nothing can be written to {place}; name another folder with --out"):
            demand_room(place)
    kept(tmp_path, GOOD)
    demand_room(tmp_path)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "junit.xml")
    with pytest.raises(CannotReport):
        demand_room(tmp_path)


def test_what_was_tried_on_a_fake_is_marked(tmp_path: Path) -> None:
    """It is no device that has passed."""
    compared = write(tmp_path, [replace(GOOD, fake=True), replace(GOOD, name="starts")], ABOUT)
    assert compared == Compared()
    text = (tmp_path / "report.html").read_text()
    assert "2 of 2 passed (1 of them on fakes)" in text
    assert text.count("passed (fake)") == 1
    marked = ElementTree.parse(tmp_path / "junit.xml").findall(".//property[@name='device'][@value='fake']")
    assert len(marked) == 1
    assert [one["fake"] for one in json.loads((tmp_path / "results.json").read_text())["results"]] == [True, False]


def test_facts_say_which_software_on_which_computer() -> None:
    told = facts(image="x")
    assert told["image"] == "x"
    assert "numpy" in told["software"]
    assert "processors" in told["computer"]


def test_a_computer_without_git_does_not_lose_the_report(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert facts()["version"] == versions()["lumiloop"]


def test_pictures_are_well_formed_whatever_is_drawn() -> None:
    empty: list[float] = []
    plots = [
        Plot("no <data>", "s", "m", (Series("a", empty, empty),)),
        Plot("gaps", "s", "m", (Series("a", [0.0, 1.0, 2.0, 3.0], [1.0, math.nan, 2.0, math.inf]),)),
        Plot("one", "s", "m", (Series("a", [5.0], [5.0], "dots"), Series("fault", [5.0], empty, "marks"))),
        Plot("way", "m", "m", (Series("", list(range(9000)), [0.0] * 9000),), square=True),
        histogram("spread", "mm", [1.0, 2.0, 2.0, math.nan]),
        histogram("nothing", "mm", empty),
    ]
    for plot in plots:
        text = svg(plot)
        assert "nan" not in text
        assert "inf" not in text
        assert len(text) < 60_000
        ElementTree.fromstring(text)
    with_plots = replace(GOOD, plots=(plots[1],))
    assert "<svg" in page([with_plots], ABOUT, Compared())


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ('{"results": [{"name": 1, "passed": true, "seconds": 1}]}', "name"),
        ('{"results": [{"name": "a", "passed": "no", "seconds": 1}]}', "passed"),
        ('{"results": [{"name": "a", "passed": true, "seconds": 1, "figures": [{"name": 4, "value": 1}]}]}', "figures"),
        ('{"results": [{"name": "a", "passed": true, "seconds": 1' + "0" * 400 + "}]}", "holds no results"),
        ('{"results": [], "about": {"lidar": 3}}', "about"),
        ("[" * 200_000, "holds no results"),
    ],
)
def test_a_report_of_other_types_is_refused_before_anything_is_tried(tmp_path: Path, text: str, word: str) -> None:
    (tmp_path / "results.json").write_text(text, encoding="utf-8")
    with pytest.raises(CannotCompare, match=word):
        read(tmp_path, "bench")
