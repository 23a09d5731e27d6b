"""Lamp maintenance: histories of lamps whose fate is known, gathered from maps and judged."""

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.cli.lamps.history import tell
from daemon.config.schema import Config, MapConfig
from daemon.diagnosis.host import Heard, Mute
from daemon.diagnosis.lamp_history import DAY_S, BadHistory, Look, by_lamp, in_maps, load, merged, save
from daemon.diagnosis.lamp_trend import YEAR_S, Array, Finding, Verdict, judge, together
from daemon.health.faults import Fault as Said
from daemon.maps.image import meta_of, packed
from daemon.publish.stream.messages import Fault, Faults
from daemon.snapshot import LinkUse
from daemon.system import console
from tests.daemon.diagnosis.test_doctor import Computer
from tests.daemon.support.map_maker import LAMPS, Shape, image

NOW = 1.8e9
RNG = np.random.default_rng(4)


def drifting(per_year: float, days: int = 180, level: float = 1.0, sigma: float = 0.02) -> Array:
    """A look a day; the last one is of now."""
    t = NOW - DAY_S * np.arange(days)[::-1]
    y = math.log(level) + math.log1p(per_year) / YEAR_S * (t - t[0]) + RNG.normal(0.0, sigma, days)
    return np.column_stack((t, y, np.full(days, sigma)))


def verdict(rows: Array, uses: dict[int, int] | None = None) -> Verdict:
    others = {lamp: drifting(0.0) for lamp in range(100, 104)}
    (one,) = (found for found in judge({7: rows, **others}, NOW, uses) if found.lamp == 7)
    return one


def test_a_lamp_that_dims_has_a_date() -> None:
    one = verdict(drifting(-0.2))
    assert one.finding is Finding.DIMMING
    assert one.per_year == pytest.approx(-0.2, abs=0.02)
    truth = NOW - 179 * DAY_S + math.log(0.7) / math.log(0.8) * YEAR_S
    assert one.replace_by is not None
    assert one.earliest is not None
    assert one.replace_by == pytest.approx(truth, abs=60 * DAY_S)
    assert NOW < one.earliest < one.replace_by


def test_dates_are_honest() -> None:
    """Of 200 lamps that dim by 15 % a year, the true end lies after the earliest date in 97 of 100."""
    truth = NOW - 179 * DAY_S + math.log(0.7) / math.log(0.85) * YEAR_S
    told = [one.earliest for one in (verdict(drifting(-0.15)) for _ in range(200)) if one.earliest is not None]
    assert len(told) == 200
    assert 0.93 < np.mean([earliest < truth for earliest in told]) < 1.0


def test_one_that_is_well_has_none() -> None:
    found = [verdict(drifting(0.0)).finding for _ in range(100)]
    assert found.count(Finding.GOOD) >= 93
    assert verdict(drifting(-0.001, sigma=0.002)).replace_by is None


def test_the_gravest_comes_first_and_a_running_daemon_knows_of_dead_and_moved() -> None:
    lamps = {1: drifting(0.0), 2: drifting(-0.3), 3: drifting(0.0), 4: drifting(-0.4, level=0.72)}
    found = judge(lamps, NOW, {1: int(LinkUse.REJECTED), 3: int(LinkUse.MISSING), 9: int(LinkUse.ACCEPTED)})
    assert [(one.lamp, one.finding) for one in found] == [
        (3, Finding.DEAD), (1, Finding.MOVED), (4, Finding.WORN), (2, Finding.DIMMING), (9, Finding.YOUNG),
    ]  # fmt: skip
    assert [one.urgent for one in found] == [True, True, True, False, False]


def test_a_lamp_that_was_exchanged_begins_anew() -> None:
    rows = drifting(-0.3)
    rows[150:, 1] += 0.5
    one = verdict(rows)
    assert one.since == pytest.approx(rows[150, 0])
    assert one.finding in (Finding.CHANGED, Finding.DIMMING)
    assert one.level > 1.2


