"""A played world: scenario files, the judge, and a robot computer that drives in it."""

import math
import os
import re
import subprocess
import sys
import threading
import tty
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools.bench.report.result import Seen
from tools.bench.world import agreement
from tools.bench.world.__main__ import twins
from tools.bench.world.judge import Played, Pose, Read, errors_of, judged, pictures
from tools.bench.world.local import robot
from tools.bench.world.scenario import BUILT_IN, Expectation, Scenario, find, load
from tools.bench.world.stage import standing

ROOT = Path(__file__).parents[4]
Floats = np.ndarray


# files


@pytest.mark.parametrize("path", sorted(BUILT_IN.glob("*.toml")), ids=lambda path: path.stem)
def test_scenarios_that_come_with_the_bench_are_whole(path: Path) -> None:
    made = load(path)
    assert made.title != path.stem
    assert all(one.until <= made.drive.seconds and one.from_ < made.drive.seconds for one in made.expect)
    assert made.scene(held=True).held
    assert find(path.stem) == path


# the judge


SCENARIO = Scenario("x", "x", expect=(Expectation("never", ("LOST",)),), faults=({"when": 3.0, "for": 1.0},))
SCENARIO = replace(SCENARIO, drive=replace(SCENARIO.drive, seconds=10.0))


def way(t: Floats) -> Floats:
    """East at 0.5 m/s from (1, 2), heading north."""
    return np.column_stack([1.0 + 0.5 * t, np.full(len(t), 2.0), np.full(len(t), math.pi / 2)])


def played(off: Callable[[float], float] = lambda t: 0.0, **change: object) -> Played:
    """Reads every 0.1 s, the pose 0.05 s old, ``off`` m to the robot's left of where it is."""
    reads = []
    for k in range(100):
        t = 0.1 * k
        y = -0.5 * max(t - 0.05, 0.0)  # seen from a robot that looks north, east is to the right
        pose = (off(t), y, 0.0)
        reads.append(replace(Read(t, "TRACKING", 0, t - 0.05, pose, 0.01, True, True), **change))  # type: ignore[arg-type]  # test shorthand
    return Played(SCENARIO, reads, lambda t: way(np.maximum(t, 0.0)), [(0.0, 0.0, 0.0)])


def test_a_pose_is_compared_with_the_truth_where_the_robot_said_it_was() -> None:
    assert errors_of(played()).metres.max() < 1e-9
    found = errors_of(played(lambda t: 0.2 if t > 5.0 else 0.0))
    assert found.metres.max() == pytest.approx(0.2)
    holds, seen = judged(Expectation("error", at_most=0.1), played(lambda t: 0.2))
    assert not holds
    assert "[lidar] mount = { x = 0.15 }" in seen.said
    assert "mount" not in judged(Expectation("error", at_most=0.15), played(lambda t: 0.2))[1].said
    assert judged(Expectation("error", at_most=0.1, until=4.0), played(lambda t: 0.2 if t > 5.0 else 0.0))[0]
    assert judged(Expectation("error", at_most=0.1, sigmas=11.0), played(lambda t: 0.2))[0]
    assert judged(Expectation("error", at_most=0.1), played(pose=None))[0] is False


@pytest.mark.parametrize(
    ("expected", "change", "passed"),
    [
        (Expectation("state", ("TRACKING",), from_=2.0, within=1.0), {}, True),
        (Expectation("state", ("NO_LIDAR",), from_=2.0, within=1.0), {}, False),
        (Expectation("state", ("TRACKING",), from_=2.0, within=1.0), {"answered": False}, False),
        (Expectation("never", ("TRACKING",)), {}, False),
        (Expectation("never", ("LOST",)), {}, True),
        (Expectation("never", ("LOST",)), {"answered": False, "state": ""}, False),
        (Expectation("share", ("TRACKING",), at_least=0.9), {}, True),
        (Expectation("share", ("TRACKING",), at_least=0.9), {"state": "DEGRADED"}, False),
        (Expectation("fault", (104,), within=1.0), {"fault": 104}, True),
        (Expectation("fault", (104,), within=1.0), {"fault": 101}, False),
        (Expectation("clear", within=1.0), {}, True),
        (Expectation("clear", within=1.0), {"fault": 101}, False),
        (Expectation("age", at_most=0.06), {}, True),
        (Expectation("age", at_most=0.04), {}, False),
        (Expectation("answers", at_least=0.99), {}, True),
        (Expectation("answers", at_least=0.99), {"answered": False}, False),
        (Expectation("lamps", at_least=0.9), {"lamps": ((7, 1e-6), (8, 1e-7))}, True),
        (Expectation("lamps", at_least=0.9), {"lamps": ((8, 1e-6), (7, 1e-7))}, False),
        (Expectation("lamps", at_least=0.9), {"lamps": ((7, 1e-6), (99, 1e-7))}, False),
        (Expectation("lamps", at_least=0.9), {}, False),
        (Expectation("never", ("LOST",), from_=50.0), {}, False),
    ],
)
def test_expectations_pass_and_fail(expected: Expectation, change: dict[str, object], passed: bool) -> None:
    run = replace(played(**change), lamps=frozenset({7, 8}), strongest=lambda t: 7)
    holds, seen = judged(expected, run)
    assert holds is passed
    assert isinstance(seen, Seen)
    assert len(pictures(run)) == 4


