"""What a fleet's commands refuse, at once and in words."""

import asyncio
import json
from pathlib import Path

import pytest

pytest.importorskip("zenoh", reason="pip install 'lumiloop[zenoh]'")

from daemon.cli import parser
from daemon.system import console
from taps.zenoh_session import BadEndpoint, session_config
from tests.taps.routers import router


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["fleet", "--router", "nohost"], "Expected `host:port`"),
        (["fleet", "--router", "nothing/x"], "'nothing' is not a protocol; available: tcp, tls"),
        (["fleet", "--router", "tcp/127.0.0.1:1"], "waiting for it (Unable to connect"),
        (["fleet", "join", "--router", "a b:1"], "Expected `host:port`"),
        (["ros2", "--namespace", "agv-1"], "--namespace: Expected a namespace"),
        (["fleet", "share"], "nothing to share is named"),
        (["fleet", "share", "--survey", "/none"], "/none: cannot be read: No such file"),
        (["fleet", "router", "--zenoh", "/none"], "/none"),
        (["fleet", "fetch", "--switch", "--set", "modbus.port=0"], "--switch: Modbus is disabled in the configuration"),
    ],
)
def test_what_cannot_be_is_said(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if "tcp/127.0.0.1:1" in words:
        monkeypatch.setattr("taps.zenoh_session.RETRY_S", -1.0)
        monkeypatch.setattr(asyncio, "sleep", interrupted)
    try:
        code = parser.main(words)
    except KeyboardInterrupt:
        code = console.INTERRUPTED
    assert code != console.OK
    assert said in capsys.readouterr().err


def test_a_domain_that_ros_does_not_have_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parser.main(["ros2", "--domain", "-1"])
    assert "-1: out of range; ROS 2 has domains 0 to 232" in capsys.readouterr().err


def test_what_is_not_shared_cannot_be_fetched(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parser.main(["fleet", "fetch", "maps"])
    assert "maps: unknown; give survey or map, or nothing for both\n" in capsys.readouterr().err
    for words in ([], ["map"], ["survey", "map"]):
        assert parser.parser().parse_args(["fleet", "fetch", *words]).what == words


@pytest.mark.parametrize(
    ("content", "said"), [(None, "cannot be read: No such file"), ("rubbish", "no certificate or")]
)
def test_a_certificate_that_is_none_is_said_and_not_waited_for(tmp_path: Path, content: str | None, said: str) -> None:
    pem, file = tmp_path / "ca.pem", tmp_path / "zenoh.json5"
    file.write_text(json.dumps({"transport": {"link": {"tls": {"root_ca_certificate": str(pem)}}}}))
    if content is not None:
        pem.write_text(content)
    with pytest.raises(BadEndpoint, match=said):
        session_config("client", "tls/localhost:1", file)


async def interrupted(seconds: float) -> None:
    raise KeyboardInterrupt


def test_a_port_that_is_taken_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with router() as made:
        assert parser.main(["fleet", "router", "--listen", made.address]) == console.FAILED
    assert f"cannot listen on {made.address}" in capsys.readouterr().err
