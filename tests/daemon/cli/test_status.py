"""`lumiloop status` against a running publisher, a silent host, a stranger."""

import argparse
import asyncio
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from daemon.cli import status as cli_status
from daemon.cli import status_table
from daemon.cli.explain import entries, find
from daemon.cli.reports.status import as_object
from daemon.config.schema import Config, ModbusConfig
from daemon.publish.modbus import client, lights_block, registers
from daemon.publish.modbus.parts_block import PARTS
from daemon.publish.modbus.requests import BLOCKS
from daemon.snapshot import Condition, DimmedLamp, Part, Snapshot, State, Thread, Trust
from tests.daemon.publish.modbus.test_light_blocks import picture
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.network import publishing


def status(address: str | None, settings: Config | None = None, **options: bool) -> int:
    return cli_status.main(
        argparse.Namespace(**{"address": address, "settings": settings, "json": False, "watch": False} | options)
    )


def run_against(taken: Snapshot, advance: bool = True, **options: bool) -> int:
    """Exit code of the command against a publisher that shows a snapshot (again and again, newly numbered)."""

    async def run() -> int:
        async with publishing() as publisher:
            publisher.publish(taken)
            command = asyncio.create_task(asyncio.to_thread(status, f"127.0.0.1:{publisher.port}", **options))
            number = taken.seq
            while not command.done():
                await asyncio.sleep(0.02)
                number += advance
                publisher.publish(snapshot(seq=number, reason=0, fault=0) if advance else taken)
            return await command

    return asyncio.run(run())


def test_a_person_reads_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_against(snapshot(reason=0, fault=0)) == 0
    shown = capsys.readouterr().out
    for line in (
        "state      TRACKING\n",
        "map pose   x 1.2345 m, y -2.3456 m, yaw 171.89 deg  (not observed: y)\n",
        "sigma      0.0200 m, 0.0100 m, 0.57 deg\n",
        "loops      2, latest: keyframe 70001 to 12\n",
        "lights     4 in view, strongest lamp 77\n",
        "scans      39.92 Hz, 100000 missed\n",
        "devices    lidar ok, odometry NOT OK\n",
        "2023-11-14 22:13:20 UTC\n",
    ):
        assert line in shown
    assert "STALLED" not in shown


def test_every_label_of_the_table_is_explained(capsys: pytest.CaptureFixture[str]) -> None:
    down = Condition(
        faults=(301, 304),
        restarts=(1,) * len(Part),
        down=frozenset({Part.MODBUS}),
        hanging=frozenset({Thread.MAP}),
        uptime_s=9.0,
    )
    looking = Trust(horizontal_m=0.2, yaw_rad=0.01, laser=True, limit_m=0.1, places=2)
    taken = snapshot(light=picture(), links=3, fault=301, condition=down, trust=looking, state=State.RELOCATING)
    assert run_against(taken, advance=False) == 0
    lines = capsys.readouterr().out.splitlines()
    labels = {line[:10].strip() for line in lines} - {""}
    columns = set(next(line for line in lines if line.startswith("links"))[10:].split())
    assert {"hypotheses", "protection", "running", "RSS", "use"} < labels | columns
    everything = list(entries())
    assert [
        word
        for word in sorted(labels | columns | {"STALLED", "ALERT", "hanging", "down"})
        if not find(word, everything)
    ] == []


