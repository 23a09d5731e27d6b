"""Scenarios of the virtual bench against an inside that does not do what it should: each of them can fail."""

from __future__ import annotations

import json
import threading
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tools.bench.report.page import write
from tools.bench.report.result import About, Figure, Result, Seen
from tools.bench.vm import __main__ as command
from tools.bench.vm import common, trying_process, trying_system
from tools.bench.vm.bench import Bench, Ears, Heard
from tools.bench.vm.machine import Order
from tools.bench.world import agreement
from tools.bench.world.agreement import Trace


def inside(run: Any = None, waited: float = 0.0) -> Bench:
    """One that answers commands by ``run``, and has waited for a processor so long whenever it is asked again."""
    told = iter([10.0, 10.0 + waited])
    machine = SimpleNamespace(run=run, waited_s=lambda: next(told), broken_off=threading.Event())
    bench = Bench.__new__(Bench)
    bench.machine, bench.ears, bench.memory = machine, Ears(), {}  # type: ignore[assignment]  # all that is asked
    return bench


def poses(count: int) -> list[Heard]:
    return [Heard(0.2 * k + 0.04, 0.2 * k, 3, (0.1 * k, 0.0, 0.0), 0.01) for k in range(count)]


@pytest.mark.parametrize(
    ("count", "waited", "right"),
    [(25, 0.0, True), (23, 0.0, True), (21, 0.0, False), (5, 0.0, False), (15, 2.0, True), (12, 2.0, False)],
)
def test_a_datagram_comes_for_each_scan(
    count: int, waited: float, right: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = inside(waited=waited)
    monkeypatch.setattr(bench, "collect", lambda seconds: poses(count))
    if right:
        assert str(trying_system.sends_datagrams(bench)).startswith(
            f"{count / 5.0:.1f} a second; the pose is 40 ms old"
        )
    else:
        with pytest.raises(Order, match=f"{count} datagrams of"):
            trying_system.sends_datagrams(bench)


def driven(metres: float) -> Bench:
    """Poses without an error as far as this, and the truth."""
    bench = inside()
    bench.memory["drive"] = poses(round(metres / 0.1) + 1)
    bench.ears.truth.extend((0.05 * k, (0.025 * k, 0.0, 0.0)) for k in range(2000))
    return bench


def test_two_runs_agree_about_a_way_that_both_have_driven(monkeypatch: pytest.MonkeyPatch) -> None:
    way = np.arange(0.0, 20.0, 0.05)
    monkeypatch.setattr(trying_system, "outside", lambda: Trace(way, np.zeros((len(way), 2))))
    seen = trying_system.agrees_with_outside(driven(5.0))
    assert isinstance(seen, Seen)
    assert [round(one.value) for one in seen.figures] == [0.0, 5.0, 0.0, 0.0, 0.0]
    short = driven(0.6)
    short.memory["drive"][-1] = replace(short.memory["drive"][-1], missed=3, overruns=2, fault=301)
    with pytest.raises(Order, match=r"way compared: 0\.\d+ m.*; meanwhile 3 scans missed, 2 cycles .* \[301\]"):
        trying_system.agrees_with_outside(short)
    for name, least, late in (
        ("LATE_S", 0.011, np.full(51, 0.012)), ("SPREAD_MS", 11, np.linspace(0.0, 0.012, 51)),
        ("EARLY_S", 0.011, np.full(51, -0.012)),
    ):  # fmt: skip
        monkeypatch.setattr(agreement, "lateness", lambda *_, late=late: late)
        trying_system.agrees_with_outside(driven(5.0))
        with monkeypatch.context() as less:
            less.setattr(trying_system, name, least)
            with pytest.raises(Order, match=r"late by: -?12"):
                trying_system.agrees_with_outside(driven(5.0))


@pytest.mark.parametrize(
    ("slower", "late_s", "right"), [(0.8, 0.019, True), (0.8, 0.021, False), (2.0, 0.03, True), (2.0, 0.045, False),
                                    (9.0, 0.049, True), (9.0, 0.051, False)],
)  # fmt: skip
def test_a_slower_computer_may_be_later(
    slower: float, late_s: float, right: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    way = np.arange(0.0, 20.0, 0.05)
    monkeypatch.setattr(trying_system, "outside", lambda: Trace(way, np.zeros((len(way), 2))))
    monkeypatch.setattr(agreement, "lateness", lambda *_: np.full(51, late_s))
    monkeypatch.setattr(trying_system, "AGREE_M", 1.0)  # of poses that were not late
    bench = driven(5.0)
    bench.slower = slower
    if right:
        trying_system.agrees_with_outside(bench)
    else:
        with pytest.raises(Order, match="late by: "):
            trying_system.agrees_with_outside(bench)


def test_what_a_busy_computer_keeps_waiting_is_slow_too() -> None:
    told = {"worked": iter([3.0, 3.5, 4.0, 4.5, 5.0, 5.5]), "waited": iter([1.0, 1.9, 2.0, 2.3, 3.0, 3.4])}
    machine = SimpleNamespace(
        run=lambda *_: "", worked_s=lambda: next(told["worked"]), waited_s=lambda: next(told["waited"])
    )
    assert common.pace(machine) == pytest.approx(0.8)  # type: ignore[arg-type]  # the least of them


def test_a_drive_whose_end_was_left_undone_agrees_until_then(monkeypatch: pytest.MonkeyPatch) -> None:
    way = np.arange(0.0, 20.0, 0.05)
    monkeypatch.setattr(trying_system, "outside", lambda: Trace(way, np.zeros((len(way), 2))))

    def astray(metres: float, since: int, undone: int) -> Bench:
        """Led 5 cm astray from a pose on; cycles are over their budget from another on."""
        bench = driven(metres)
        for k, one in enumerate(bench.memory["drive"]):
            off = 0.05 if k >= since else 0.0
            said = replace(one, pose=(0.1 * k, off, 0.0), overruns=int(k >= undone))
            bench.memory["drive"][k] = said
        return bench

    seen = trying_system.agrees_with_outside(astray(9.0, since=60, undone=60))
    assert isinstance(seen, Seen)
    assert seen.said.startswith("60 poses, until work was left undone (meanwhile 0 scans missed, 1 cycles")
    assert round(seen.figures[1].value, 1) == 5.9
    assert str(seen.figures[-1]) == "inside and outside: apart, largest of the whole drive: 50 mm", "what came after"
    for since, undone in ((60, 10_000), (60, 70), (20, 20)):  # nothing was; too late to be why; too little is left
        with pytest.raises(common.Unmet, match=r"apart, largest: 50|way compared: 1\.") as unmet:
            trying_system.agrees_with_outside(astray(9.0, since, undone))
        titles = [plot.title for plot in unmet.value.seen.plots]
        assert titles == ["inside and outside: apart", "inside and outside: apart, whole drive"][: 1 + (undone < 100)]
        assert ("until work was left undone" in str(unmet.value)) is (undone < 100)
    whole = trying_system.agrees_with_outside(astray(9.0, since=10_000, undone=3))
    assert isinstance(whole, Seen)
    assert round(whole.figures[1].value) == 9  # what changed nothing cuts nothing short


def test_a_place_that_nobody_claims_is_compared_with_nothing() -> None:
    nowhere = driven(5.0)
    nowhere.memory["drive"] = [Heard(0.2, 0.2, 1, None, 0.0)] * 20
    with pytest.raises(Order, match="no pose of the drive claims a place"):
        trying_system.agrees_with_outside(nowhere)


@pytest.mark.parametrize("wrong", ["", "status", "unsaved"])
def test_a_stop_is_clean_and_saves_the_map(wrong: str) -> None:
    def run(*words: str, **more: object) -> str:
        if words[0] == "journalctl":
            return "map saved: 1\nstopping\n" + ("" if wrong == "unsaved" else "map saved: 2\n")
        return ""

    bench, status = inside(run), "1" if wrong == "status" else "0"
    bench.machine.show = lambda *_: {"Result": "success", "ExecMainStatus": status}  # type: ignore[method-assign]
    if not wrong:
        assert trying_process.is_stopped(bench).endswith("the map saved")
    else:
        with pytest.raises(Order):
            trying_process.is_stopped(bench)


def test_what_is_worse_is_said_last_and_what_cannot_be_compared_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of another bench, or of other scenarios: before an image is made."""
    boots = Result("boots", "it boots", True, 1.0, "", figures=(Figure("up after", 9.0, "s", "more"),))

    def bench(*words: str) -> tuple[int, list[str]]:
        monkeypatch.setattr("sys.argv", ["vm", "boots", *words])
        return command.main(), capsys.readouterr().out.splitlines()

    monkeypatch.setattr(command, "image", lambda say: pytest.fail("nothing may be made"))
    for name, (about, result, says) in {
        "hil": ("hil", boots, "is a report of hil, and this is bench-vm"),
        "other": ("bench-vm", replace(boots, name="drives"), "has nothing of what is to be tried now (boots)"),
    }.items():
        write(tmp_path / name, [result], About(about, "", {}))
        code, said = bench("--against", str(tmp_path / name))
        assert (code, says in said[-1]) == (2, True), said
    made = SimpleNamespace(image=SimpleNamespace(folder=tmp_path))
    monkeypatch.setattr(command, "image", lambda say: nullcontext())
    monkeypatch.setattr(command, "booted", lambda image, say: made)
    monkeypatch.setattr(command, "outside", lambda: None)
    monkeypatch.setattr(command, "run", lambda *_: (True, [boots]))
    write(tmp_path / "1", [replace(boots, figures=(Figure("up after", 3.0, "s", "more"),))], About("bench-vm", "", {}))
    code, said = bench("--against", str(tmp_path / "1"), "--out", str(tmp_path / "2"))
    assert (code, said[-1]) == (1, "FAILED: 1 worse than before"), said
    assert said[0].startswith("1 of 1 passed")
    assert bench("--out", str(tmp_path / "3"))[0] == 0
    code, said = bench("--against", str(tmp_path / "3"), "--out", str(tmp_path / "4"))
    assert (code, said[1:]) == (0, [f"compared with {tmp_path}/3/results.json: 1 of 1 outcomes, 1 of 1 figures"])
    other = tmp_path / "lumiloop.toml"
    other.write_text("[lidar]\n# another\n")
    monkeypatch.setattr(command, "CONFIGURATION", other)
    assert "configuration differs" in bench("--against", str(tmp_path / "3"), "--out", str(tmp_path / "4"))[1][-1]
    monkeypatch.setattr(command, "image", lambda say: pytest.fail("nothing may be made"))
    code, said = bench("--against", str(tmp_path / "3"), "--out", str(tmp_path / "3"))
    assert (code, "would overwrite it; name another folder with --out" in said[-1]) == (2, True), said


@pytest.mark.parametrize(("degraded", "off", "right"), [(4, 0.0, True), (8, 0.0, False), (0, 0.2, False)])
def test_a_drive_is_tracking_and_right_and_is_shown_where_it_is_not(
    degraded: int, off: float, right: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = driven(5.0)
    bench.folder = tmp_path
    heard = [replace(one, pose=(0.1 * k, off, 0.0), state=3 if k >= degraded else 4) for k, one in enumerate(poses(51))]
    bench.start = (0.0, 0.0, 0.0)
    for name, made in (
        ("drive", lambda: None), ("until", lambda *_: 0.0), ("collect", lambda seconds: heard),
        ("placed", lambda *_: 0.0),
    ):  # fmt: skip
        monkeypatch.setattr(bench, name, made)
    if right:
        assert isinstance(trying_system.drives(bench), Seen)
        kept = json.loads((tmp_path / "drive").read_text())
        assert kept["poses"][3][1:3] == [pytest.approx(0.6), [pytest.approx(0.3), 0.0, 0.0]]
        assert kept["truth"][12] == [pytest.approx(0.6), [pytest.approx(0.3), 0.0, 0.0]]
        return
    with pytest.raises(common.Unmet, match=r"TRACKING for 84 % of 51 poses|0\.200 m from the truth") as unmet:
        trying_system.drives(bench)
    assert [plot.title for plot in unmet.value.seen.plots] == ["trajectory", "age of a pose that comes"]
