"""Nothing that a client of the release before relies on has changed; and if it had, it would be named."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest

from tools.ci import contracts
from tools.ci.contracts import FROZEN, NOW, additions, differences

NUMBER = "uint16, 1/1 , saturates, always known"
MAP_X = "map_x: int32, 1/10000 m, saturates, may be not known"


@pytest.fixture
def now() -> Any:
    return copy.deepcopy(contracts.contracts())


def test_the_release_before_is_kept_to() -> None:
    frozen = json.loads(FROZEN.read_text())
    found = differences(frozen["contracts"], contracts.contracts())
    assert found == [], "raise that contract's version number, keep the old one's reader, and write it in CHANGELOG.md"
    assert sum(len(one["items"]) for one in frozen["contracts"].values()) > 250


@pytest.mark.parametrize(
    ("contract", "key", "value", "said"),
    [
        ("modbus", "register 18", None, f"register 18 ({MAP_X}) is gone"),
        ("modbus", "register 18", "map_y: int32", f"register 18 was '{MAP_X}' and is 'map_y: int32'"),
        ("modbus", "bit 7 of flags", "alarm", "bit 7 of flags was 'alert' and is 'alarm'"),
        ("pose datagram", "byte 40", None, f"byte 40 ({MAP_X}) is gone"),
        ("numbers", "State 3", "LOST", "State 3 was 'TRACKING' and is 'LOST'"),
        ("numbers", "command 3", None, "command 3 (SAVE_MAP) is gone"),
        ("modbus holding", "holding 1100", "x", f"holding 1100 was 'number: {NUMBER}' and is 'x'"),
        ("configuration", "key modbus.port", "default 502", "key modbus.port was 'default 1502' and is 'default 502'"),
        ("stream", "topic scan", None, "topic scan is gone"),
        ("stream", "field unit of map", None, "field unit of map (float) is gone"),
        ("stream", "field trust.gap of pose", "int", "field trust.gap of pose was 'float | None' and is 'int'"),
        ("subscription", "byte 12", "cookie: <I", "byte 12 was 'cookie: <Q' and is 'cookie: <I'"),
        ("recordings", "kind 9", "SCAN", "kind 9 was 'SAMPLES' and is 'SCAN'"),
        ("recordings", "field 4 of CYCLE", "x: int", "field 4 of CYCLE was 'imu: int' and is 'x: int'"),
        ("recordings", "payload of IMU", None, "payload of IMU (<3d: t_rx t_mono yaw_rate) is gone"),
    ],
)  # fmt: skip
def test_what_breaks_a_client_is_named(now: Any, contract: str, key: str, value: str | None, said: str) -> None:
    frozen = copy.deepcopy(now)
    del now[contract]["items"][key]
    if value is not None:
        now[contract]["items"][key] = value
    assert differences(frozen, now) == [f"{contract}: {said}"]
    now[contract]["version"] += 1
    assert differences(frozen, now) == [], "a new version may do what it likes"


def test_what_is_new_since_the_release_changes_only_with_what_is_written_down_of_it() -> None:
    kept = json.loads(NOW.read_text())["contracts"]
    remedy = "run `python -m tools.ci.contracts --update`, and look at what that changes: somebody may use it already"
    assert kept == contracts.contracts(), remedy


def test_more_may_come_and_is_listed(now: Any) -> None:
    frozen = copy.deepcopy(now)
    assert additions(frozen, now) == []
    now["modbus"]["items"]["register 998"] = "later"
    now["another"] = {"version": 1, "items": {}}
    now["stream"]["version"] = 2
    assert differences(frozen, now) == []
    assert additions(frozen, now) == [
        "modbus: register 998 (later)",
        "stream: version 2, which was 1",
        "another: the whole contract, 0 items",
    ]


def test_a_contract_that_is_gone_or_counted_down_is_named(now: Any) -> None:
    frozen = copy.deepcopy(now)
    del now["stream"]
    now["map files"]["version"] = 0
    assert differences(frozen, now) == [
        "stream: the whole contract is gone",
        "map files: version 1 has become 0; versions only count up",
    ]


def test_a_key_may_go_if_it_is_refused_with_what_to_write_instead(now: Any) -> None:
    frozen = copy.deepcopy(now)
    frozen["configuration"]["items"]["key lidar.baud"] = "default 0"
    assert differences(frozen, now) == []
    frozen["configuration"]["items"]["key lidar.gain"] = "default 0"
    assert differences(frozen, now) == ["configuration: key lidar.gain (default 0) is gone"]


def test_the_command_says_what_is_broken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Any
) -> None:
    path = tmp_path / "release.json"
    monkeypatch.setattr(contracts, "FROZEN", path)
    monkeypatch.setattr(contracts, "NOW", tmp_path / "now.json")
    monkeypatch.setattr("sys.argv", ["contracts", "--freeze", "1.2.3"])
    assert contracts.main() == 0
    monkeypatch.setattr("sys.argv", ["contracts"])
    assert contracts.main() == 0
    assert capsys.readouterr().out == "nothing broken since 1.2.3, nothing new\n"
    kept = json.loads(path.read_text())
    kept["contracts"]["numbers"]["items"]["command 99"] = "DANCE"
    del kept["contracts"]["numbers"]["items"]["command 1"]
    path.write_text(json.dumps(kept))
    assert contracts.main() == 1
    said = capsys.readouterr().out
    assert "BROKEN: numbers: command 99 (DANCE) is gone" in said
    assert "new: numbers: command 1 (SET_POSE)" in said
    assert said.endswith("1 broken since 1.2.3, 1 new\n")
    (tmp_path / "now.json").unlink()
    monkeypatch.setattr("sys.argv", ["contracts", "--update"])
    assert contracts.main() == 0
    assert json.loads((tmp_path / "now.json").read_text())["release"] == "unreleased"
    assert json.loads(path.read_text()) == kept, "the release before stays what it was"
