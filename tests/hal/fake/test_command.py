"""The command that serves the fake lidar, and its control socket."""

import asyncio
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hal.fake.bench import read
from tests.hal.fake.real_time import gather, opened, quiet

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
            f"1 faults of {faults} scheduled\n",
            f"UTM-30LX on {link}\n",
            f"fault commands on {control}\n",
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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--world", "nothing.npz"], "nothing.npz: no such file"),
        (["--faults", "nothing.toml"], "nothing.toml"),
        (["--pty", "a", "--tcp", "127.0.0.1:0"], "give --pty or --tcp"),
        (["--tcp", "127.0.0.1"], "expected HOST:PORT"),
        (["--tcp", "127.0.0.1:70000"], "expected HOST:PORT"),
        (["--tcp", ":10940"], "expected HOST:PORT"),
        (["--faults", "pyproject.toml"], "build-system: a schedule must have only [[fault]] tables"),
        (["--model", "LMS"], "invalid choice: 'LMS'"),
    ],
)
def test_command_refuses_clearly(words: list[str], message: str) -> None:
    done = subprocess.run(command(*words), cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
