"""The configuration tree: few options, precise refusals, and a print that can be pasted back."""

import ast
import json
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.config import loader
from daemon.config.endpoints import LidarPlace, RtuLine, parse_endpoint, parse_lidar, parse_line
from daemon.config.loader import ConfigError, load
from daemon.config.schema import PROFILES, Config, LidarConfig, Mask, ModbusConfig, Mount, PoseConfig, parse_chip
from estimator.cdma import air_interface
from tests.daemon.config.refused import refused

ROOT = Path(__file__).parents[3]


def test_few_options_and_each_one_described() -> None:
    options = loader.options()
    assert 10 <= len(options) <= 25
    assert [option.path for option in options if not option.description] == []


def test_each_option_is_read_by_somebody() -> None:
    read: set[str] = set()
    for path in (ROOT / "daemon").rglob("*.py"):
        if path.name not in ("schema.py", "loader.py"):
            read |= {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
    unread = [option.path for option in loader.options() if option.path.rpartition(".")[2] not in read]
    assert unread == [], "an option that does nothing is a lie"


def test_an_empty_file_is_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "empty.toml"
    file.write_text("")
    assert load(file) == load(None) == Config()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("\n[modbus]\nport = 70000", "robot.toml:3: `modbus.port` = 70000: expected a whole number, 0 to 65535"),
        ("[modbus]\nwrite = 1", "robot.toml:2: `modbus.write` = 1: expected true or false"),
        ("[lidar]\nmount = {x = nan}", "robot.toml:2: `lidar.mount.x` = nan: expected a number, -100.0 to 100.0"),
        ("lidar.mount.x = inf", "robot.toml:1: `lidar.mount.x` = inf: expected a number, -100.0 to 100.0"),
        ("lidar = 3", "robot.toml:1: `lidar` = 3: expected a table, [lidar], of device, intensity, mask, mount"),
        (
            "[lidar.mask]\nsectors = [[1, 2], [3]]",
            "robot.toml:2: `lidar.mask.sectors[1]` = [3]: expected [number, number], each -360.0 to",
        ),
        (
            "[lidar.mask]\nsectors = [[1, 1]]",
            "robot.toml:2: `lidar.mask.sectors`: expected two different bearings, got [1.0, 1.0]",
        ),
        (
            "[lidar]\ndevice = '/dev/ttyS1@9600'",
            "robot.toml:2: `lidar.device`: expected a line rate of 19200, 38400, 57600, 115200, 250000, 500000,",
        ),
        (
            "[lidar]\ndevice = 'auto:'",
            "robot.toml:2: `lidar.device`: expected `auto`, `auto:SERIAL`, `none`, a path such as /dev/ttyACM0",
        ),
        (
            "[lidar]\ndevice = 'auto:a b'",
            "robot.toml:2: `lidar.device`: expected a serial number after `auto:`, as in auto:H0906091, got",
        ),
        (
            "[lidar]\nserial = 'H1'",
            'robot.toml:2: `lidar.serial` is now part of `lidar.device`: write lidar.device = "auto:SERIAL"',
        ),
        (
            "lidar.baud = 19200",
            "robot.toml:1: `lidar.baud` is now part of `lidar.device`: write the rate after the path, as in",
        ),
        (
            "allow = ['10.0.0.1/24']",
            "robot.toml:1: `allow[0]`: expected `10.0.0.0/24` (the network) or an address without `/`, got",
        ),
        (
            "allow = ['::1', 'plc']",
            "robot.toml:1: `allow[1]`: expected an address or a network such as 192.168.0.0/24, got `plc`",
        ),
        (
            "[modbus]\nserial = 'ttyUSB1'",
            "robot.toml:2: `modbus.serial`: expected a path with line rate and unit, as in",
        ),
        (
            "[modbus]\nserial = '/dev/a@9601'",
            "robot.toml:2: `modbus.serial`: expected a line rate of 1200, 2400, 4800, 9600, 19200, 38400, 57600,",
        ),
        (
            "[modbus]\nserial = '/dev/a@9600,7E1'",
            "robot.toml:2: `modbus.serial`: expected a format of 8E1, 8O1, 8N1, 8N2 after the rate, got",
        ),
        (
            "[modbus]\nserial = '/dev/a#0'",
            "robot.toml:2: `modbus.serial`: expected a unit from 1 to 247 after `#`, got `/dev/a#0`",
        ),
        (
            "[lidar]\ndevice = '/dev/a@19200'\n[modbus]\nserial = '/dev/a#2'",
            "robot.toml:4: `modbus.serial`: expected a line that the lidar does not use, got `/dev/a#2`",
        ),
        (
            "[pose]\nreceivers = ['*:1', '*:2']",
            "robot.toml:2: `pose.receivers`: expected one port to subscribe on, `*:port`",
        ),
        (
            "[pose]\nreceivers = ['*:1502']",
            "robot.toml:2: `pose.receivers`: expected a port other than `modbus.port`, got `*:1502`",
        ),
        ("bind = 'robot'", "robot.toml:1: `bind`: expected an IP address of this machine, got `robot`"),
        (
            "[pose]\nreceivers = ['plc']",
            "robot.toml:2: `pose.receivers[0]`: expected `host:port`, `[ipv6]:port` or `*:port`, got `plc`",
        ),
        (
            "[pose]\nreceivers = ['a:1', 'plc:0']",
            "robot.toml:2: `pose.receivers[1]`: expected a port from 1 to 65535, got `plc:0`",
        ),
        (
            "[odometry]\nport = 1502",
            "robot.toml:2: `odometry.port`: expected a port other than `modbus.port`, got 1502",
        ),
        (
            "[photodiode]\nbus = 'i2c-1'",
            "robot.toml:2: `photodiode.bus`: expected /dev/i2c-1, adapter:NAME, unix:/path or tcp://host:port,",
        ),
        (
            "[lidar]\ndevice = 'tcp://robot:lidar'",
            "robot.toml:2: `lidar.device`: expected tcp://host or tcp://host:port, got `tcp://robot:lidar`",
        ),
        (
            "[lidar]\ndevice = 'tcp://:10940'",
            "robot.toml:2: `lidar.device`: expected tcp://host or tcp://host:port, got `tcp://:10940`",
        ),
        (
            "[photodiode]\nbus = 'tcp://robot:70000'",
            "robot.toml:2: `photodiode.bus`: expected tcp://host or tcp://host:port, got `tcp://robot:70000`",
        ),
        (
            "[photodiode]\nconverter = 'mcp3221'",
            "robot.toml:2: `photodiode.converter`: expected type@address, as in mcp3221@0x4d, got `mcp3221`",
        ),
        ("[photodiode]\nconverter = 'mcp3221@0x20'", "Expected mcp3221@ADDRESS in `converter`, one of 0x48, 0x49"),
        (
            "[photodiode]\nconverter = 'ads1115@0x48'",
            "robot.toml:2: `photodiode.converter`: converter ads1115: it samples by its own clock, so it measures",
        ),
        ("[photodiode]\nconverter = 'mcp3221@0x4d/0'", "Expected mcp3221@ADDRESS in `converter`"),
        (
            "[photodiode]\nlevel = 'ads1115@0x48'",
            "robot.toml:2: `photodiode.level`: expected type@address/channel with another address",
        ),
        (
            "[photodiode]\nlevel = 'ads1115@0x20/1'",
            "robot.toml:2: `photodiode.level`: DC channel at 0x20: an ads1115 answers at 0x48 to 0x4b",
        ),
        (
            "[photodiode]\nconverter='mcp3221@0x48'\nlevel='ads1115@0x48/1'",
            "robot.toml:3: `photodiode.level`: expected type@address/channel with another address",
        ),
        ("[photodiode]\nprofile = 'C'", "robot.toml:2: `photodiode.profile`: expected one of A, B, D, got `C`"),
        ("[lidar]\ndevice = 'none'", "expected a lidar, because `photodiode.bus` is empty"),
        ("name = ''", 'robot.toml:1: `name` = "": expected text'),
        ("x y", "robot.toml:1: not valid TOML: Expected '=' after a key in a key/value pair (at line 1, column 3)"),
    ],
)
def test_a_wrong_value_is_refused_with_place_and_expectation(tmp_path: Path, text: str, expected: str) -> None:
    assert expected in refused(tmp_path, text)


