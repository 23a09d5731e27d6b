"""The shipped program on the device: it finds it, runs on it, survives its cable, and learns from a walk with it."""

import re
import subprocess
import time

import numpy as np
import pytest

from tests.hil.conftest import Telling
from tests.hil.programs import ROOT, Daemon, Served, daemon, probed
from tests.hil.walking import Walked
from tools.bench.report.plots import Plot, Series, histogram

MILLI = 1e3
STILL_M = 0.02
OF_TIME = frozenset({107, 301, 302, 303, 304})
"""Too busy a computer: told, and no matter of the device."""


@pytest.mark.realtime
def test_probe_finds_it(served: Served, lumiloop: list[str], told: Telling) -> None:
    """`lumiloop probe` says who it is."""
    (found,) = probed(lumiloop, served.device)
    told.say(str(found))
    assert "problem" not in found, f"{found['problem']}: {found['remedy']}"
    assert str(found["protocol"]).startswith("SCIP")
    assert found["serial"]


@pytest.mark.system
def test_runs(served: Served, lumiloop: list[str], told: Telling) -> None:
    """`lumiloop run`: a pose soon, no fault, steady while it stands, and it ends when told to, the laser off."""
    with daemon(lumiloop, served) as running:
        seconds = running.until(60.0, "MAPPING", "TRACKING")
        running.until(60.0, "TRACKING")
        reads = _collected(running, 5.0)
        code, took = running.stop()
    poses = np.array([(one["x"], one["y"]) for one in reads], dtype=float)
    wander = np.hypot(*(poses - poses.mean(axis=0)).T)
    told.figure("first pose after", seconds, "s", worse="more", room=3.0)
    told.figure("pose wanders by", MILLI * float(wander.max()), "mm", worse="more", room=5.0)
    ages = [MILLI * float(one["age"]) for one in reads if one["age"] is not None]
    told.figure("age of a pose that is read, median", float(np.median(ages)), "ms", worse="more", room=10.0)
    told.plot(histogram("age of poses that were read", "ms", ages))
    faults = {int(one["fault"]) for one in reads} - {0}
    told.say(f"faults: {sorted(faults) or 'none'}; {sorted(OF_TIME)} are the computer's, not the device's")
    assert faults <= OF_TIME, running.tail()
    assert wander.max() < STILL_M
    assert (code, "Traceback" in running.tail()) == (0, False)
    assert took < 10.0
    (found,) = probed(lumiloop, served.device)
    assert "problem" not in found, f"after the daemon has gone: {found}"


@pytest.mark.system
@pytest.mark.needs("operator")
def test_survives_its_cable(served: Served, lumiloop: list[str], told: Telling) -> None:
    """The lidar unplugged while it runs: said at once; plugged in again: TRACKING by itself, the same process."""
    assert served.operator is not None
    with daemon(lumiloop, served) as running:
        running.until(90.0, "TRACKING")
        served.operator.tell("pull the lidar's cable", "order hangup where=lidar")
        shown = running.until(5.0, "NO_LIDAR", "DEGRADED")
        time.sleep(1.0)
        fault = running.read().get("fault")
        served.operator.tell("connect it again", "clear hangup lidar")
        back = running.until(30.0, "TRACKING")
    told.figure("shown after", shown, "s", worse="more", room=0.5)
    told.figure("TRACKING again after", back, "s", worse="more", room=3.0)
    told.say(f"fault {fault}")
    assert fault in (101, 104), running.tail()
    assert "Traceback" not in running.log.read_text()


@pytest.mark.system
@pytest.mark.needs("motion")
@pytest.mark.timeout(1200)
def test_calibration_walk(walk: Walked, lumiloop: list[str], told: Telling) -> None:
    """A walk with curves both ways, recorded; `lumiloop calibrate` learns wheels and mount from it."""
    out = walk.folder / "calibrated.toml"
    words = [*lumiloop, "calibrate", str(walk.recording), "--odometry", "--lidar-mount", "--out", str(out)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    told.say(done.stdout)
    for name, value, sigma, unit in FOUND.findall(done.stdout):
        told.figure(f"{name}, one sigma", float(sigma), unit, worse="more", share=1.0)
        told.figure(name, float(value), unit)
    way = np.array(walk.way, dtype=float)
    told.plot(Plot("the walk", "x m", "y m", (Series("", way[:, 0].tolist(), way[:, 1].tolist()),), square=True))
    length = float(np.hypot(*np.diff(way, axis=0).T).sum())
    told.figure("driven", length, "m")
    told.figure("read as TRACKING", 100.0 * walk.tracked, "%", worse="less", share=0.1)
    assert length > 2.0, f"{length:.1f} m is no walk: drive while it records"
    assert walk.tracked > 0.8
    assert out.exists()
    assert out.with_suffix(".png").exists()
    if walk.mount is not None:
        told_mount = {name: float(value) for name, value, _, _ in FOUND.findall(done.stdout)}
        assert told_mount["mount_x"] == pytest.approx(walk.mount[0], abs=0.05)
        assert told_mount["mount_yaw"] == pytest.approx(walk.mount[2], abs=1.0)


FOUND = re.compile(r"^(\w+) +(-?[\d.]+) \+-([\d.]+) ?(m|deg/m|deg)?", re.MULTILINE)


def _collected(running: Daemon, seconds: float) -> list[dict[str, float | int | str | None]]:
    """What is read in so many seconds."""
    reads, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        reads.append(running.read())
        time.sleep(0.03)
    return [one for one in reads if one]
