"""The daemon's log: fields to the journal's socket, lines where there is none, and never a wait."""

import io
import logging
import os
import re
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.health import journal_fields
from daemon.health.assessment import Vitals
from daemon.health.faults import FAULTS, Fault
from daemon.runtime.heartbeat import OVER_S, Heartbeat
from daemon.system import logging as system_logging

CATALOG = Path(__file__).parents[3] / "systemd" / "lumiloop.catalog"


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(str(tmp_path / "journal"))
        end.setblocking(False)
        yield end


def unpacked(data: bytes) -> dict[str, str]:
    """The journal's side of its native protocol, written from its specification."""
    fields = {}
    while data:
        head, _, rest = data.partition(b"\n")
        if b"=" in head:
            name, _, value = head.partition(b"=")
            data = rest
        else:
            name, length = head, int.from_bytes(rest[:8], "little")
            value, end = rest[8 : 8 + length], rest[8 + length : 9 + length]
            assert end == b"\n"
            data = rest[9 + length :]
        assert re.fullmatch(rb"[A-Z][A-Z0-9_]*", name)
        fields[name.decode()] = value.decode()
    return fields


def handler_to(tmp_path: Path, stream: io.StringIO | None = None) -> system_logging.JournalHandler:
    return system_logging.JournalHandler(tmp_path / "journal", logging.StreamHandler(stream or io.StringIO()))


def logger_to(handler: logging.Handler) -> logging.Logger:
    logger = logging.Logger("daemon.part")
    logger.addHandler(handler)
    return logger


def test_an_entry_carries_its_fields(tmp_path: Path, journal: socket.socket) -> None:
    handler = handler_to(tmp_path)
    logger_to(handler).warning("lidar %s", "lost", extra=journal_fields.of_fault(Fault.LIDAR_MISSING))
    fields = unpacked(journal.recv(65536))
    handler.close()
    assert fields["MESSAGE"] == "lidar lost"
    assert fields["PRIORITY"] == "4"
    assert fields["LUMILOOP_PART"] == "daemon.part"
    assert fields["LUMILOOP_FAULT"] == str(int(Fault.LIDAR_MISSING))
    assert fields["LUMILOOP_REMEDY"] == FAULTS[Fault.LIDAR_MISSING][1]
    assert fields["MESSAGE_ID"] == journal_fields.FAULT_ID
    assert fields["CODE_FUNC"] == "test_an_entry_carries_its_fields"


def test_a_message_of_several_lines_is_one_entry(tmp_path: Path, journal: socket.socket) -> None:
    handler = handler_to(tmp_path)
    try:
        raise ValueError("a = b\nc")
    except ValueError:
        logger_to(handler).exception("failed")
    fields = unpacked(journal.recv(65536))
    handler.close()
    assert fields["MESSAGE"].startswith("failed\nTraceback")
    assert fields["MESSAGE"].endswith("ValueError: a = b\nc")


def test_a_journal_that_takes_nothing_costs_lines_and_no_time(tmp_path: Path, journal: socket.socket) -> None:
    handler = handler_to(tmp_path)
    logger = logger_to(handler)
    for number in range(2000):
        logger.info("line %d", number)
    assert handler.lost > 0
    lost = handler.lost
    while True:
        try:
            journal.recv(65536)
        except BlockingIOError:
            break
    logger.info("again")
    assert unpacked(journal.recv(65536))["LUMILOOP_LINES_LOST"] == str(lost)
    logger.info("and again")
    assert "LUMILOOP_LINES_LOST" not in unpacked(journal.recv(65536))
    handler.close()


def test_without_the_journals_socket_lines_go_to_stderr(tmp_path: Path) -> None:
    stream = io.StringIO()
    handler = handler_to(tmp_path, stream)
    logger_to(handler).info("said")
    handler.close()
    assert stream.getvalue() == "said\n"