def test_two_runs_are_compared_at_equal_ways() -> None:
    one, other = played(), played(lambda t: 0.004)
    shifted = replace(other, reads=[replace(read, t_pose=read.t_pose + 0.031) for read in played().reads])
    _, gap = agreement.differences(agreement.trace(one), agreement.trace(other))
    assert gap == pytest.approx(0.004, abs=1e-6)
    assert agreement.differences(agreement.trace(one), agreement.trace(shifted))[1].max() > 0.01  # poses 31 ms too late
    seen, _ = agreement.figures(agreement.trace(one), agreement.trace(other), "x")
    assert seen[-1].value == pytest.approx(4.0, abs=1e-3)
    assert seen[0].value == pytest.approx(1.45, abs=0.06), "to the fault at 3 s"


def told(off_m: float, again: float = math.inf, counted: bool = True) -> Played:
    """The map lies in the survey from 4 s on, until ``again``, which jumps that are ``counted`` have done."""
    run = replace(played(), lamps=frozenset({7}))
    site = [(*xy, yaw) for *xy, yaw in way(np.array([max(one.t_pose, 0.0) for one in run.reads])).tolist()]
    reads = [
        replace(one, pose=(x + off_m, y, yaw), jumps=int(counted)) if 4.0 < one.t < again else one
        for one, (x, y, yaw) in zip(run.reads, site, strict=True)
    ]
    return replace(run, reads=reads)


def test_under_surveyed_lamps_the_map_lies_in_the_survey_once_light_has_told() -> None:
    """Until then where the robot said it was while it stood; a pose that is off is off in either frame."""
    assert errors_of(told(0.0)).metres.max() < 1e-9
    assert np.abs(errors_of(told(0.0)).off[:, 2]).max() < 1e-9
    assert errors_of(told(0.3)).metres.max() == pytest.approx(0.3)
    assert errors_of(told(0.0, again=6.0)).metres.max() > 1.0, "a map that goes back to where it lay is no place"
    assert errors_of(replace(told(0.0), lamps=frozenset())).metres.max() > 1.0
    assert errors_of(told(0.0)).t_site == pytest.approx(4.05)


def test_two_runs_are_compared_until_one_closes_a_loop() -> None:
    """With which keyframe depends on the scans, and what that is good for is centimetres."""
    moved = played(lambda t: 0.02 if t > 2.0 else 0.0)
    closed = replace(moved, reads=[replace(one, loops=5 if one.t < 1.95 else 6) for one in moved.reads])
    at, gap = agreement.differences(agreement.trace(played()), agreement.trace(closed))
    assert gap.max() < 1e-9
    assert at[-1] == pytest.approx(0.9, abs=0.1)
    assert agreement.differences(agreement.trace(played()), agreement.trace(moved))[1].max() > 0.019
    whole = replace(SCENARIO, faults=())
    early = replace(moved, scenario=whole, reads=[replace(one, loops=int(one.t > 0.5)) for one in moved.reads])
    assert "could be compared" in twins(whole, early).said
    at_once = replace(moved, reads=[replace(one, loops=int(one.t > 0.05)) for one in moved.reads])
    way, _, largest = agreement.figures(agreement.trace(at_once), agreement.trace(moved), "x")[0]
    assert way.value == 0.0
    assert not largest.value <= 10.0, "what could not be compared does not agree"


@contextmanager
def null_modem() -> Generator[tuple[str, str]]:
    """Two serial ports with a cable between them."""
    (a, a_slave), (b, b_slave) = os.openpty(), os.openpty()
    for slave in (a_slave, b_slave):
        tty.setraw(slave)
    names = os.ttyname(a_slave), os.ttyname(b_slave)

    def carry(source: int, sink: int) -> None:
        with suppressed_end():
            while True:
                os.write(sink, os.read(source, 4096))

    threads = [threading.Thread(target=carry, args=pair, daemon=True) for pair in ((a, b), (b, a))]
    for thread in threads:
        thread.start()
    try:
        yield names
    finally:
        for fd in (a_slave, b_slave):
            os.close(fd)
        for thread in threads:
            thread.join(2.0)
        for fd in (a, b):
            os.close(fd)


@contextmanager
def suppressed_end() -> Generator[None]:
    try:
        yield
    except OSError:
        return


