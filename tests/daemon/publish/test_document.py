"""The pages under docs/ are what the tables say now."""

import re
import struct
from pathlib import Path

import pytest

from daemon.publish import document
from daemon.publish.modbus import registers
from daemon.publish.modbus.holding import CommandCode, Holding, Request

ROOT = Path(__file__).parents[3]
DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.parametrize("name", sorted(document.pages()))
def test_page_is_current(name: str) -> None:
    remedy = "run `python -m daemon.publish.document`"
    assert (DOCS / name).read_text() == document.pages()[name], f"docs/{name} is out of date: {remedy}"


def test_every_point_is_documented_where_it_is() -> None:
    """Addresses in the pages are found again in encoded bytes, not only copied from the same offsets."""
    modbus, udp = document.modbus_page(), document.udp_page()
    for offset, point in zip(registers.BODY.offsets, registers.BODY.points, strict=True):
        assert f"| {2 + offset} | `{point.name}` | {point.wire.name} |" in modbus
        assert f"| {8 + 2 * offset} | `{point.name}` | {point.wire.name} |" in udp
    for number, mirrored in enumerate(registers.MIRROR):
        assert f"| {102 + 2 * number} | `{mirrored.name}` | float32 |" in modbus


def test_the_lines_of_mbpoll_give_every_order() -> None:
    """Each is carried out as mbpoll would: 16-bit words, or with `-t 4:int -B` 32-bit ones, high word first."""
    given: list[Request] = []
    holding = Holding(given.append, lambda _: None)
    page = document.modbus_page()
    for kind, address, values in re.findall(
        r"^ +mbpoll -m tcp .*-t 4(\S*)(?: -B)? -0 -r (\d+) HOST ([^#\n]+)", page, re.M
    ):
        numbers = [int(value, 0) for value in values.replace("--", "").split()]
        holding.write(int(address), struct.pack(f">{len(numbers)}{'i' if kind == ':int' else 'H'}", *numbers))
    assert [request.code for request in given] == list(CommandCode)
    assert given[0].pose == (1.5, -2.0, 1.570796)
    assert given[-1].map_id == 0x1A2B3C4D


def test_every_line_of_mbpoll_counts_from_0() -> None:
    pages = {path: path.read_text() for path in [ROOT / "README.md", *DOCS.rglob("*.md")]}
    lines = {(path.name, line) for path, text in pages.items() for line in re.findall(r"mbpoll [^`\n]*", text)}
    asking = {(page, line) for page, line in lines if " -r " in line}
    assert len(asking) > 10
    assert not {(page, line) for page, line in asking if " -0 " not in line}


def test_the_words_of_set_pose_are_those_of_the_command_block() -> None:
    """`docs/control.md` has them for mbpoll."""
    page = (DOCS / "control.md").read_text()
    line = r"-r 1000 \S+ ([\d ]+)\n +# request (\d): SET_POSE to x (\S+) m, y (\S+) m, yaw (\S+) rad"
    ((told, number, x, y, yaw),) = re.findall(line, page)
    words = struct.pack(">8H", *map(int, told.split()))
    request, command, *pose = struct.unpack(">HHiii", words)
    assert (request, command) == (int(number), CommandCode.SET_POSE)
    assert pose == [round(1e4 * float(x)), round(1e4 * float(y)), round(1e6 * float(yaw))]
    ((command, name),) = re.findall(r"-r 1000 \S+ 1 (\d+) +# request 1: (\w+)", page)
    assert CommandCode[name] == int(command)


def test_writing_makes_the_pages(tmp_path: Path) -> None:
    document.write(tmp_path / "new")
    assert {path.name for path in (tmp_path / "new").iterdir()} == set(document.pages())


@pytest.mark.parametrize(("words", "code"), [(["--help"], 0), (["--nothing-of-the-kind"], 2)])
def test_asking_for_help_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], code: int
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["document", *words])
    with pytest.raises(SystemExit) as ended:
        document.main()
    assert ended.value.code == code
    assert list(tmp_path.iterdir()) == []