@pytest.mark.parametrize("device", ["/dev/ttyACM0@baud", "/dev/ttyACM0@", "/dev/ttyUSB0@19201"])
def test_what_is_no_line_rate_is_refused(device: str) -> None:
    with pytest.raises(ValueError, match=r"Expected a line rate of 19200, .* after `@`"):
        parse_lidar(device)


def test_the_parts_of_a_place_are_told_apart() -> None:
    assert parse_lidar("auto:H0906091") == LidarPlace("auto", serial="H0906091")
    assert parse_lidar("/dev/ttyUSB0@115200") == LidarPlace("/dev/ttyUSB0", baud=115200)
    for whole in ("auto", "none", "/dev/serial/by-id/usb-x@y", "tcp://10.0.0.3:10940", "other:/dev/x@1,2"):
        assert parse_lidar(whole) == LidarPlace(whole)
    assert parse_line("/dev/ttyUSB1@115200#1") == RtuLine("/dev/ttyUSB1", 115200, "8E1", 1)
    assert parse_line("/dev/ttyUSB1@9600,8N2#17") == RtuLine("/dev/ttyUSB1", 9600, "8N2", 17)
    assert parse_line("/dev/serial/by-path/pci-0:1.0") == RtuLine("/dev/serial/by-path/pci-0:1.0", 19200, "8E1", 1)
    assert parse_line("/dev/a#247") == RtuLine("/dev/a", 19200, "8E1", 247)