def test_a_lamp_that_nobody_hears_stands_still() -> None:
    rows = drifting(0.0)
    rows[-20:, 1] = rows[-20, 1]
    one = verdict(rows)
    assert one.finding is Finding.UNHEARD
    assert one.since == rows[-20, 0]
    still = {lamp: np.array(((NOW - 30 * DAY_S, 0.1, 0.02), (NOW, 0.1, 0.02))) for lamp in range(4)}
    assert not any(found.finding is Finding.UNHEARD for found in judge(still, NOW)), "the robot stood in the garage"


def test_few_looks_say_little() -> None:
    assert verdict(drifting(-0.5, days=5)).finding is Finding.YOUNG
    assert verdict(drifting(0.0, days=3, level=0.5)).finding is Finding.WORN


def test_what_all_have_in_common_is_said() -> None:
    common = together(judge({lamp: drifting(-0.1) for lamp in range(6)}, NOW))
    assert common == pytest.approx(-0.1, abs=0.02)
    assert together([]) is None


def test_the_file_keeps_one_look_a_day_for_years(tmp_path: Path) -> None:
    path = tmp_path / "lamps.csv"
    assert load(path) == []
    looks = [Look(NOW + hour * 3600.0, lamp, 0.01 * hour, 0.02) for hour in range(48) for lamp in (1, 2)]
    looks.append(Look(NOW - 6 * YEAR_S, 1, 0.0, 0.02))
    kept = merged([], looks)
    assert len(kept) in (4, 6), "two or three days"
    save(path, kept)
    again = load(path)
    assert [(one.lamp, round(one.ln_gain, 4)) for one in again] == [(one.lamp, round(one.ln_gain, 4)) for one in kept]
    assert merged(again, again) == again


def test_a_value_that_stands_still_does_not_move_by_being_kept(tmp_path: Path) -> None:
    """Else a lamp that nobody hears would seem to be heard each day anew."""
    put_map(tmp_path / "maps", 1, NOW + 0.4)
    fresh = sorted(in_maps(tmp_path / "maps"))
    save(tmp_path / "lamps.csv", fresh)
    assert load(tmp_path / "lamps.csv") == fresh
    gains = {look.lamp: look.ln_gain for look in fresh}
    for day in range(1, 20):
        fresh = [replace(look, utc=NOW + day * DAY_S) for look in in_maps(tmp_path / "maps")]
        fresh = [replace(look, ln_gain=look.ln_gain + 0.01 * day * (look.lamp != 4)) for look in fresh]
        save(tmp_path / "lamps.csv", merged(load(tmp_path / "lamps.csv"), fresh))
    found = {one.lamp: one for one in judge(by_lamp(merged(load(tmp_path / "lamps.csv"), fresh)), NOW + 20 * DAY_S)}
    assert found[4].finding is Finding.UNHEARD
    assert found[4].level == pytest.approx(math.exp(gains[4]), rel=0.1)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("garbage\n", "its first line"),
        ("utc,lamp,ln_gain,sigma\n1,2,3\n", "line 2"),
        ("utc,lamp,ln_gain,sigma\n1,2,nan,1\n", "out of range"),
        ("", "its first line"),
    ],
)
def test_a_file_that_is_none_is_said(tmp_path: Path, text: str, what: str) -> None:
    (tmp_path / "a").write_text(text)
    with pytest.raises(BadHistory, match=what):
        load(tmp_path / "a")


def put_map(folder: Path, number: int, saved: float) -> None:
    folder.mkdir(exist_ok=True)
    made = image(Shape(lit=True), number)
    meta = replace_saved(meta_of(made, 0.0, "agv", "1"), saved)
    (folder / f"00001234-{number:08d}.lumimap").write_bytes(packed(made, meta))


def replace_saved(meta: object, saved: float) -> object:
    import msgspec

    return msgspec.structs.replace(meta, saved=saved)


