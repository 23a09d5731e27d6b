"""The pages under docs/ are what the tables say now."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.publish import document
from daemon.publish.modbus import registers

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
