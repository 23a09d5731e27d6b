"""Orders are for the robot that is looked at: not for another daemon of this computer that has the port."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.config.paths import stream_path
from daemon.publish.modbus.command_client import CommandRefused, switch_map
from taps.access_guard import Guard
from tests.taps.view.house import TOKEN, serving

OTHER = """
import socket, sys
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.bind(("127.0.0.1", 0))
print(sock.getsockname()[1], flush=True)
while True:
    print(sock.recvfrom(512)[0].hex(), flush=True)
"""


@pytest.fixture
def other() -> Iterator[tuple[int, subprocess.Popen[str]]]:
    """A port of another process, which says what it is asked."""
    with subprocess.Popen([sys.executable, "-c", OTHER], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield int(process.stdout.readline()), process
        finally:
            process.kill()


async def test_another_daemon_is_not_ordered_about(tmp_path: Path, other: tuple[int, subprocess.Popen[str]]) -> None:
    """As where two run here and the page's configuration names the port of the wrong one."""
    port, process = other
    async with serving(tmp_path, Guard("127.0.0.1", TOKEN, True), modbus=port) as house, house.page(TOKEN) as page:
        await page.welcome()
        await page.socket.send_json({"order": "set_pose", "pose": [1.0, 2.0, 0.0]})
        said = (await page.until("order"))["outcome"]
    assert f"127.0.0.1:{port} belongs to process {process.pid}" in said
    assert "--config" in said
    process.kill()
    assert process.stdout is not None
    assert process.stdout.read() == "", "it was asked nothing"


async def test_nor_is_its_map_switched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: tuple[int, subprocess.Popen[str]]
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    path = stream_path("agv")
    server = await asyncio.start_unix_server(lambda reader, writer: writer.close(), path)
    try:
        with pytest.raises(CommandRefused, match="name its configuration with --config, or give"):
            await switch_map("agv", "127.0.0.1", other[0], 1)
    finally:
        server.close()
