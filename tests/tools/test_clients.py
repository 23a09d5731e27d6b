"""The reference clients say how they are used, and what is wrong, instead of a stack of calls."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CLIENTS = Path(__file__).parents[2] / "tools/clients"


@pytest.mark.parametrize("name", ["read_modbus", "read_lights", "subscribe_pose", "send_odometry", "send_command"])
@pytest.mark.parametrize("words", [["--help"], ["127.0.0.1", "no-port"]])
def test_a_client_that_is_misused_says_how_it_is_used(name: str, words: list[str]) -> None:
    told = subprocess.run(
        [sys.executable, str(CLIENTS / f"{name}.py"), *words], capture_output=True, text=True, timeout=20
    )
    assert told.returncode == 1
    assert f"python {name}.py" in told.stderr
    assert "Traceback" not in told.stderr


def test_a_port_at_which_nobody_listens_by_tcp_is_said() -> None:
    command = [sys.executable, str(CLIENTS / "read_modbus.py"), "127.0.0.1", "1", "tcp"]
    told = subprocess.run(command, capture_output=True, text=True, timeout=20)
    assert told.returncode == 1
    assert "is lumiloop running" in told.stderr
    assert "Traceback" not in told.stderr
