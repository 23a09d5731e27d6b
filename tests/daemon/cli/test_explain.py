"""`lumiloop explain`: everything that has a name or a number can be asked about, and is found."""

import json
import re
from enum import IntEnum
from pathlib import Path

import pytest

from daemon.cli.explain import Entry, entries, find
from daemon.cli.parser import main, parser
from daemon.config.loader import options
from daemon.config.schema import Config
from daemon.health.faults import FAULTS, Fault
from daemon.health.reasons import REASONS, Reason
from daemon.publish.meanings import COMMANDS, FIXES, LOOPS, STATES, USES
from daemon.publish.modbus import holding
from daemon.snapshot import LightFix, LinkUse, LoopReason, Part, Stage, State, Thread
from daemon.system.console import FAILED, OK
from tests.commands import Command

ROOT = Path(__file__).parents[3]


def _told(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["explain", *words]) == OK
    return capsys.readouterr().out


def test_a_key_by_its_path_and_by_its_last_part(capsys: pytest.CaptureFixture[str]) -> None:
    by_path = _told(capsys, "integrity.alert_m")
    assert "configuration key: integrity.alert_m" in by_path
    assert "default 0.0" in by_path
    assert _told(capsys, "alert_m") == by_path
    assert _told(capsys, "`alert_m`") == by_path


def test_a_program_reads_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    told = json.loads(_told(capsys, "fault", "101", "--json"))
    text, remedy = FAULTS[Fault(101)]
    assert told["schema"] == "lumiloop.explain/1"
    assert told["entries"] == [
        {"kind": "fault", "name": Fault(101).name, "numbers": [101, 101], "text": text, "remedy": remedy}
    ]
    assert main(["explain", "trakking", "--json"]) == FAILED
    assert "did you mean tracking" in json.loads(capsys.readouterr().out)["hint"]


def test_a_number_without_end_is_not_found(refused: Command) -> None:
    assert "no such name or number" in refused("explain", "1" * 5000)


def test_a_table_gives_its_keys(capsys: pytest.CaptureFixture[str]) -> None:
    told = _told(capsys, "photodiode")
    assert all(option.path in told for option in options() if option.path.startswith("photodiode."))


def test_a_key_of_an_earlier_version_says_what_to_write(capsys: pytest.CaptureFixture[str]) -> None:
    assert "/dev/ttyUSB0@115200" in _told(capsys, "lidar.baud")


def test_faults_and_reasons_by_number(capsys: pytest.CaptureFixture[str]) -> None:
    text, remedy = FAULTS[next(code for code in FAULTS if code == 302)]
    told = _told(capsys, "fault", "302")
    assert text in told
    assert remedy in told
    assert told.count("\n\n") == 0
    assert REASONS[next(code for code in REASONS if code == 6)][0] in _told(capsys, "reason 6")


def test_a_bare_number_gives_all_that_it_stands_for(capsys: pytest.CaptureFixture[str]) -> None:
    told = _told(capsys, "202")
    assert "fault 202" in told
    assert "input register" in told


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["view"], "port"),
        (["foxglove"], "listen"),
        (["metrics"], "listen"),
        (["ros2"], "router"),
        (["fleet"], "router"),
        (["run"], None),
    ],
)
def test_a_port_says_who_uses_it(words: list[str], option: str | None, capsys: pytest.CaptureFixture[str]) -> None:
    default = Config().modbus.port if option is None else getattr(parser().parse_args(words), option)
    port = str(default[1] if isinstance(default, tuple) else default).rpartition(":")[2]
    told = _told(capsys, port)
    assert f"port {port}: " in told
    assert "changes it" in told
    if option is not None:
        assert f"`lumiloop {words[0]}`" in told


def test_a_register_in_the_middle_of_a_value_is_that_value(capsys: pytest.CaptureFixture[str]) -> None:
    assert "map_x" in _told(capsys, "register", "19")
    assert "acknowledge" in _told(capsys, "holding register", str(holding.COMMAND_ADDRESS + 8))


def test_every_register_of_the_document_is_explained(capsys: pytest.CaptureFixture[str]) -> None:
    rows = re.findall(r"^\| (\d+) \| `(\w+)` \|", (ROOT / "docs" / "modbus.md").read_text(), re.MULTILINE)
    numbers = [(int(number), name) for number, name in rows if int(number) >= 16]  # below also bits and functions
    assert {104, 200, 340, 354, 400, 1000, 1050, 1106} <= {number for number, _ in numbers}
    everything = list(entries())
    missing = [(number, name) for number, name in numbers if name not in names_of(number, everything)]
    assert missing == []
    assert "float32, m)" in _told(capsys, "register", "105")


def names_of(number: int, everything: list[Entry]) -> set[str]:
    """Names of the registers at an address."""
    return {entry.name for entry in find(f"register {number}", everything)}


def test_names_in_any_case(capsys: pytest.CaptureFixture[str]) -> None:
    assert "two solutions agree" in _told(capsys, "tracking")
    assert "weaker than expected here" in _told(capsys, "OCCLUDED")


def test_what_is_not_known_names_the_nearest(refused: Command) -> None:
    assert "sigma_yaw" in refused("explain", "sigma_jaw")
    assert "cycle.budget_ms" in refused("explain", "budget")
    for strange in ("99999", "nonsense"):
        assert "name a key" in refused("explain", strange)


def test_a_kind_alone_wants_its_number(capsys: pytest.CaptureFixture[str], refused: Command) -> None:
    for kind in ("register", "Input register"):
        example = refused("explain", kind).rpartition("as in: ")[2]
        assert example.startswith(f"{kind.lower()} ")
        assert _told(capsys, *example.split())


def test_what_the_documents_show_below_is_named_by_what_to_ask(capsys: pytest.CaptureFixture[str]) -> None:
    assert "lumiloop explain bit NUMBER" in _told(capsys, "flags")
    assert "lumiloop explain link use NUMBER" in _told(capsys, "link_1_use")
    assert not any("see below" in entry.text.lower() for entry in entries())


def test_every_published_number_has_its_words() -> None:
    assert set(STATES) == set(State)
    assert set(FIXES) == set(LightFix)
    assert set(USES) == set(LinkUse)
    assert set(LOOPS) == set(LoopReason)
    assert set(COMMANDS) == set(holding.CommandCode)


@pytest.mark.parametrize("table", [State, Reason, Fault, LightFix, LinkUse, LoopReason, Part, Thread, Stage])
def test_every_name_that_status_shows_is_explained(table: type[IntEnum]) -> None:
    everything = list(entries())
    kind = {"LightFix": "light fix", "LinkUse": "link use", "LoopReason": "loop reason", "Part": "component"}
    wanted = kind.get(table.__name__, table.__name__.lower())
    shown = [member for member in table if member.value or table is not Fault]
    assert [one.name for one in shown if not find(f"{wanted} {one.name}", everything)] == []


def test_every_entry_can_be_asked_for() -> None:
    everything = list(entries())
    for entry in everything:
        assert entry in find(f"{entry.kind} {entry.name}", everything)
        for number in entry.numbers:
            assert entry in find(f"{entry.kind} {number}", everything)