def test_the_tree_of_an_earlier_version_is_brought_up() -> None:
    """As recordings hold it; what the run did stays what it was."""
    earlier = msgspec.to_builtins(Config())
    for old, device in (
        ({"device": "auto", "serial": "H1", "baud": 0}, "auto:H1"),
        ({"device": "/dev/ttyS1", "serial": "", "baud": 19200}, "/dev/ttyS1@19200"),
        ({"device": "/dev/ttyS1", "serial": "H1", "baud": 0}, "/dev/ttyS1"),
        ({"device": "tcp://10.0.0.3", "serial": "", "baud": 19200}, "tcp://10.0.0.3"),
    ):
        tree = loader.brought_up(earlier | {"lidar": old})
        assert msgspec.convert(tree, Config) == Config(lidar=LidarConfig(device=device))
    assert loader.brought_up({}) == {}


def test_lights_alone_are_a_configuration(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(
        "lidar.device = 'none'\n[photodiode]\nbus = '/dev/i2c-1'\nconverter = 'adc121c021@0x54'\n"
        "level = 'ADS1015@73/3'\nprofile = 'D'\n"
    )
    config = load(file)
    assert (config.lidar.fitted, config.photodiode.fitted) == (False, True)
    assert parse_chip(config.photodiode.level) == ("ADS1015", 73, 3)
    assert tuple(PROFILES) == tuple(air_interface.PROFILES)


def test_a_survey_is_looked_for_beside_the_file_that_names_it(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[lights]\nsurvey = 'maps/hall.toml'\n")
    assert load(file).lights.survey == str(tmp_path.resolve() / "maps" / "hall.toml")
    file.write_text("[lights]\nsurvey = '/etc/hall.toml'\n")
    assert load(file).lights.survey == "/etc/hall.toml"
    assert load(None, ["lights.survey=hall.toml"]).lights.survey == "hall.toml"
    file.write_text("")
    assert load(file).lights.survey == ""


def test_a_missing_or_unreadable_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml: no such file"):
        load(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b"name = '\xe9'")
    with pytest.raises(ConfigError, match=r"latin\.toml: not UTF-8 text at byte 8"):
        load(tmp_path / "latin.toml")


def test_overrides_beat_the_file_and_take_bare_words(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[modbus]\nport = 5020")
    config = load(file, ["modbus.port=0", "lidar.device=/dev/ttyACM3", "pose.receivers=['10.0.0.2:9000']"])
    assert config.modbus.port == 0
    assert config.lidar.device == "/dev/ttyACM3"
    assert config.pose.receivers == ("10.0.0.2:9000",)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("modbus.port", "--set modbus.port: expected KEY=VALUE"),
        ("=3", "--set =3: expected KEY=VALUE"),
        ("modbus.port=x", '--set modbus.port=x: `modbus.port` = "x": expected a whole number, 0 to 65535'),
        ("name.x=1", "--set name.x=1: `name` is a value"),
        ("modbus.prot=1", "--set modbus.prot=1: unknown key `modbus.prot`; did you mean `modbus.port`?"),
    ],
)
def test_a_wrong_override_is_refused_as_such(tmp_path: Path, override: str, expected: str) -> None:
    assert refused(tmp_path, "name = 'r1'", override).startswith(expected)


bearings = st.floats(-360, 360)
configs = st.builds(
    Config,
    name=st.from_regex(r"\A[A-Za-z0-9_.-]{1,32}\Z"),
    bind=st.sampled_from(["127.0.0.1", "0.0.0.0", "::1"]),
    allow=st.lists(st.sampled_from(["10.0.0.0/8", "::1", "192.168.0.7"]), max_size=2).map(tuple),
    lidar=st.builds(
        LidarConfig,
        device=st.sampled_from(["auto", "auto:H1", "/dev/a@19200"])
        | st.from_regex(r"tcp://[a-z]{1,9}(:[1-9][0-9]{3})?|/[ -?A-~]+", fullmatch=True),
        mount=st.builds(Mount, x=st.floats(-100, 100), y=st.floats(-100, 100), yaw=bearings, inverted=st.booleans()),
        mask=st.builds(
            Mask,
            sectors=st.lists(st.tuples(bearings, bearings).filter(lambda s: s[0] != s[1])).map(tuple),
            near=st.floats(0, 10),
        ),
    ),
    modbus=st.builds(ModbusConfig, port=st.integers(0, 65535), write=st.booleans()),
    pose=st.builds(PoseConfig, receivers=st.lists(st.sampled_from(["a:1", "10.0.0.1:9000", "[::1]:7"])).map(tuple)),
)


@given(config=configs)
@settings(max_examples=40, deadline=None)
def test_what_is_printed_reads_back_equal(config: Config, tmp_path_factory: pytest.TempPathFactory) -> None:
    file = tmp_path_factory.mktemp("printed") / "printed.toml"
    file.write_text(loader.dump(config))
    assert load(file) == config


def test_schema_is_json_and_knows_every_key() -> None:
    schema = json.loads(loader.schema())
    assert set(schema["$defs"]["Config"]["properties"]) == set(msgspec.to_builtins(Config()))
    assert schema["$defs"]["ModbusConfig"]["properties"]["port"]["maximum"] == 65535


def test_the_reference_page_is_current_and_can_be_pasted(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "configuration.md").read_text()
    assert page == loader.reference(), "run: lumiloop --reference > docs/configuration.md"
    pasted = tmp_path / "pasted.toml"
    pasted.write_text(page.split("```toml\n")[1].split("```")[0])
    assert load(pasted) == Config()


@pytest.mark.parametrize(
    ("text", "expected"),
    [("plc:9000", ("plc", 9000)), ("*:5", ("*", 5)), ("10.0.0.2:1", ("10.0.0.2", 1)), ("[::1]:65535", ("::1", 65535))],
)
def test_endpoints(text: str, expected: tuple[str, int]) -> None:
    assert parse_endpoint(text) == expected


@pytest.mark.parametrize("text", ["", "plc", "plc:", ":9000", "plc:0", "plc:65536", "::1:80", "[plc]:80", "a b:1"])
def test_wrong_endpoints(text: str) -> None:
    with pytest.raises(ValueError, match="Expected"):
        parse_endpoint(text)


def test_a_character_that_no_name_can_have_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('[lights]\nsurvey = "a\\u0000b"\n')
    with pytest.raises(ConfigError, match=r"a\.toml:2: `lights\.survey` contains the character"):
        load(tmp_path / "a.toml")
