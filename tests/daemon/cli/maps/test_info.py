"""``lumiloop map info`` and ``map verify``: what they say, and that they load no compiler."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.cli import parser
from daemon.config import paths
from daemon.config.schema import Config
from daemon.maps import edit
from daemon.system import console
from taps.fleet.placing import MAP, RECORD, Records, target_path
from tests.commands import Command
from tests.daemon.support.map_maker import Shape, content

ROOT = Path(__file__).parents[4]


def test_info_says_what_a_file_holds(tmp_path: Path, done: Command) -> None:
    path = tmp_path / "a.lumimap"
    path.write_bytes(content(Shape(lit=True, submaps=7, loose=1)))
    said = done("map", "info", str(path))
    for words in ("map id            00001234", "second floor, Süd", "the light survey's", "2017-07-14 02:40:00 UTC"):
        assert words in said
    found = json.loads(done("map", "info", str(path), "--json"))
    assert (found["submaps"], found["isolated_submaps"], found["lamps"]) == (6, 1, 6)
    assert found["bytes"] == path.stat().st_size


def test_info_lists_the_maps_of_a_folder_newest_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], done: Command, refused: Command
) -> None:
    first, second = (tmp_path / f"map-00001234-0000000{number}.lumimap" for number in (1, 2))
    other = tmp_path / "placed.lumimap"
    for path in (first, second):
        path.write_bytes(content())
    other.write_bytes(content(Shape(map_id=0x77)))
    for words in (["--set", f"map.folder={tmp_path}"], [str(tmp_path)]):
        head, *rows = done("map", "info", *words).splitlines()
        assert head.split() == ["map", "id", "saved", "submaps", "name", "file"]
        assert [row.split()[0] for row in rows] == ["00001234", "00000077"]
        assert rows[0].endswith(str(second)), "the newest file of a map"
        assert "second floor, Süd" in rows[1]
    assert [one["map_id"] for one in json.loads(done("map", "info", str(tmp_path), "--json"))["maps"]] == [0x1234, 0x77]
    other.write_bytes(b"nothing")
    assert parser.main(["map", "info", str(tmp_path)]) == console.FAILED
    out, err = capsys.readouterr()
    assert "00001234" in out
    assert "placed.lumimap: " in err
    assert "no map" in done("map", "info", "--set", f"map.folder={tmp_path / 'none'}")
    assert parser.main(["map", "info", "--set", "map.folder=none"]) == console.USAGE
    assert "maps are not stored" in capsys.readouterr().err
    os.mkfifo(tmp_path / "waits.lumimap")
    assert "waits.lumimap: cannot read the map: it is a FIFO" in refused("map", "info", str(tmp_path))


def test_the_maps_of_the_service_are_meant_where_this_user_keeps_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    """As with sudo beside the service: else an imported map would lie in root's own folder, which no daemon reads."""
    monkeypatch.setattr(paths, "SERVICE_STATE", tmp_path / "service")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    own, service = tmp_path / "state" / "lumiloop" / "maps", tmp_path / "service" / "maps"
    assert paths.stored_maps("") == own, "there is no service"
    service.mkdir(parents=True)
    assert paths.stored_maps("") == service
    assert paths.stored_maps("/maps") == Path("/maps")
    assert edit.keep(Config(), content(), 0x1234).parent == service == target_path(MAP, Config(), None)
    assert Records().path == tmp_path / "service" / RECORD, "where the service of the fleet reads it"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lumiloop.toml").write_text("")
    assert str(service) in done("map", "info")
    own.mkdir(parents=True)
    assert paths.stored_maps("") == own
    assert paths.maps_folder("") == own, "the daemon's own rule is unchanged"


def test_verify_says_of_each_file_whether_it_is_good(tmp_path: Path, done: Command, refused: Command) -> None:
    good, bad, torn = (tmp_path / f"{name}.lumimap" for name in ("good", "bad", "torn"))
    good.write_bytes(content())
    bad.write_bytes(content()[:-1])
    torn.write_bytes(content(Shape(submaps=8, loose=2)))
    said = done("map", "verify", str(good), str(torn))
    assert f"{good}: valid, map 00001234\n" in said
    assert "2 submaps without an edge to the others" in said
    said = refused("map", "verify", str(good), str(bad), str(tmp_path / "none"))
    assert f"{bad}: it is" in said
    assert "truncated" in said
    assert "none: cannot read the map: No such file or directory" in said
    assert parser.main(["map", "info", str(bad)]) == console.FAILED


def test_no_compiler_is_loaded_for_it(tmp_path: Path) -> None:
    path = tmp_path / "a.lumimap"
    path.write_bytes(content())
    code = (
        "import sys; from daemon.cli import parser\n"
        f"assert parser.main(['map', 'info', {str(path)!r}]) == 0\n"
        f"assert parser.main(['map', 'verify', {str(path)!r}]) == 0\n"
        "assert not {'numba', 'llvmlite', 'scipy'} & set(sys.modules), 'a compiler was loaded'"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=60.0)
