"""Metrics and position object: read by Prometheus' own parser and rules, and by the names of VDA 5050."""

import asyncio
import json
import math
import re
import shutil
import subprocess
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from daemon.publish.stream.client import Lost, Stream
from daemon.publish.stream.messages import (
    Condition,
    CycleTiming,
    Fault,
    Faults,
    Hello,
    Lights,
    Link,
    Pose,
    Statistics,
    Trust,
)
from daemon.snapshot import Part, Stage, State
from taps.access_guard import Guard
from taps.metrics import server
from taps.metrics.metrics import Latest, exposition
from taps.metrics.server import serve
from taps.metrics.vda5050 import position, position_v2
from tests.taps.serving import served
from tools.sim.ports import free_port

families = pytest.importorskip("prometheus_client.parser").text_string_to_metric_families
POSE = Pose(
    seq=1, t_mono=1.0, t_sent=1.0, t_utc=1.7e9, state=3, state_name="TRACKING", reason=0, pose=(1.0, 2.0, 7.0),
    map_id=255, covariance=(1.0, 0.0, 1.0, 0.0, 0.0, 1.0),
)  # fmt: skip


async def ask(port: int, request: bytes) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(request)
        return await asyncio.wait_for(reader.read(), 5.0)
    finally:
        writer.close()


def with_server(path: Path, body: Callable[[int], Awaitable[None]]) -> None:
    async def run() -> None:
        port = free_port()
        serving = asyncio.ensure_future(serve(Stream(path, server.TOPICS), "127.0.0.1", port))
        try:
            for _ in range(100):
                await asyncio.sleep(0.05)
                try:
                    if b"lumiloop_cycles_total" in await ask(port, b"GET /metrics HTTP/1.1\r\n\r\n"):
                        break
                except ConnectionRefusedError:
                    continue
            await body(port)
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            await asyncio.sleep(0.01)

    asyncio.run(run())


