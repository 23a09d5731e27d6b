"""A running daemon recorded as MCAP."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from daemon.cli import parser
from daemon.publish.stream.server import framed
from daemon.system import console

pytest.importorskip("rosbags", reason="pip install 'lumiloop[mcap]'")
from mcap.reader import make_reader

from taps.mcap import writer
from taps.ros.messages import TOPICS
from tests.taps.mcap.test_mcap import messages
from tests.taps.serving import served


def record(path: Path, out: Path, *words: str) -> int:
    return parser.main(["record-mcap", str(out), "--stream", str(path), "--seconds", "1.2", *words])


def test_all_that_a_daemon_tells_is_in_the_file(tmp_path: Path) -> None:
    with served(tmp_path / "s"):
        assert record(tmp_path / "s", tmp_path / "a.mcap", "--raw") == console.OK
    told = messages(tmp_path / "a.mcap")
    assert set(told) == set(TOPICS)
    assert 15 < len(told["/pose"]) < 80
    (_, lights) = told["/lumiloop/lights"][0]
    assert [(link.code, link.lamp_id) for link in lights.links] == [(5, 12), (6, -1)]
    (_, grid) = told["/map"][0]
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == pytest.approx((0.0, -6.4))
    cells = grid.data.reshape(grid.info.height, grid.info.width)
    np.testing.assert_array_equal(cells[:, 0], 100)
    np.testing.assert_array_equal(cells[:, 1:], 0)
    faults = [s.name for _, m in told["/diagnostics"] for s in m.status if s.name.startswith("lumiloop: fault")]
    assert set(faults) == {"lumiloop: fault 104"}
    (stamp, pose) = told["/pose"][0]
    assert 1.7e9 < pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec < 1.7e9 + 60
    assert stamp == pose.header.stamp.sec * 10**9 + pose.header.stamp.nanosec


def test_what_is_there_stays_and_nobody_is_waited_for_in_vain(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.mcap").write_bytes(b"precious")
    assert record(tmp_path / "s", tmp_path / "a.mcap") == console.USAGE
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"
    assert record(tmp_path / "s", tmp_path / "b.mcap") == console.FAILED
    assert record(tmp_path / "s", tmp_path / "none" / "b.mcap") == console.USAGE
    said = capsys.readouterr().err
    assert "replace it with --force" in said
    assert "check that the daemon runs" in said
    assert ": no folder" in said


def test_nothing_told_leaves_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The service keeps so many files: those of hours without a daemon would push out those of its last drives."""
    assert record(tmp_path / "s", tmp_path / "a.mcap") == console.FAILED
    with other_version(tmp_path / "t"):
        assert record(tmp_path / "t", tmp_path / "b.mcap") == console.FAILED
    said = capsys.readouterr().err
    assert "no data were received, so no file was written; check that the daemon runs" in said
    assert "install both from the same release" in said
    assert not list(tmp_path.glob("*.mcap"))
    assert record(tmp_path / "s", Path("/dev/null"), "--force") == console.FAILED
    assert Path("/dev/null").exists()


@contextmanager
def other_version(path: Path) -> Iterator[None]:
    """Somebody who speaks another version of the stream."""
    hello = framed({"topic": "hello", "schema": 99, "name": "agv", "pid": 1, "topics": {}})
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()

        def greet() -> None:
            with listening.accept()[0] as client:
                client.sendall(hello)
                client.recv(1)

        greeting = threading.Thread(target=greet, daemon=True)
        greeting.start()
        yield
        greeting.join(5.0)


def test_a_disk_is_not_filled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot needs room for its maps: the recorder stops before, and what it has written is a whole file."""
    out, room = tmp_path / "a.mcap", iter([300, 300, 300, 300, 199])
    monkeypatch.setattr(writer, "free_bytes", lambda folder: next(room, 199) << 20)
    with served(tmp_path / "s"):
        assert record(tmp_path / "s", out, "--seconds", "20") == console.FAILED
    said = capsys.readouterr().err
    assert f"{out}: stopped, only 199 MB are free there (--reserve requires 200): " in said
    assert "the file is complete up to here" in said
    with out.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None, "there is an index"
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(map(len, messages(out).values())) > 10


def test_without_room_no_file_is_begun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.mcap"
    out.write_bytes(b"precious")
    with served(tmp_path / "s"):
        assert record(tmp_path / "s", out, "--force", "--reserve", "1e9") == console.FAILED
    assert "--reserve" in capsys.readouterr().err
    assert out.read_bytes() == b"precious"


def test_a_folder_that_is_not_there_is_named_before_any_daemon_is_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert record(tmp_path / "s", tmp_path / "none" / "a.mcap", "--seconds", "2") == console.USAGE
    assert f"no folder {tmp_path / 'none'}; create it" in capsys.readouterr().err


@pytest.mark.parametrize("seconds", ["-1", "0", "nan"])
def test_a_time_that_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: str) -> None:
    """It had been taken for no time at all, and recorded for ever."""
    with pytest.raises(SystemExit):
        record(tmp_path / "s", tmp_path / "a.mcap", "--seconds", seconds)
    assert f"{seconds} s: out of range; give more than 0" in capsys.readouterr().err


def test_a_disk_that_is_full_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with served(tmp_path / "s"):
        assert record(tmp_path / "s", Path("/dev/full"), "--force") == console.FAILED
    assert "/dev/full: No space left on device; free space" in capsys.readouterr().err
