"""`lumiloop check`: a good file, a bad survey, and a bus that is not here."""

import os
from pathlib import Path

import pytest

from daemon.cli import parser
from daemon.diagnosis import map_folder
from daemon.maps.store import Store
from daemon.system import console
from daemon.system.folder_lock import FolderLock
from tests.commands import Command
from tests.daemon.support.map_maker import Shape, content

SURVEY = """
lamp = [
  { lamp_id = 1, code = 5, x = 0.0, y = 0.0, z = 2.6 },
  { lamp_id = 2, code = 17, x = 2.5, y = 0.0, z = 2.6 },
]
"""


def write(folder: Path, survey: str = SURVEY, bus: str = "/dev/i2c-99") -> Path:
    (folder / "lights.toml").write_text(survey)
    file = folder / "robot.toml"
    file.write_text(f'[photodiode]\nbus = "{bus}"\n[lights]\nsurvey = "lights.toml"\n')
    return file


def test_all_good_but_the_bus_is_elsewhere(tmp_path: Path, done: Command) -> None:
    file = write(tmp_path)
    good, survey, bus, _ = done("check", str(file)).splitlines()
    assert good == f"{file}: good"
    assert survey == f"{tmp_path.resolve() / 'lights.toml'}: valid, 2 lamps"
    assert bus.startswith("from this computer, /dev/i2c-99: ")