def test_a_person_sees_the_links_beside_the_pose(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_against(snapshot(light=picture(), links=3), advance=False) == 0
    shown = capsys.readouterr().out
    for line in (
        "map pose   x 1.2345 m, y -2.3456 m, yaw 171.89 deg",
        "light fix  GOOD, 5 used, age 0.0500 s\n",
        "light pose x -1.2345 m, y 7.2500 m, yaw -159.46 deg\n",
        "           sigma 0.0211 m, 0.0300 m, 0.57 deg\n",
        "links        lamp  code          RSS  residual  use\n",
        "             1017    17   1250.00 nA    -3.1 %  ACCEPTED\n",
        "                -    60    500.00 nA         -  TWIN\n",
        "            65000   101      3.10 nA   -96.2 %  OCCLUDED\n",
    ):
        assert line in shown, shown


@pytest.mark.parametrize("state", [State.AMBIGUOUS, State.RELOCATING, State.LOST])
def test_a_pose_whose_place_is_not_known_is_marked_as_a_guess(state: State, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_against(snapshot(state=state, map_id=0xC0FFEE), advance=False) == 0
    shown = capsys.readouterr().out
    assert "yaw 171.89 deg  (unconfirmed pose)\n" in shown
    assert "map        id 00c0ffee, " in shown


def test_a_daemon_of_a_version_without_the_block_of_lights_is_read_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(lights_block.BLOCK, "encode", lambda snapshot: b"")
    assert run_against(snapshot(light=picture(), links=3), advance=False) == 0
    shown = capsys.readouterr().out
    assert "lights     3 in view" in shown
    assert "light fix" not in shown


def test_a_daemon_whose_cycle_stands_still_is_shown_as_such(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_against(snapshot(reason=0, fault=0), advance=False) == 0
    assert "STALLED" in capsys.readouterr().out


def test_before_the_first_cycle_no_device_is_judged_and_nothing_is_said_to_stand_still(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_against(snapshot(state=State.STARTING), advance=False) == 0
    shown = capsys.readouterr().out
    assert "devices    lidar, odometry: no data before the first cycle\n" in shown
    assert "STALLED" not in shown
    assert "NOT OK" not in shown


def test_what_is_not_known_reads_so(capsys: pytest.CaptureFixture[str]) -> None:
    empty = Snapshot(seq=0, t_mono=0.0, t_sent=0.0, t_utc=0.0, state=State.STARTING, reason=0)
    assert run_against(empty, advance=False) == 0
    shown = capsys.readouterr().out
    assert "map pose   not known\n" in shown
    assert "lights     no photodiode configured\n" in shown
    assert "devices    none configured\n" in shown
    assert "None" not in shown


def test_reasons_and_faults_come_with_a_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_against(snapshot(reason=4, fault=101), advance=False) == 0
    shown = capsys.readouterr().out
    silent = "no valid scan for three scan periods, or scans are not steady yet"
    assert f"reason     4: {silent} (read the fault; check the lidar's power and cable)\n" in shown
    assert "fault      101: no lidar is found (" in shown


def test_numbers_of_a_newer_daemon_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_against(snapshot(reason=60_000, fault=60_001), advance=False) == 0
    shown = capsys.readouterr().out
    assert "reason     60000: unknown to this version" in shown
    assert "fault      60001: unknown to this version" in shown


def test_a_program_reads_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_against(snapshot(reason=0, fault=0), json=True) == 0
    reading = json.loads(capsys.readouterr().out)
    assert (reading["schema"], reading["state"]) == ("lumiloop.status/1", "TRACKING")
    assert reading["pose"]["map"] == {"x_m": 1.2345, "y_m": -2.3456, "yaw_rad": 3.0}
    assert reading["flags"]["loop_closed"] is True
    assert reading["devices"]["adc_fitted"] is False
    assert reading["snapshot"]["stalled"] is False
    assert reading["snapshot"]["time"] == "2023-11-14T22:13:20.250+00:00"
    assert reading["faults"] == []
    assert reading["reason"]["number"] == 0


def test_every_published_value_is_in_the_report() -> None:
    """Each is changed by itself; the report has to change with it."""
    dimmed = tuple(DimmedLamp(1000.0 * row, 1e-6) for row in (1, 2, 3))
    taken = snapshot(light=picture(dimmed=dimmed), links=3)
    reading = registers.decode_block(registers.encode_block(taken))
    for block in BLOCKS:
        reading |= block.decode(block.encode(taken)) | {"seq": reading["seq"]}
    before = as_object(reading, stalled=False)
    ways = {name: 1.0 if value is None else float(value) + 1.0 for name, value in reading.items()}
    rows = {f"link_{row}" for row in range(4, 17)}  # of no link
    ways = {name: way for name, way in ways.items() if name.rpartition("_")[0] not in rows}
    same = {name for name in ways if as_object(reading | {name: ways[name]}, stalled=False) == before}
    assert same <= {"seq_end", "heartbeat", "faults", "fault_1", "magic", "version"}, (
        "derived, or for the protocol only"
    )


def test_a_report_names_the_units() -> None:
    dimmed = tuple(DimmedLamp(1000.0 * row, 1e-6) for row in (1, 2, 3))
    taken = snapshot(light=picture(dimmed=dimmed), links=3)
    reading = registers.decode_block(registers.encode_block(taken))
    for block in BLOCKS:
        reading |= block.decode(block.encode(taken)) | {"seq": reading["seq"]}

    def numbers(tree: Any) -> Iterator[str]:
        for key, value in tree.items():
            rows = value if isinstance(value, list) else [value]
            for row in rows:
                if isinstance(row, dict):
                    yield from numbers(row)
                elif isinstance(row, float):
                    yield key

    plain = {"x_y", "x_yaw", "y_yaw", "gap", "residual_ln", "floor_share", "sample_clock_ppm"}
    units = ("_m", "_rad", "_s", "_hz", "_a", "_m_per_s", "_rad_per_s")
    found = {key for key in numbers(as_object(reading, stalled=False)) if not key.endswith(units)} - plain
    counts = {key for key in found if key in COUNTS or key.startswith(("keyframe", "restarts"))}
    assert found - counts - {part.name.lower() for part in PARTS} == set()


COUNTS = {
    *("seq", "jumps", "count", "hypotheses", "in_view", "strongest_lamp", "used", "blocks", "blocks_lost", "code"),
    *("lamp", "missed", "overruns", "thinned", "without_map", "carried"),
}


def test_a_program_reads_the_links(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_against(snapshot(reason=0, fault=0, light=picture()), advance=False, json=True) == 0
    lights = json.loads(capsys.readouterr().out)["lights"]
    assert lights["fix"] == "GOOD"
    assert lights["pose"]["x_m"] == -1.2345
    assert lights["links"][1] == {"code": 60, "lamp": None, "use": "TWIN", "strength_a": 5e-7, "residual_ln": None}
    assert len(lights["links"]) == 3


@contextmanager
def stranger(block: bytes, head: bytes = b"\x00\x00\x00\x83\x01\x04\x80", silent: int = 0) -> Iterator[str]:
    """Something that answers every datagram with the same, but for the first few."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))

    def serve() -> None:
        for number in range(1000):
            data, peer = sock.recvfrom(512)
            if not data:
                return
            if number >= silent:
                sock.sendto(b"\xff\xff" + head + block, peer)  # an answer to nothing that was asked
                sock.sendto(data[:2] + head + block, peer)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"127.0.0.1:{sock.getsockname()[1]}"
    finally:
        sock.sendto(b"", sock.getsockname())
        thread.join()
        sock.close()


def test_a_lost_datagram_is_asked_for_again(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "_TIMEOUT_S", 0.1)
    with stranger(registers.encode_block(snapshot(reason=0, fault=0)), silent=2) as address:
        assert status(address) == 0
    assert "TRACKING" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("block", "head", "words"),
    [
        (bytes(128), b"\x00\x00\x00\x83\x01\x04\x80", "not a lumiloop register block"),
        (b"", b"\x00\x00\x00\x03\x01\x84\x02", "exception 2; this is another kind of device"),
        (b"\x4c\x4c\x00\x09" + bytes(124), b"\x00\x00\x00\x83\x01\x04\x80", "version 9, this reader needs version 1"),
        (bytes(20), b"\x00\x00\x00\x17\x01\x04\x14", "64 registers, got 10"),
        (b"", b"", "64 registers, got 0"),
    ],
)
def test_a_stranger_is_told_apart(block: bytes, head: bytes, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with stranger(block, head) as address:
        assert status(address) == 1
    assert words in capsys.readouterr().err


def test_nobody_there(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
    assert status(f"127.0.0.1:{port}") == 1
    told = capsys.readouterr().err
    assert f"127.0.0.1:{port}" in told
    assert "lumiloop run" in told


@contextmanager
def another_process(path: Path) -> Iterator[int]:
    """A process that listens at a local stream; yields its id."""
    listening = f"import socket; s = socket.socket(socket.AF_UNIX); s.bind({str(path)!r}); s.listen()"
    program = f"{listening}; print(flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process.pid
        process.terminate()


def test_whose_registers_are_shown_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Modbus answers at the configured port: another daemon, or the one of the configured name."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    with stranger(registers.encode_block(snapshot(reason=0, fault=0))) as address:
        settings = Config(name="agv", modbus=ModbusConfig(port=int(address.rpartition(":")[2])))
        assert status(None, settings) == 0, "whoever is meant does not run, or cannot be seen"
        assert capsys.readouterr().out.startswith(f"daemon     process {os.getpid()}: ")
        assert status(None, settings, json=True) == 0
        assert json.loads(capsys.readouterr().out)["daemon"]["process"] == os.getpid()
        with another_process(tmp_path / "agv.stream") as meant:
            assert status(None, settings) == 1
            said = capsys.readouterr()
            assert not said.out
            assert f"{address} belongs to process {os.getpid()}" in said.err
            assert f"not to `agv` (process {meant})" in said.err
            assert "modbus.port" in said.err
            assert status(address, settings) == 0, "who names an address means whoever answers there"
            assert capsys.readouterr().out.startswith("state")
        (tmp_path / "agv.stream").unlink()
        with socket.socket(socket.AF_UNIX) as ours:
            ours.bind(str(tmp_path / "agv.stream"))
            ours.listen()
            assert status(None, settings) == 0


def test_silence(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "_TIMEOUT_S", 0.02)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        assert status(f"127.0.0.1:{sock.getsockname()[1]}") == 1
    assert "firewall" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "settings", "expected"),
    [
        (None, None, ("127.0.0.1", 1502)),
        (None, Config(), ("127.0.0.1", 1502)),
        (None, Config(bind="0.0.0.0", modbus=ModbusConfig(port=5020)), ("127.0.0.1", 5020)),
        (None, Config(bind="::"), ("::1", 1502)),
        (None, Config(bind="192.168.0.10"), ("192.168.0.10", 1502)),
        ("robot", Config(modbus=ModbusConfig(port=7)), ("robot", 1502)),
        ("robot:7", None, ("robot", 7)),
        (":7", None, ("127.0.0.1", 7)),
        ("::1", None, ("::1", 1502)),
        ("[::1]", None, ("::1", 1502)),
        ("[::1]:7", None, ("::1", 7)),
    ],
)
def test_where_to_look(text: str | None, settings: Config | None, expected: tuple[str, int]) -> None:
    assert cli_status.address_of(text, settings) == expected


@pytest.mark.parametrize("text", ["robot:", "robot:x", "robot:0", "robot:65536"])
def test_a_wrong_address_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert status(text) == 1
    assert "HOST:PORT" in capsys.readouterr().err


def test_modbus_switched_off(capsys: pytest.CaptureFixture[str]) -> None:
    assert status(None, Config(modbus=ModbusConfig(port=0))) == 1
    assert "modbus.port is 0" in capsys.readouterr().err


def test_an_unknown_name(capsys: pytest.CaptureFixture[str]) -> None:
    for host in ("no-such-host.invalid", "robot..local"):
        assert status(host) == 1
        assert "check the address" in capsys.readouterr().err


def test_a_time_that_is_none_is_not_made_up() -> None:
    reading: Any = registers.decode_block(registers.encode_block(snapshot(reason=0, fault=0)))
    assert "no time" in status_table.as_table(reading | {"t_utc": None}, stalled=False)
    assert status_table.as_table(reading | {"t_utc": 2**64 / 1e6}, stalled=False), "the largest that can be sent"


def test_an_age_or_a_sigma_at_the_end_of_its_register_may_be_any_larger() -> None:
    old = snapshot(reason=0, fault=0, t_sent=1300.0, covariance=(100.0, 0.0, 1e-4, 0.0, 0.0, 1e-4))
    shown = status_table.as_table(registers.decode_block(registers.encode_block(old)), stalled=False)
    assert "age        > 6.5 s\n" in shown
    assert "sigma      > 6.5 m, 0.0100 m, 0.57 deg\n" in shown


def test_a_state_of_a_newer_daemon_is_shown_by_number() -> None:
    reading: Any = registers.decode_block(registers.encode_block(snapshot(reason=0, fault=0))) | {"state": 99}
    assert "unknown to this version (99)" in status_table.as_table(reading, stalled=False)
