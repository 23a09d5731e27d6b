"""Two simulated robots that share survey and map, as the page says it: word for word, but for the ports."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zenoh", reason="pip install 'lumiloop[zenoh]'")
from tools.sim.ports import free_port

ROOT = Path(__file__).parents[3]
PATIENCE_S = 150.0
KNOWS = ("TRACKING", "DEGRADED")
"""On a computer that has other work, too."""


def script(address: str) -> str:
    """The page's block, with ports that are free."""
    page = (ROOT / "docs" / "fleet.md").read_text()
    block = page.partition("### Two simulated robots")[2].partition("```sh\n")[2].partition("```")[0]
    assert "fleet fetch" in block
    for first in ("150", "560"):
        block = block.replace(f"{first}$n", f"$((n == 1 ? {free_port()} : {free_port()}))")
    block = block.replace("agv 1 fleet router", f"agv 1 fleet router --listen {address}")
    for verb in ("share", "fetch", "join"):
        block = block.replace(f"fleet {verb}", f"fleet {verb} --router {address}")
    return block.replace("agv 1 fleet   ", f"agv 1 fleet --router {address}   ")


def ending() -> str:
    """How the page ends them."""
    page = (ROOT / "docs" / "fleet.md").read_text()
    return next(line for line in page.splitlines() if line.startswith("pkill "))


def command(folder: Path, name: str, words: str) -> None:
    path = folder / name
    path.write_text(f'#!/bin/sh\nexec {sys.executable} {words} "$@"\n')
    path.chmod(0o755)


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.realtime
def test_two_robots_on_one_map(tmp_path: Path) -> None:
    address = f"127.0.0.1:{free_port()}"
    bin_ = tmp_path / "bin"
    bin_.mkdir()
    command(bin_, "lumiloop", "-m daemon")
    command(bin_, "python", "")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": f"{bin_}:{os.environ['PATH']}"}
    environment["XDG_RUNTIME_DIR"] = str(tmp_path)

    def robots() -> dict[str, Any]:
        words = [str(bin_ / "lumiloop"), "fleet", "--json", "--router", address]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=60.0)
        return dict(json.loads(done.stdout)["robots"]) if done.returncode == 0 else {}

    log = tmp_path / "log"
    with log.open("w") as out:
        words = ["bash", "-c", script(address) + "\nwait\n"]
        walk = subprocess.Popen(words, cwd=tmp_path, env=environment, stdout=out, stderr=out, start_new_session=True)
    try:
        known: dict[str, str] = {}
        end = time.monotonic() + 120.0 + PATIENCE_S
        while set(known) != {"agv1", "agv2"} and time.monotonic() < end:
            time.sleep(2.0)
            for name, told in robots().items():
                if told.get("state") and told["state"]["state_name"] in KNOWS:
                    known[name] = told["pose"]["agvPosition"]["mapId"]
        subprocess.run(["bash", "-c", ending()], cwd=tmp_path, check=True)
        walk.wait(60.0)  # for each of them; the last look at the fleet may still be to come, and finds no router
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(walk.pid, signal.SIGTERM)
        walk.wait(20.0)
    assert set(known) == {"agv1", "agv2"}, log.read_text()
    assert known["agv1"] == known["agv2"], log.read_text()
    assert "Traceback" not in log.read_text()