@pytest.mark.system
def test_a_robot_computer_drives_in_the_played_world(tmp_path: Path) -> None:
    """`lumiloop run` at one end of a serial cable, the bench at the other, faults included."""
    file = tmp_path / "short.toml"
    file.write_text(
        '[drive]\nseconds = 18.0\n[[fault]]\nwhat = "silence"\nwhere = "lidar"\nwhen = 8.0\nfor = 2.0\n'
        '[[expect]]\nwhat = "state"\nis = ["NO_LIDAR", "DEGRADED"]\nfrom = 8.0\nwithin = 3.0\n'
        '[[expect]]\nwhat = "state"\nis = ["TRACKING"]\nfrom = 10.0\nwithin = 6.0\n'
        '[[expect]]\nwhat = "error"\nuntil = 8.0\nat_most = 0.1\nsigmas = 3.0\n'
    )
    scenario = load(file)
    with null_modem() as (here, there), robot(scenario, serial=there) as ends:
        host, port = ends.modbus
        words = ["--lidar", here, "--modbus", f"{host}:{port}", "--odometry", ends.odometry]
        command = [sys.executable, "-m", "tools.bench.world", str(file), *words, "--out", str(tmp_path / "out")]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 of 3 as expected" in done.stdout
    assert "<svg" in (tmp_path / "out" / "report.html").read_text()


def test_the_scenario_of_the_page_is_one(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "bench.md").read_text()
    (text,) = [block.partition("```")[0] for block in page.split("```toml\n")[1:] if "[[expect]]" in block]
    (tmp_path / "my.toml").write_text(text)
    made = load(tmp_path / "my.toml")
    assert {fault["what"] for fault in made.faults} == {"silence", "carry"}
    assert max(one.until for one in made.expect) == 35.0


LAP = load(BUILT_IN / "lap.toml")
POLL_S, TIMEOUT_S, PERIOD_S = 0.011, 0.5, 0.2
"""An answered read, one that nobody answers, and from one pose to the next."""
MUTE_S = (10.0, 19.0)
ANSWERS = Expectation("answers", at_least=0.99)
SHARE = Expectation("share", ("TRACKING",), at_least=0.9)
ERROR = Expectation("error", at_most=0.1, sigmas=3.0)


def lap(mute_s: tuple[float, float] = (0.0, 0.0), still_s: tuple[float, float] = (0.0, 0.0)) -> Played:
    """A drive without an error, polled as a robot computer is; meanwhile it is mute, or says one thing all the time."""
    reads: list[Read] = []
    t = last = 0.0
    while t < LAP.drive.seconds - TIMEOUT_S:
        mute = mute_s[0] <= t < mute_s[1]
        t += TIMEOUT_S if mute else POLL_S
        if mute:
            reads.append(Read(t, answered=False))
            continue
        made = last if still_s[0] <= t < still_s[1] else t // PERIOD_S * PERIOD_S
        pose = (0.0, -0.5 * made, 0.0)
        reads.append(Read(t, "TRACKING", 0, made, pose, 0.01, True, made != last))
        last = made
    return Played(LAP, reads, way, [(0.0, 0.0, 0.0)])


@pytest.mark.parametrize("expected", [ANSWERS, SHARE, ERROR])
def test_a_robot_computer_that_is_mute_for_a_part_of_the_drive_is_not_as_expected(expected: Expectation) -> None:
    """18 reads of 2000 that nobody answers are nine seconds of 32."""
    assert judged(expected, lap())[0]
    assert not judged(expected, lap(mute_s=MUTE_S))[0]


def test_an_error_is_judged_only_where_new_poses_come_all_along() -> None:
    """Mute, or answering from a cycle that stands still; how long is allowed may be said."""
    for part in (lap(mute_s=(10.0, 12.0)), lap(still_s=(10.0, 12.0))):
        holds, seen = judged(ERROR, part)
        assert not holds
        told = re.search(r"no new pose for (\d\.\d) s from (\d+\.\d) s on, where 1 s are allowed \(gap\)", seen.said)
        assert told, seen.said
        assert (float(told[1]), float(told[2])) == pytest.approx((2.1, 9.9), abs=0.2)
        assert judged(replace(ERROR, gap=2.5), part)[0]
        assert judged(replace(ERROR, until=10.0), part)[0]
        assert judged(replace(ERROR, from_=12.2), part)[0]
    assert judged(ERROR, lap(still_s=(10.0, 10.5)))[0], "some periods"


BEGUN = 100.0
HERE: Pose = (1.0, 2.0, math.pi)


def heard(since: float, until: float, pose: Pose = HERE, state: str = "TRACKING") -> list[Read]:
    """A new pose ten times a second, each read twice; stamps are a twentieth of a second old."""
    reads = []
    for k in range(round(10.0 * (until - since))):
        t = since + 0.1 * k
        one = Read(t, state, 0, t - 0.05, pose, fresh=True)
        reads += [one, replace(one, t=t + 0.05, fresh=False)]
    return reads


def test_a_pose_that_stays_for_two_seconds_is_where_it_stands() -> None:
    assert standing(heard(100.1, 101.9), BEGUN) is None
    poses = standing(heard(100.1, 102.5), BEGUN)
    assert poses is not None
    assert set(poses) == {HERE}