def args(folder: Path, **changes: object) -> argparse.Namespace:
    settings = Config(map=MapConfig(folder=str(folder)))
    return argparse.Namespace(**{"settings": settings, "history": None, "stream": None, "json": True, **changes})


def test_the_command_gathers_from_maps_and_remembers_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "maps"
    put_map(folder, 1, NOW - 5 * DAY_S)
    put_map(folder, 2, NOW)
    (folder / "00001234-00000003.lumimap").write_bytes(b"torn")
    assert len(in_maps(folder)) == 2 * len(LAMPS)
    dead = Faults(present=(Fault(fault=int(Said.LAMP_DEAD)),))
    host = Computer(t_utc=NOW, heard=Heard("agv", 1, faults=dead, lamps={(3, 4): int(LinkUse.MISSING)}))
    assert tell(args(folder), host) == console.FAILED
    told = json.loads(capsys.readouterr().out)
    assert (told[0]["lamp"], told[0]["finding"], told[0]["urgent"]) == (4, "dead", True)
    assert {one["lamp"] for one in told} == {lamp.lamp_id for lamp in LAMPS}
    for path in folder.glob("*.lumimap"):
        path.unlink()
    assert len(load(tmp_path / "lamps.csv")) == 2 * len(LAMPS)
    tell(args(folder, json=False), host)
    said = capsys.readouterr().out
    assert "is not received where it is expected" in said
    assert said.splitlines()[-1].startswith("needs attention: lamp 4")


def test_a_passing_shadow_sends_nobody_to_a_lamp(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What a link is at the moment of asking is no verdict: the daemon's own takes ten seconds, and is a fault."""
    put_map(tmp_path / "maps", 1, NOW)
    odd = {(3, 4): int(LinkUse.REJECTED), (2, 3): int(LinkUse.MISSING)}
    heard = Heard("agv", 1, faults=Faults(present=(Fault(fault=int(Said.NO_LAMPS)),)), lamps=odd)
    assert tell(args(tmp_path / "maps", json=False), Computer(t_utc=NOW, heard=heard)) == console.OK
    assert "no lamp is urgent" in capsys.readouterr().out
    heard.faults = Faults(present=(Fault(fault=int(Said.LAMP_MOVED)),))
    assert tell(args(tmp_path / "maps", json=False), Computer(t_utc=NOW, heard=heard)) == console.FAILED
    assert capsys.readouterr().out.splitlines()[-1] == "needs attention: lamp 4"


def test_that_no_daemon_was_heard_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Else `no lamp is urgent` would seem to be said of dead lamps, too."""
    put_map(tmp_path / "maps", 1, NOW)
    assert tell(args(tmp_path / "maps"), Computer(t_utc=NOW)) == console.OK
    told = capsys.readouterr()
    assert "no daemon reports which lamps are defective or moved at present: no daemon listens there" in told.err
    assert json.loads(told.out)
    tell(args(tmp_path / "maps"), Computer(t_utc=NOW, heard=Mute("the socket: anna has no access", "")))
    assert "has no access" in capsys.readouterr().err


def test_where_nothing_is_known_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tell(args(tmp_path / "maps"), Computer(t_utc=NOW)) == console.FAILED
    assert "the history has no lamp yet" in capsys.readouterr().err
    none = Config(map=MapConfig(folder="none"))
    assert tell(args(tmp_path, settings=none), Computer()) == console.USAGE
    (tmp_path / "lamps.csv").write_text("x")
    assert tell(args(tmp_path / "maps"), Computer()) == console.FAILED
    assert "is not a lamp history" in capsys.readouterr().err
    assert replace(Verdict(1, Finding.GOOD), lamp=2).urgent is False


def test_it_makes_no_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = tmp_path / "none" / "lamps.csv"
    put_map(tmp_path / "maps", 1, NOW)
    assert tell(args(tmp_path / "maps", history=where), Computer()) == console.USAGE
    assert f"--history {where}: no such folder: {tmp_path / 'none'}; make it" in capsys.readouterr().err
    assert not where.parent.exists()
