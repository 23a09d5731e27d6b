"""The contracts with clients are those of the last release; a change that breaks a client is named."""

import copy
import json
from typing import Any

import pytest

from tools.ci import contracts
from tools.ci.contracts import FROZEN, NOW, differences

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
