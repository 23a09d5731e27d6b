"""The command that serves the fake lidar, and its control socket."""

from __future__ import annotations

import asyncio
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hal.errors import DeviceRefused
from hal.fake.__main__ import main
from hal.fake.faults.control import Control, serve_control
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.transport.pty_server import PtyServer
from tests.hal.fake.bench import read
from tests.hal.fake.real_time import gather, on_pty, opened, quiet

ROOT = Path(__file__).parents[3]
MD = b"MD0000108000000\n"

pytestmark = pytest.mark.realtime


def command(*words: str) -> list[str]:
    return [sys.executable, "-W", "error", "-m", "hal.fake", *words]


def test_command_serves_takes_orders_and_ends(tmp_path: Path) -> None:
    link, control, faults = tmp_path / "lidar", tmp_path / "control", tmp_path / "faults.toml"
    faults.write_text("[[fault]]\nwhat = 'trouble'\n")
    words = command("--model", "UTM-30LX", "--pty", str(link), "--faults", str(faults), "--control", str(control))
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert [process.stdout.readline() for _ in range(3)] == [
            f"1 faults of {faults} ordered\n",
            f"UTM-30LX on {link}\n",
            f"fault orders on {control}\n",
        ]

        async def talk() -> None:
            with opened(str(link)) as port:
                port.write(b"II\n" + MD)
                ii, _, scan = await gather(port, 3)
                assert "Trouble!!" in read(ii).pairs["STAT"]
                assert len(read(scan).values()) == 1081
                reader, writer = await asyncio.open_unix_connection(str(control))
                writer.write(b"order silence\nlist\n")
                assert await reader.readline() == b"ordered lidar:silence\n"
                assert await reader.readline() == b"ok\n"
                await quiet(port)
                writer.close()

        asyncio.run(talk())
        process.send_signal(signal.SIGTERM)
        out, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (0, "")
    assert "scans made" in out
    assert not link.is_symlink()


def test_command_in_this_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "log.npz", range_mm=np.full((2, 1081), 1000))
    world, socket_ = str(tmp_path / "log.npz"), str(tmp_path / "control")
    assert main(["--model", "UST-20LX", "--tcp", "127.0.0.1:0", "--world", world, "--cold", "--seconds", "0.1"]) == 0
    assert main(["--control", socket_, "--seconds", "0.1"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^UST-20LX on tcp://127\.0\.0\.1:\d+\n0 scans made", out)
    assert "UTM-30LX on /dev/pts/" in out
    assert f"fault orders on {socket_}\n" in out
    assert main(["--tcp", "nowhere"]) == main(["--pty", "a", "--tcp", "b:1"]) == main(["--world", "none.npz"]) == 2


def test_control_socket(tmp_path: Path) -> None:
    path = tmp_path / "control"

    async def scene(device: FakeHokuyo, _server: PtyServer) -> None:
        schedule = FaultSchedule({"lidar": device})
        for _ in range(2):  # the second time over a stale socket
            server = await serve_control(Control(schedule), path)
            reader, writer = await asyncio.open_unix_connection(str(path))
            writer.write(b"order silence\nclear\n")
            assert await reader.readline() == b"ordered lidar:silence\n"
            writer.write(b"x" * 100_000 + b"\n")  # no line of orders is that long: the connection is closed
            while await reader.read(1000):
                pass
            writer.close()
            server.close()
        schedule.close()

    on_pty(scene, tmp_path / "lidar")
    path.unlink(missing_ok=True)
    path.write_text("precious")
    with pytest.raises(DeviceRefused, match="no socket"):
        on_pty(lambda device, _: serve_control(Control(FaultSchedule({"lidar": device})), path), tmp_path / "lidar")  # type: ignore[arg-type,return-value]  # never gets to a server


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--world", "nothing.npz"], "nothing.npz: no such file"),
        (["--faults", "nothing.toml"], "nothing.toml"),
        (["--pty", "a", "--tcp", "127.0.0.1:0"], "give --pty or --tcp"),
        (["--tcp", "127.0.0.1"], "expected HOST:PORT"),
        (["--tcp", "127.0.0.1:70000"], "expected HOST:PORT"),
        (["--tcp", ":10940"], "expected HOST:PORT"),
        (["--faults", "pyproject.toml"], "build-system: a schedule holds [[fault]] tables"),
        (["--model", "LMS"], "invalid choice: 'LMS'"),
    ],
)
def test_command_refuses_clearly(words: list[str], message: str) -> None:
    done = subprocess.run(command(*words), cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