@pytest.mark.parametrize(
    ("survey", "words"),
    [
        ("lamp = [ { lamp_id = 1, cod = 5, x = 0.0, y = 0.0, z = 2.6 } ]", "did you mean `code`?"),
        (SURVEY.replace("lamp_id = 2", "lamp_id = 1"), "lights.toml:4: lamp 1: another lamp has this `lamp_id`"),
        ("lamp", "not valid TOML"),
    ],
)
def test_a_bad_survey_is_refused_with_its_place(
    tmp_path: Path, survey: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write(tmp_path, survey)
    for command in (["check", str(file)], ["run", "--config", str(file), "--set", "modbus.port=0"]):
        assert parser.main(command) == console.USAGE
        said = capsys.readouterr()
        if command[0] == "check":
            assert words in said.err
            assert "Traceback" not in said.err


@pytest.mark.parametrize(("code", "profile", "last"), [(129, "A", 128), (65, "B", 64), (513, "D", 512)])
def test_a_code_that_the_profile_does_not_have_is_refused(
    tmp_path: Path, code: int, profile: str, last: int, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, expected in ((last, console.OK), (code, console.USAGE)):
        file = write(tmp_path, SURVEY.replace("code = 17", f"code = {number}"))
        assert parser.main(["check", str(file), "--set", f"photodiode.profile={profile}"]) == expected
    said = capsys.readouterr().err
    assert "lights.toml:4: " in said
    assert str(last) in said


def test_all_that_is_wrong_is_told_in_one_round(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The configuration, the survey that it names, and the map that it asks for."""
    bad = SURVEY.replace("code = 5", "code = 5000").replace("z = 2.6", "z = 900", 1)
    file = write(tmp_path, bad, bus="i2c-1")
    maps = tmp_path / "maps"
    with file.open("a") as more:
        more.write(f'[modbus]\nprt = 3\n[map]\nfolder = "{maps}"\nlocalise = true\n')
    assert parser.main(["check", str(file), "--set", "odometry.port=x"]) == console.USAGE
    said = capsys.readouterr().err
    assert [
        line.replace(f"{tmp_path.resolve()}/", "").removeprefix("lumiloop: ").split(": ")[0]
        for line in said.splitlines()
    ] == [
        "robot.toml:2",
        "robot.toml:6",
        "--set odometry.port=x",
        "lights.toml:3",
        "lights.toml:3",
        "maps",
    ]
    (tmp_path / "lights.toml").unlink()
    assert parser.main(["check", str(file)]) == console.USAGE
    assert "lights.toml: no such survey" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "silent"),
    [("profile = 'C'", "is not in profile"), ("profile = 'A'\n[lights]\nsurvey = 3", "is none of")],
)
def test_what_hangs_on_a_wrong_key_is_not_judged(
    tmp_path: Path, line: str, silent: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "lights.toml").write_text(SURVEY.replace("code = 17", "code = 400"))
    file = tmp_path / "robot.toml"
    file.write_text(
        f"lights.survey = 'lights.toml'\n[photodiode]\n{line}\n" if "lights" not in line else f"[photodiode]\n{line}\n"
    )
    assert parser.main(["check", str(file)]) == console.USAGE
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert silent not in said


def test_a_survey_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path)
    (tmp_path / "lights.toml").unlink()
    assert parser.main(["check", str(file)]) == console.USAGE
    assert "lights.toml: no such survey" in capsys.readouterr().err


def test_the_line_that_names_a_bad_survey_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path)
    (tmp_path / "lights.toml").unlink()
    assert parser.main(["check", str(file)]) == console.USAGE
    assert f"({file}:4 names it with `lights.survey`)" in capsys.readouterr().err
    assert parser.main(["check", str(file), "--set", f"lights.survey={tmp_path}/none.toml"]) == console.USAGE
    assert "none.toml: no such survey" in (said := capsys.readouterr().err)
    assert "(`lights.survey` names it)" in said


def test_a_survey_that_nothing_looks_at_is_remarked(tmp_path: Path, done: Command) -> None:
    file = write(tmp_path, bus="")
    assert "the survey is not used, because `photodiode.bus` is empty" in done("check", str(file))


@pytest.mark.parametrize(
    ("mount", "remark"),
    [
        ("x = 20.0", "`lidar.mount.x` = 20: check the unit, metres from the robot's centre"),
        ("yaw = 1.5708", "`lidar.mount.yaw` = 1.5708: check the unit, degrees; as radians it would be 90 degrees"),
        ("yaw = -3.1416", "`lidar.mount.yaw` = -3.1416: check the unit, degrees; as radians it would be -180 degrees"),
        ("y = 4.9, yaw = 1.5", ""),
        ("yaw = 90.0", ""),
    ],
)
def test_a_mount_in_other_units_is_remarked(mount: str, remark: str, tmp_path: Path, done: Command) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(f'map.folder = "none"\nlidar.mount = {{ {mount} }}\n')
    assert done("check", str(file)).splitlines()[1:] == ([remark] if remark else [])


def test_a_folder_that_cannot_be_made(tmp_path: Path, done: Command) -> None:
    file = tmp_path / "robot.toml"
    file.write_text('map.folder = "/proc/maps"\n')
    assert "/proc/maps: this user cannot create the folder" in done("check", str(file))


def test_the_folder_of_maps_is_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maps, file = tmp_path / "maps", tmp_path / "robot.toml"
    file.write_text(f'[map]\nfolder = "{maps}"\n')

    def said(*more: str, code: int = console.OK) -> str:
        assert parser.main(["check", str(file), *more]) == code
        words = capsys.readouterr()
        return words.out + words.err

    alone = ("--set", "map.localise=true")
    assert f"{maps}: the folder does not exist yet" in said()
    assert "so `run` cannot start" in said(*alone, code=console.FAILED)
    Store(maps).save(whole := content(Shape(submaps=3, map_id=7)), 7)
    assert f"{maps}: map 00000007 (second floor, Süd) of 3 submaps is valid" in said(*alone)
    (maps / "map-00000007-00000002.lumimap").write_bytes(whole[:-1])
    assert f"{maps}: map 00000007 (second floor, Süd) of 3 submaps is valid" in said(), "the generation before it"
    (maps / "map-00000007-00000001.lumimap").unlink()
    assert f"{maps}: no map in it can be used" in said()
    assert [path.name for path in maps.glob("*.lumimap*")] == ["map-00000007-00000002.lumimap"], "nothing is moved"


def test_a_lock_of_the_same_number_on_another_disk_is_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, listed = tmp_path / "maps", tmp_path / "locks"
    folder.mkdir()
    about = folder.stat()
    line = "1: FLOCK  ADVISORY  WRITE {} {:02x}:{:02x}:{} 0 EOF\n"
    place = (os.major(about.st_dev), os.minor(about.st_dev))
    foreign = line.format(11, place[0] + 1, place[1], about.st_ino)
    monkeypatch.setattr(map_folder, "LOCKS", listed)
    lock = FolderLock(folder)
    lock.take()
    listed.write_text(foreign)
    assert map_folder._keeper(folder) == "another process"
    listed.write_text(foreign + line.format(22, *place, about.st_ino))
    assert map_folder._keeper(folder) == "process 22"
    lock.close()
    assert map_folder._keeper(folder) == ""


def test_a_folder_that_another_daemon_has_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maps, file = tmp_path / "maps", tmp_path / "robot.toml"
    file.write_text(f'[map]\nfolder = "{maps}"\n')
    other = Store(maps)
    other.claim()

    def said(*more: str) -> str:
        assert parser.main(["check", str(file), *more]) == console.OK
        return capsys.readouterr().out

    words = f"; process {os.getpid()} stores its maps there, so a second daemon would report fault 403"
    assert f"{maps}: no map in it yet{words}" in said()
    other.save(content(Shape(submaps=3, map_id=7)), 7)
    assert f"of 3 submaps is valid{words}" in said()
    assert "fault 403" not in said("--set", "map.localise=true"), "nothing is kept then"
    other.close()
    assert "fault 403" not in said()
    maps.chmod(0o555)
    assert ("fault 403" in said()) is (os.geteuid() != 0), "root may write everywhere"