def test_prometheus_reads_every_series(tmp_path: Path) -> None:
    async def body(port: int) -> None:
        head, _, text = (await ask(port, b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n")).partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200 OK")
        assert b"text/plain; version=0.0.4" in head
        assert f"Content-Length: {len(text)}".encode() in head
        found = {family.name: family for family in families(text.decode())}
        assert len(found) >= 25
        states = {s.labels["state"]: s.value for s in found["lumiloop_state"].samples}
        assert set(states) == {state.name for state in State}
        assert [name for name, value in states.items() if value] == ["TRACKING"]
        assert found["lumiloop_cycles"].type == "counter"
        assert found["lumiloop_protection_level_metres"].samples[0].value == 0.1
        cycle = {s.labels["quantile"]: s.value for s in found["lumiloop_cycle_seconds"].samples}
        assert cycle == pytest.approx({"0.5": 9e-4, "0.99": 1.5e-3, "1": 2e-3})
        links = {s.labels["use"]: s.value for s in found["lumiloop_links"].samples}
        assert (links["accepted"], links["unsurveyed"], links["missing"]) == (1.0, 1.0, 0.0)
        for family in found.values():
            assert family.documentation

    with served(tmp_path / "s"):
        with_server(tmp_path / "s", body)


def test_position_and_what_is_no_request(tmp_path: Path) -> None:
    async def body(port: int) -> None:
        for path, name, key in (
            (b"/vda5050", "mobileRobotPosition", "localized"),
            (b"/vda5050/2", "agvPosition", "positionInitialized"),
        ):
            told = await ask(port, b"GET " + path + b" HTTP/1.1\r\n\r\n")
            made = json.loads(told.partition(b"\r\n\r\n")[2])[name]
            assert made == {
                "x": 1.0, "y": 2.0, "theta": 3.0, "mapId": "0000abcd", key: True, "deviationRange": 0.1,
                "localizationScore": 1.0,
            }  # fmt: skip
        for request, status in (
            (b"GET /none HTTP/1.1\r\n\r\n", b"404"),
            (b"POST /metrics HTTP/1.1\r\n\r\n", b"405"),
            (b"nonsense\r\n\r\n", b"400"),
            (b"\xff\xfe \x00 HTTP/1.1\r\n\r\n", b"405"),
            (b"HEAD /metrics HTTP/1.1\r\n\r\n", b"200"),
        ):
            assert (await ask(port, request)).split(b" ")[1] == status, request
        assert (await ask(port, b"GET /" + b"a" * 20000)) == b""

    with served(tmp_path / "s"):
        with_server(tmp_path / "s", body)


async def test_the_address_that_is_printed_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    serving = asyncio.ensure_future(serve(Stream(tmp_path / "s", server.TOPICS), "::1", 0))
    await asyncio.sleep(0.1)
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    assert re.search(r"http://\[::1\]:\d+/metrics", capsys.readouterr().err)


def test_a_daemon_that_has_gone_is_down_and_has_no_pose() -> None:
    told = Latest()
    told.update(Hello(schema=1, name="agv", pid=1), 0.0)
    told.update(POSE, 1.0)
    assert "lumiloop_pose_age_seconds 1.5" in exposition(told, 2.5)
    told.update(Lost("gone"), 3.0)
    assert (
        exposition(told, 3.0)
        == "# HELP lumiloop_up whether the daemon answers\n# TYPE lumiloop_up gauge\nlumiloop_up 0\n"
    )


def test_texts_are_escaped() -> None:
    told = Latest(up=True, t_message=0.0, faults=Faults(present=(Fault(fault=1, meaning='a "b"\\\n'),)))
    (family,) = [one for one in families(exposition(told, 0.0)) if one.name == "lumiloop_fault"]
    assert family.samples[0].labels["meaning"] == 'a "b"\\\n'


def test_a_daemon_that_stands_still_is_not_up() -> None:
    """Its connection stays, and nothing comes: what it said last, TRACKING perhaps, is not so any more."""
    told = Latest()
    told.update(Hello(schema=1, name="agv", pid=1), 0.0)
    told.update(POSE, 1.0)
    assert "lumiloop_up 1" in exposition(told, 4.0)
    assert exposition(told, 4.5).splitlines()[2:] == ["lumiloop_up 0"]
    told.update(Statistics(t_mono=5.0), 5.0)
    assert "lumiloop_up 1" in exposition(told, 5.5)


def test_a_daemon_that_stands_still_does_not_localize() -> None:
    """It is connected and says nothing: the kernel has not noticed, and a vehicle must not trust what was."""
    told = Latest()
    told.update(POSE, time.monotonic())
    answering = server.HttpHandler(told, Guard(bind="127.0.0.1"))
    request = b"GET /vda5050 HTTP/1.1\r\n\r\n"
    assert b'"localized": true' in answering._answer(request)
    told.t_pose -= 3.5
    said = answering._answer(request)
    assert b'"localized": false' in said
    assert b'"x": 1.0' in said


@pytest.mark.parametrize(
    ("bind", "named", "status"),
    [
        ("127.0.0.1", b"Host: 127.0.0.1:9464\r\n", b"200"),
        ("127.0.0.1", b"host: localhost:9464\r\n", b"200"),
        ("127.0.0.1", b"", b"200"),
        ("127.0.0.1", b"Host: evil.example:9464\r\n", b"403"),
        ("127.0.0.1", b"Accept: */*\r\nHost:evil.example\r\n", b"403"),
        ("0.0.0.0", b"Host: robot-7.plant.example:9464\r\n", b"200"),
    ],
)
def test_a_page_whose_name_was_turned_to_this_computer_reads_nothing(bind: str, named: bytes, status: bytes) -> None:
    answering = server.HttpHandler(Latest(), Guard(bind=bind))
    said = answering._answer(b"GET /metrics HTTP/1.1\r\n" + named + b"\r\n")
    assert said.split(b" ")[1] == status
    assert (b"the request names another host" in said) == (status == b"403")


def test_of_a_daemon_that_has_gone_the_last_place_is_told_and_of_the_next_one_its_own() -> None:
    """A vehicle that asks for its position learns where it was last known to be, and that this is not known to hold."""
    told = Latest()
    answering = server.HttpHandler(told, Guard(bind="127.0.0.1"))
    request = b"GET /vda5050/2 HTTP/1.1\r\n\r\n"
    told.update(Hello(schema=1, name="agv", pid=1), 0.0)
    assert b"503" in answering._answer(request)
    told.update(POSE, time.monotonic())
    told.update(Lost("gone"), time.monotonic())
    said = answering._answer(request)
    assert b" 200 OK" in said
    assert json.loads(said.partition(b"\r\n\r\n")[2])["agvPosition"] == {
        "x": 1.0, "y": 2.0, "theta": pytest.approx(7.0 - 2.0 * math.pi, abs=1e-5), "mapId": "000000ff",
        "positionInitialized": False, "localizationScore": 0.0,
    }  # fmt: skip
    told.update(Hello(schema=1, name="agv", pid=2), 9.0)
    assert b"no pose is available yet" in answering._answer(request)
    told.update(msgspec.structs.replace(POSE, state=int(State.LOST), pose=None), time.monotonic())
    assert b"no pose is available yet" in answering._answer(request)


def test_a_robot_that_is_lost_is_not_localized() -> None:
    assert position(msgspec.structs.replace(POSE, pose=None)) is None
    lost = msgspec.structs.replace(POSE, state=int(State.LOST), pose=None)
    made = position(lost, POSE)
    assert made is not None
    assert made["localized"] is False
    assert -math.pi <= float(str(made["theta"])) <= math.pi
    assert "deviationRange" not in made
    vague = position(msgspec.structs.replace(POSE, covariance=None))
    assert vague is not None
    assert vague["localized"] is False, "the place in the map is looked for"
    second = position_v2(POSE)
    assert second is not None
    assert second["positionInitialized"] is True
    assert "localized" not in second


SPREAD = (900, 1500, 2000)
TYPES = ("counter", "gauge", "histogram", "summary", "untyped")
ABBREVIATED = ("s", "ms", "us", "ns", "sec", "b", "kb", "mb", "gb", "m", "h", "d", "hz", "rad", "deg")


def everything() -> Latest:
    """The latest messages with a value in every field; two links of one lamp, as of twins."""
    latest = Latest()
    pose = Pose(
        seq=1, t_mono=1.0, t_sent=1.0, t_utc=1.7e9, state=3, state_name="TRACKING", reason=0, pose=(1.0, 2.0, 0.5),
        covariance=(1.0, 0.0, 1.0, 0.0, 0.0, 1.0), scan_rate=40.0, trust=Trust(horizontal_m=0.1),
        pulse=CycleTiming(cycle=SPREAD, late=SPREAD, stages=(SPREAD,) * len(Stage)),
        condition=Condition(restarts=(1,) * len(Part)),
    )  # fmt: skip
    twins = tuple(Link(code=5, lamp_id=12, residual=residual) for residual in (0.1, 0.2))
    counters = {name: 3 for name in Statistics.__struct_fields__ if name not in ("t_mono", "uptime", "memory_mb")}
    for message in (
        Hello(schema=1, name='agv "7"\\\n', pid=1),
        pose,
        Lights(t_mono=1.0, links=twins),
        Faults(present=(Fault(fault=104, meaning="no valid scan"),)),
        Statistics(t_mono=1.0, uptime=5.0, memory_mb=99.5, **counters),
    ):
        latest.update(message, 1.0)
    return latest


def described(text: str) -> dict[str, str]:
    """Type of each family, by its TYPE line."""
    return dict(re.findall(r"^# TYPE (\S+) (\S+)$", text, re.MULTILINE))


@pytest.mark.parametrize("now", [1.0, 60.0], ids=["all", "daemon silent"])
def test_promtool_accepts_the_page(now: float) -> None:
    if (promtool := shutil.which("promtool")) is None:
        pytest.skip("promtool is not installed (Debian: apt-get install prometheus)")
    done = subprocess.run(
        [promtool, "check", "metrics"], input=exposition(everything(), now), text=True, capture_output=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_each_family_has_one_help_and_one_type_before_its_samples() -> None:
    text = exposition(everything(), 1.0)
    assert text.endswith("\n")
    seen: list[str] = []
    for line in text.splitlines():
        if line.startswith("# HELP "):
            name, _, what = line.removeprefix("# HELP ").partition(" ")
            assert what.strip()
            seen.append(name)
        elif line.startswith("# TYPE "):
            assert line.split(" ")[2] == seen[-1]
        else:
            assert re.split(r"[{ ]", line)[0] == seen[-1]
    assert len(seen) == len(set(seen)) == len(described(text))


def test_no_series_is_there_twice() -> None:
    series = [line.rpartition(" ")[0] for line in exposition(everything(), 1.0).splitlines() if line[0] != "#"]
    assert len(series) == len(set(series))


@pytest.mark.parametrize(("name", "kind"), described(exposition(everything(), 1.0)).items())
def test_names_follow_the_type(name: str, kind: str) -> None:
    words = name.split("_")
    assert re.fullmatch(r"lumiloop(_[a-z0-9]+)+", name), "snake case, no colons"
    assert kind in TYPES
    assert (kind == "counter") == name.endswith("_total")
    assert not {*words} & {*TYPES, *ABBREVIATED}
    assert words[-1] not in ("bucket", "count", "sum", "info") or name == "lumiloop_info"


def labels_of(latest: Latest) -> list[tuple[str, set[str]]]:
    """Type and labels of each family."""
    found: list[Any] = list(families(exposition(latest, 1.0)))
    return [(family.type, {label for sample in family.samples for label in sample.labels}) for family in found]


def test_labels_that_the_format_reserves_are_where_they_belong() -> None:
    labelled = labels_of(everything())
    assert all(("quantile" in labels) == (kind == "summary") for kind, labels in labelled)
    assert not any("le" in labels or any(label.startswith("__") for label in labels) for _, labels in labelled)
    assert sum(kind == "summary" for kind, _ in labelled) == 3
