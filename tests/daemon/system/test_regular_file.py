"""Files that a start reads: anything in their place, and reads that fail once or for ever."""

import errno
import os
from pathlib import Path

import pytest

from daemon.config.loader import ConfigError, load
from daemon.config.schema import PhotodiodeConfig
from daemon.config.survey_loader import SurveyError, read_survey
from daemon.devices.sample_clock import FILE, SampleClock
from daemon.maps import last_pose
from daemon.system import regular_file
from daemon.system.regular_file import TRIES, read_named, read_regular, read_start
from tests.daemon.support.odd_files import KINDS, planted


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(regular_file, "PAUSE_S", 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    planted(tmp_path / "file", kind)
    with pytest.raises(OSError, match=r"not a regular file|Too many levels|Is a directory"):
        read_regular(tmp_path / "file", 100)
    with pytest.raises(OSError, match=r"not a regular file|Too many levels|Is a directory"):
        read_start(tmp_path / "file", 100)


def test_a_file_that_is_too_large_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(bytes(101))
    with pytest.raises(OSError, match="larger than 100 bytes"):
        read_regular(file, 100)
    assert read_regular(file, 101) == bytes(101)
    assert read_start(file, 100) == bytes(100)
    with pytest.raises(OSError, match="larger than 10 bytes"):
        read_regular(Path("/proc/self/status"), 10)  # a file that states no size


def test_a_small_file_needs_no_memory_for_the_largest(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(bytes(3 << 20))
    assert read_regular(file, 1 << 50) == bytes(3 << 20)
    assert read_regular(Path("/proc/self/status"), 1 << 50)
    reader, writer = os.pipe()
    os.write(writer, b"piped")
    os.close(writer)
    assert read_named(Path(f"/dev/fd/{reader}"), 1 << 50) == b"piped"
    os.close(reader)


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.EMFILE, errno.ENOMEM, errno.ENOSPC])
def test_a_failure_that_passes_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    file, calls, really = tmp_path / "file", [0], os.open
    file.write_bytes(b"content")

    def fails(path: Path, flags: int) -> int:
        calls[0] += 1
        if calls[0] < TRIES + (calls[0] > TRIES):
            raise OSError(number, os.strerror(number), str(path))
        return really(path, flags)

    monkeypatch.setattr(os, "open", fails)
    assert read_regular(file, 100) == b"content"
    assert calls[0] == TRIES


def test_a_failure_that_lasts_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(path: Path, flags: int) -> int:
        raise OSError(errno.EIO, "gone", str(path))

    file = tmp_path / "file"
    file.touch()
    monkeypatch.setattr(os, "open", fails)
    with pytest.raises(OSError, match="gone"):
        read_regular(file, 100)


def test_a_pipe_that_the_shell_has_opened_is_welcome_and_bounded() -> None:
    for size in (100, 101):
        reader, writer = os.pipe()
        os.write(writer, bytes(size))
        os.close(writer)
        path = Path(f"/dev/fd/{reader}")
        if size == 100:
            assert read_named(path, 100) == bytes(100)
        else:
            with pytest.raises(OSError, match="larger than 100 bytes"):
                read_named(path, 100)
        os.close(reader)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.timeout(20)
def test_no_file_of_a_start_may_be_anything_else(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    """What is configured is said to be wrong; what was learned is done without."""
    for name in ("robot.toml", "lights.toml", last_pose.FILE, FILE):
        planted(tmp_path / name, kind)
    with pytest.raises(ConfigError, match=r"robot\.toml: cannot be read"):
        load(tmp_path / "robot.toml")
    with pytest.raises(SurveyError, match=r"lights\.toml: cannot be read"):
        read_survey(tmp_path / "lights.toml")
    assert last_pose.read(tmp_path / last_pose.FILE) is None
    assert SampleClock(PhotodiodeConfig(bus="/dev/i2c-1"), tmp_path).ppm is None
    for name in (last_pose.FILE, FILE):
        assert caplog.text.count(f"{tmp_path / name} cannot be read") == 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_pose_is_stored_whatever_was_in_its_place(tmp_path: Path, kind: str) -> None:
    planted(tmp_path / last_pose.FILE, kind)
    handle = last_pose._opened(tmp_path / last_pose.FILE)
    os.write(handle, b"pose")
    os.close(handle)
    assert (tmp_path / last_pose.FILE).read_bytes() == b"pose"
    assert os.path.lexists(tmp_path / (last_pose.FILE + last_pose.ASIDE))


@pytest.mark.parametrize("text", ["a = " + "[" * 100_000, "a" + ".a" * 3_000 + " = 1"])
def test_a_file_that_is_nested_without_end_is_said_to_be_wrong(tmp_path: Path, text: str) -> None:
    file = tmp_path / "file.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"not valid TOML|unknown"):
        load(file)
    with pytest.raises(SurveyError, match=r"not valid TOML|unknown"):
        read_survey(file)
