"""`lumiloop why`: the command with real recordings, what it says of them and draws, and what it refuses."""

import errno
import json
import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from daemon.cli import parser
from daemon.config import paths
from daemon.diagnosis.moment import Moment
from daemon.integrity.motion_consistency import MotionComparison
from daemon.recording import disk_writer, flight_recorder
from daemon.recording.disk_writer import SegmentWriter
from daemon.recording.retention import DUMP
from daemon.system import console
from daemon.system.versions import build
from estimator.mapping.occupancy_grid import Grid
from hal.odometry import RawOdometry
from hal.replay.recording import Kind
from tests.commands import Command
from tests.daemon.replay.test_dump import let_write, unplugged
from tests.daemon.replay.test_recorded_run import Bench, aged, pulled, record

AT = datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC).timestamp()
ZONE = f"{datetime.fromtimestamp(AT, UTC).astimezone():%z}"


def test_what_the_service_records_is_looked_for_where_we_have_recorded_nothing(
    tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "ours"))
    monkeypatch.setattr(paths, "SERVICE_STATE", tmp_path / "service")
    said = refused("why", "3")
    assert f"no recording was found in {tmp_path}/ours/flight or " in said
    assert f"--record {tmp_path}/ours/flight --last 10" in said
    (tmp_path / "service" / "flight").mkdir(parents=True)
    assert f"{tmp_path}/service/flight: holds no recording" in refused("why", "3")
    (tmp_path / "ours" / "flight").mkdir(parents=True)
    assert f"{tmp_path}/ours/flight: holds no recording" in refused("why", "3")


