"""What is said of a configuration that is wrong: all of it at once, in words for who writes the file."""

import re
from pathlib import Path

import msgspec
import pytest

from daemon.config import loader
from daemon.config.errors import problems
from tests.daemon.config.refused import refused


def test_a_refusal_says_what_the_key_is_for(tmp_path: Path) -> None:
    assert refused(tmp_path, "[modbus]\nport = -1").endswith("(UDP and TCP port; 0: no Modbus); as in port = 1502")


def test_all_that_is_wrong_is_said_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = """bind = "robot"
qqq = 1
allow = ["plc"]
[lidar]
device = "aut"
mount = { x = "1", yaw = 400.0 }
[photodiode]
bus = "i2c-1"
profile = "C"
converter = "mcp3221"
[modbus]
port = "a"
write = 1
[pose]
receivers = ["plc"]
"""
    said = refused(tmp_path, text, "odometry.port=x", "=3", "cycle.budget_ms=-1").splitlines()
    keys = [line.split("`")[1] for line in said if line.startswith("robot.toml:")]
    assert keys == [
        *("bind", "qqq", "allow[0]", "lidar.device", "lidar.mount.x", "lidar.mount.yaw", "photodiode.bus"),
        *("photodiode.profile", "photodiode.converter", "modbus.port", "modbus.write", "pose.receivers[0]"),
    ]
    assert [int(line.split(":")[1]) for line in said if line.startswith("robot.toml:")] == [
        *(1, 2, 3, 5, 6, 6, 8, 9, 10, 12, 13, 15)
    ]
    assert [line.split(": ")[0] for line in said[12:]] == [
        *("--set odometry.port=x", "--set =3", "--set cycle.budget_ms=-1")
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("allow = [1]", "`allow[0]` = 1: expected text ("),
        ("allow = 1", "`allow` = 1: expected a list of text ("),
        (
            "[lidar.mask]\nsectors = [3]",
            "`lidar.mask.sectors[0]` = 3: expected [number, number], each -360.0 to 360.0 (",
        ),
        (
            "[lidar.mask]\nsectors = [[1, 'a']]",
            '`lidar.mask.sectors[0][1]` = "a": expected a number, -360.0 to 360.0 (',
        ),
    ],
)
def test_of_an_item_its_own_kind_is_said(tmp_path: Path, text: str, words: str) -> None:
    assert words in refused(tmp_path, text)


@pytest.mark.parametrize(
    "text",
    [
        "lidar.device = 'none'\n[photodiode]\nbus = 'i2c-1'",
        "[modbus]\nport = 'x'\n[odometry]\nport = 1502",
        "[lidar]\ndevice = 3\n[modbus]\nserial = '/dev/a'",
        "bind = 'x'\nallow = ['10.0.0.0/8']",
    ],
)
def test_what_stands_in_for_a_wrong_value_is_no_error_of_its_own(tmp_path: Path, text: str) -> None:
    assert len(refused(tmp_path, text).splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        (
            "lidar.device = 'none'\n[modbus]\nport = 99999\n[odometry]\nport = 5\n[pose]\nreceivers = ['*:5']",
            ["lidar.device", "modbus.port", "pose.receivers"],
        ),
        (
            "allow = ['plc', '10.0.0.7', 'gate']\n[pose]\nreceivers = ['plc', '*:1502', 7]\n"
            "[lidar.mask]\nsectors = [[1.0, 999.0], [1.0, 2.0], [3.0]]",
            [
                *("allow[0]", "allow[2]", "pose.receivers", "pose.receivers[0]", "pose.receivers[2]"),
                *("lidar.mask.sectors[0][1]", "lidar.mask.sectors[2]"),
            ],
        ),
    ],
)
def test_what_only_shows_beside_other_keys_is_said_whatever_else_is_wrong(
    tmp_path: Path, text: str, keys: list[str]
) -> None:
    told = [line.split("`")[1] for line in refused(tmp_path, text).splitlines()]
    assert sorted(told) == sorted(keys)


def test_one_wrong_value_hides_no_other_that_names_it(tmp_path: Path) -> None:
    """What `allow` is for says `bind`."""
    assert len(refused(tmp_path, "bind = 'x'\nallow = ['plc']").splitlines()) == 2


@pytest.mark.parametrize("wrong", [3, 2.5, "text", True, [1], ["a", {}], {"a": 1}, "1979-05-27", float("nan"), 10**30])
def test_no_error_speaks_of_the_program(wrong: object) -> None:
    """Whatever stands where it does not belong."""
    spoken = re.compile(r"\b(str|int|float|bool|array|object|None|regex|tuple|dict|Expected|at `\$)\b")
    for option in loader.options():
        *parents, key = option.path.split(".")
        tree: dict[str, object] = {key: wrong}
        for parent in reversed(parents):
            tree = {parent: tree}
        for line in (wrong.text for wrong in problems(tree, "robot.toml")):
            assert f"`{option.path}" in line
            assert "; as in " in line
            assert not spoken.search(line), line


def test_the_example_of_each_option_is_one_that_is_taken() -> None:
    for option in loader.options():
        *parents, key = option.path.split(".")
        tree = {key: msgspec.to_builtins(option.example)}
        for parent in reversed(parents):
            tree = {parent: tree}
        assert problems(tree, "example") == []
        assert option.example != "", option.path
        assert option.example != (), option.path


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[modbus]\nprot = 1", "robot.toml:2: unknown key `modbus.prot`; did you mean `modbus.port`?"),
        ("port = 1", "robot.toml:1: unknown key `port`; did you mean `odometry.port` or `modbus.port`?"),
        (
            "[lidar]\ninverted = true",
            "robot.toml:2: unknown key `lidar.inverted`; did you mean `lidar.mount.inverted`?",
        ),
        ("qqq = 1", "robot.toml:1: unknown key `qqq`; `lumiloop --print-config` lists all keys"),
        (
            '"lidar.device" = "a"',
            'robot.toml:1: unknown key `"lidar.device"`: the quotes make this one name; did you mean `lidar.device`?',
        ),
        (
            '[lidar]\n"mount.x" = 0.1',
            'robot.toml:2: unknown key `lidar."mount.x"`: the quotes make this one name; did you mean `lidar.mount.x`?',
        ),
        (
            '["lidar.mask"]\nnear = 0.1',
            'robot.toml:1: unknown key `"lidar.mask"`: the quotes make this one name; did you mean `lidar.mask`?',
        ),
        ('"a.b" = 1', 'robot.toml:1: unknown key `"a.b"`; `lumiloop --print-config` lists all keys'),
        (
            '"x` - at `$.lidar" = 1',
            'robot.toml: unknown key `"x` - at `$.lidar"`; `lumiloop --print-config` lists all keys',
        ),
        ('[lidr]\ndevice = "x"', "robot.toml:1: unknown key `lidr`; did you mean `lidar`?"),
        ("[lidar.msk]\nnear = 0.1", "robot.toml:1: unknown key `lidar.msk`; did you mean `lidar.mask`?"),
        ("[mask]\nnear = 0.1", "robot.toml:1: unknown key `mask`; did you mean `lidar.mask`?"),
        ("[qqq]\nnear = 0.1", "robot.toml:1: unknown key `qqq`; `lumiloop --print-config` lists all keys"),
    ],
)
def test_an_unknown_key_names_its_path_and_the_nearest_known_one(tmp_path: Path, text: str, expected: str) -> None:
    assert refused(tmp_path, text) == expected