def test_a_message_too_long_for_a_datagram_is_cut(tmp_path: Path, journal: socket.socket) -> None:
    handler = handler_to(tmp_path)
    logger_to(handler).info("ü" * 300_000)
    assert len(unpacked(journal.recv(1 << 20))["MESSAGE"].encode()) == system_logging.LONGEST
    handler.close()


@pytest.mark.parametrize("to_journal", [False, True])
def test_only_the_journals_own_stream_is_answered_with_entries(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, journal: socket.socket, to_journal: bool
) -> None:
    monkeypatch.setattr(system_logging, "JOURNAL", tmp_path / "journal")
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    with (tmp_path / "log").open("w+") as stream:
        at = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{at.st_dev}:{at.st_ino}" if to_journal else "1:2")
        monkeypatch.setattr(sys, "stderr", stream)
        system_logging.start_log()
        logging.getLogger("daemon").warning("said")
        stream.seek(0)
        lines = stream.read().splitlines()
    if to_journal:
        assert lines == []
        assert unpacked(journal.recv(65536))["MESSAGE"] == "said"
        logging.getLogger().handlers[0].close()
    else:
        assert len(lines) == 1
        assert lines[0].endswith("WARNING said")


def test_the_heartbeat_tells_faults_with_their_fields(caplog: pytest.LogCaptureFixture) -> None:
    heartbeat = Heartbeat(lambda lateness: pytest.fail("not asked"), str)
    with caplog.at_level(logging.INFO):
        heartbeat._tell(Vitals(0.0), (Fault.OVERRUNS,))
        heartbeat._tell(Vitals(OVER_S), ())
    came, over = (record.__dict__["fields"] for record in caplog.records)
    assert (came["MESSAGE_ID"], over["MESSAGE_ID"]) == (journal_fields.FAULT_ID, journal_fields.OVER_ID)
    assert came["LUMILOOP_FAULT_NAME"] == over["LUMILOOP_FAULT_NAME"] == "OVERRUNS"
    assert "LUMILOOP_REMEDY" in came
    assert "LUMILOOP_REMEDY" not in over


def test_the_catalog_explains_every_message_id_with_fields_that_are_sent() -> None:
    text = CATALOG.read_text()
    explained = set(re.findall(r"^-- ([0-9a-f]{32})$", text, re.MULTILINE))
    assert explained == {journal_fields.FAULT_ID, journal_fields.OVER_ID, journal_fields.STATE_ID}
    sent = {
        *journal_fields.of_fault(Fault.OVERRUNS)["fields"],
        *journal_fields.of_state("", "", "")["fields"],
        "MESSAGE",
    }
    assert set(re.findall(r"@(\w+)@", text)) <= sent


def test_lines_of_a_terminal_have_date_time_and_zone(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    made: list[logging.Handler] = []
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(logging, "basicConfig", lambda level, handlers: made.extend(handlers))
    system_logging.start_log()
    record = logging.LogRecord("daemon.part", logging.INFO, "file", 1, "said", (), None)
    made[0].handle(record)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}[+-]\d\d:\d\d INFO    said\n", stream.getvalue())


def test_lines_of_a_library_cannot_fill_the_log_and_ours_are_all_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client provokes them: a WebSocket library has a line for each message that it cannot read."""
    clock, stream = [0.0], io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.addFilter(system_logging.LibraryLimit(lambda: clock[0]))
    for name in ("library.server", "daemon.health.state_log"):
        logger = logging.Logger(name)
        logger.addHandler(handler)
        for number in range(1000):
            clock[0] = 0.1 * number
            logger.warning("%s: message %d", name, number)
    lines = stream.getvalue().splitlines()
    assert sum("daemon" in line for line in lines) == 1000
    assert 90 <= sum("library" in line for line in lines) <= 110
    assert "library.server: message 100 (90 more such lines were skipped before it)" in lines
    clock[0] = 1000.0
    monkeypatch.setattr(logging, "raiseExceptions", False)
    handler.handle(logging.LogRecord("library.server", logging.WARNING, "file", 1, "%d", ("no number",), None))