@pytest.mark.parametrize("named", [True, False])
def test_a_recording_that_is_not_open_to_this_user_is_said_to_be_so(
    named: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service's folder is its own; tests may run as root, to whom all is open, so the system's answer is played."""
    service = tmp_path / "service"
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "ours"))
    monkeypatch.setattr(paths, "SERVICE_STATE", service)
    stat = Path.stat

    def closed(path: Path, **how: bool) -> os.stat_result:
        if service in path.parents:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat(path, **how)

    monkeypatch.setattr(Path, "stat", closed)
    assert parser.main(["why", "3", *([str(service / "flight")] if named else [])]) == 1
    assert f"{service}/flight: cannot be read by this user (run this with sudo" in capsys.readouterr().err


@pytest.mark.parametrize(("wheels_m", "turn", "agree"), [(1.0, 0.0, True), (0.65, 0.0, False), (1.0, 0.4, False)])
def test_witnesses_agree_within_slip(wheels_m: float, turn: float, agree: bool) -> None:
    told = MotionComparison(2.0, np.array((1.0, 0.0, 0.0)), np.array((wheels_m, 0.0, turn)))
    assert told.agree is agree
    assert told.apart == pytest.approx((abs(1.0 - wheels_m), turn))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("why") / "rec"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(disk_writer, "WRITE_S", 0.002)
        patch.setattr(flight_recorder, "LEAST_S", 2.0)
        record(folder, unplugged, keep_s=60.0)
    return folder


def asked(words: str, folder: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert parser.main(["why", words, str(folder), *options]) == console.OK
    return capsys.readouterr().out


def test_a_lidar_that_is_gone(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (dump,) = recorded.glob(f"{DUMP}*-fault-101")
    said = asked("9", dump, capsys)
    assert "NO_LIDAR since" in said
    assert "lidar    no data for 5.1 s; before: " in said
    assert "x       UNKNOWN since" in said
    assert "TRACKING: the pose is confirmed" in said
    assert "NO_LIDAR: reason 3, the lidar cannot be opened" in said
    assert "the replay" not in said


def test_what_was_published_is_shown_with_its_faults_at_their_own_times(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As Modbus and the journal had it: the lidar cannot be opened, and a beat later it is a fault."""
    (dump,) = recorded.glob(f"{DUMP}*-fault-101")
    head, state, fault, *rest = asked("2023-11-14T22:13:25Z", dump, capsys).splitlines()
    at = fault.split(" since ")[1].split(": ")[0]
    assert f"the whole second: first change of state, reason or faults in it, cycle of {at}" in head
    assert "NO_LIDAR since" in state
    assert ": reason 3, the lidar cannot be opened (" in state
    assert at not in state, "it came later"
    assert fault.startswith("fault 101 since ")
    assert "no lidar is found (check power" in fault
    assert f"  {at}  fault 101 comes: no lidar is found" in rest


def test_a_fault_that_is_over_is_told_too(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (ring,) = (path for path in recorded.iterdir() if not path.name.startswith(DUMP))
    changes = asked("2023-11-14T22:13:38Z", ring, capsys).splitlines()
    (over,) = (line.split()[0] for line in changes if "fault 101 is over" in line)  # the attempts to open decide when
    said = asked(f"2023-11-14T22:13:{over[6:8]}Z", ring, capsys)
    assert "first change of state, reason or faults in it" in said.splitlines()[0]
    assert "fault 101 since" not in said
    assert "fault 101 is over: no lidar is found" in said


def test_of_an_older_recording_it_is_said_what_is_not_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "rec", pulled)
    aged(tmp_path / "rec")
    said = asked("6.5", tmp_path / "rec", capsys)
    assert "NO_LIDAR since" in said
    assert "reason 4, no valid scan" in said
    assert "(the recording has no published reason and faults; the reason is the replay's" in said
    assert "\nfault " not in said


def test_a_recording_of_another_build_is_said_to_be_one(
    recorded: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (dump,) = recorded.glob(f"{DUMP}*-fault-101")
    assert "recorded with" not in asked("9", dump, capsys)
    built = build()
    monkeypatch.setattr("daemon.system.versions.build", lambda: "of today")
    made = next(line for line in asked("9", dump, capsys).splitlines() if line.startswith("recorded with"))
    assert (
        made == f"recorded with build {built}; this is build of today, so the replay may differ from the recorded run"
    )


def test_a_whole_second_is_of_the_first_change_in_it(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As the journal says when it came; an instant is the cycle in force then."""
    (dump,) = recorded.glob(f"{DUMP}*-fault-101")
    silent = next(line for line in asked("9", dump, capsys).splitlines() if "NO_LIDAR since" in line)
    at = silent.split(" since ")[1].split(": ")[0]
    second, fraction = at.split(".")
    assert int(fraction) > 0, "else nothing is shown here"
    said = asked(second, dump, capsys)
    assert "lidar    no data for 0." in said, "as published, however short it is"
    head, state = said.splitlines()[:2]
    assert f"{second}{ZONE}, the whole second: first change of state, reason or faults in it, cycle of {at}" in head
    assert state == silent
    head, state = asked(f"{second}.0", dump, capsys).splitlines()[:2]
    assert f"{second}.000{ZONE}, cycle of" in head
    assert state.startswith("TRACKING since")
    assert (
        "the whole second: no change of state, reason or faults in it, cycle of"
        in asked("9", dump, capsys).splitlines()[0]
    )


def test_a_time_that_it_has_printed_means_the_same_cycle(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (dump,) = recorded.glob(f"{DUMP}*-fault-101")
    said = asked("9", dump, capsys)
    printed = {line.split()[0] for line in said.partition("what changed")[2].splitlines()[1:]}
    assert len(printed) > 2
    for at in printed:
        assert f"{at}{ZONE}, cycle of {at}, " in asked(at, dump, capsys).splitlines()[0]


def test_a_run_where_all_is_well_from_a_folder_of_several(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = asked("2023-11-14T22:13:23Z", recorded, capsys)
    assert "TRACKING since" in said
    assert "lidar    matches" in said
    assert "odometry agrees with the lidar" in said
    assert "heading known since" in said


def test_it_is_drawn(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    asked("9", recorded, capsys, "--out", str(tmp_path / "why.png"))
    with Image.open(tmp_path / "why.png") as image:
        assert min(image.size) > 700


@pytest.mark.parametrize(("ending", "begin"), [(".svg", b"<?xml"), (".PDF", b"%PDF")])
def test_it_is_drawn_as_its_ending_says(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], ending: str, begin: bytes
) -> None:
    asked("9", recorded, capsys, "--out", str(tmp_path / f"why{ending}"))
    assert (tmp_path / f"why{ending}").read_bytes().startswith(begin)


def test_a_picture_that_cannot_be_had_is_refused_before_anything_is_replayed(
    recorded: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    refused: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("daemon.cli.why.moments", lambda *_: pytest.fail("replayed"))
    with pytest.raises(SystemExit) as ended:
        parser.main(["why", "9", str(recorded), "--out", "why.xyz"])
    assert ended.value.code == console.USAGE
    assert "why.xyz: unknown image format; use a name that ends with .png, .svg, .pdf" in capsys.readouterr().err
    (tmp_path / "file").touch()
    (tmp_path / "folder.png").mkdir()
    for name, problem in (
        ("file/why.png", "is a file; name a folder"),
        ("folder.png", "is a folder; name a file in it"),
    ):
        assert parser.main(["why", "9", str(recorded), "--out", str(tmp_path / name)]) == console.FAILED
        assert problem in capsys.readouterr().err
    (tmp_path / "closed").mkdir()
    for name in (f"{248 * 'a'}.png", f"{300 * 'a'}.png"):  # of the first only that beside it is too long
        assert parser.main(["why", "9", str(recorded), "--out", str(tmp_path / name)]) == console.FAILED
        assert f"cannot write {tmp_path / name}: File name too long; name another file" in capsys.readouterr().err
    is_dir = Path.is_dir

    def closed(path: Path) -> bool:
        if path.parent.name == "closed":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return is_dir(path)

    with monkeypatch.context() as there:  # tests may run as root, to whom all is open
        there.setattr(Path, "is_dir", closed)
        assert parser.main(["why", "9", str(recorded), "--out", str(tmp_path / "closed" / "why.png")]) == console.FAILED
    assert f"cannot write {tmp_path}/closed/why.png: Permission denied; name another file" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["closed", "file", "folder.png"], "nothing stays"
    assert not list((tmp_path / "closed").iterdir())
    monkeypatch.setattr("daemon.cli.why.find_spec", lambda name: None)
    assert "plots need matplotlib" in refused("why", "9", str(recorded), "--out", str(tmp_path / "why.png"))


def test_for_a_time_that_is_none_no_folder_is_made(recorded: Path, tmp_path: Path, refused: Command) -> None:
    assert "not a time" in refused("why", "nonsense", str(recorded), "--out", str(tmp_path / "by" / "typo" / "a.png"))
    assert not list(tmp_path.iterdir())


def test_the_picture_is_of_the_cycle_that_is_told(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An instant is its own; a second, and a time that was printed and cut, are those of their cycle."""
    drawn: list[float] = []

    def draw(told: list[Moment], utc: float, grid: Grid, kind: str) -> bytes:
        drawn.append(utc)
        return kind.encode()

    monkeypatch.setattr("daemon.diagnosis.moment_plot.draw", draw)
    (dump,) = recorded.glob(f"{DUMP}*-fault-101")
    out = ("--out", str(tmp_path / "why.png"))
    for words in ("2023-11-14T22:13:25Z", "2023-11-14T22:13:25.000Z"):
        head = asked(words, dump, capsys, *out).splitlines()[0]
        at = head.split("cycle of ")[1].partition(",")[0]
        seconds = float(at.rpartition(":")[2])
        assert drawn.pop() - AT + 20.0 == pytest.approx(max(25.0, seconds), abs=1e-3)
    assert seconds < 25.0, "of the instant the cycle before"
    asked(f"2023-11-14T22:13:{seconds:06.3f}Z", dump, capsys, *out)
    assert drawn.pop() - AT + 20.0 == pytest.approx(seconds, abs=1e-3)


@pytest.mark.parametrize("lost", [{"t_utc": None}, {"t_mono": "soon"}, {"t_utc": float("nan")}, {"t_utc": 1e300}])
def test_a_recording_whose_head_says_no_time_is_named_and_passed_over(
    tmp_path: Path, refused: Command, lost: dict[str, object]
) -> None:
    """Records come a second apart; the second recording is whole."""
    for name, header in (("bad", lost), ("good", {})):
        writer = SegmentWriter(tmp_path, name, {"recording": name, "t_mono": 5.0, "t_utc": AT, **header})
        writer.put(Kind.RX, 0, 6.0, b"abc")
        writer.close()
    said = refused("why", "3600", str(tmp_path / "bad"))
    assert "bad: its head" in said
    assert "lumiloop replay" in said
    said = refused("why", "3600", str(tmp_path))
    assert "ignored" in said
    assert "available" in said


async def slipping(bench: Bench) -> None:
    """Wheels that turn on the spot for a while."""
    put, ahead = bench.put_odometry, 0.0

    def slip(reading: RawOdometry) -> None:
        nonlocal ahead
        ahead += 0.02
        put(RawOdometry(reading.t_rx, reading.t_mono, reading.x + ahead, reading.y, reading.yaw))

    await bench.drive(4.0)
    let_write(0.02)
    bench.put_odometry = slip
    await bench.drive(4.0)


def test_wheels_that_slip_dissent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "rec", slipping)
    said = asked("7.5", tmp_path / "rec", capsys)
    assert "odometry DISAGREES: in" in said
    assert "odometry begins to disagree" in said
    assert "odometry and lidar disagree about the motion" in said


@pytest.mark.parametrize("named", ["nowhere", "nowhere/at/all"])
def test_a_folder_that_is_not_there_is_said_to_be_none(named: str, tmp_path: Path, refused: Command) -> None:
    said = refused("why", "3", str(tmp_path / named))
    assert f"{tmp_path / named}: no such folder (name a recording, a dump, or a folder of several)" in said


def test_a_program_reads_the_same(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (dump,) = recorded.glob(f"{DUMP}*-fault-101")
    told = json.loads(asked("2023-11-14T22:13:25Z", dump, capsys, "--json"))
    assert (told["schema"], told["state"]) == ("lumiloop.why/1", "NO_LIDAR")
    assert told["asked"]["time"] == "2023-11-14T22:13:25.000+00:00"
    assert told["reason"]["number"] == 3
    assert [fault["number"] for fault in told["faults"]] == [101]
    assert told["known"]["x"] in (True, False)
    assert told["witnesses"]["laser"]["points"] > 0
    assert any(change["published"] and "fault 101 comes" in change["text"] for change in told["changes"])
    assert all(change["time"].endswith("+00:00") for change in told["changes"])
