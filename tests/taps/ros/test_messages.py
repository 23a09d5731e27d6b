"""What other programs would take wrongly: maps that are gone, beams without an echo."""

import zlib
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

pytest.importorskip("rosbags", reason="pip install 'lumiloop[mcap]'")
from rosbags.typesys import Stores, get_typestore

from daemon.config.schema import Mount
from daemon.publish.stream.messages import MapTiles, Pose, Scan
from daemon.publish.stream.server import SIDE, scan_message
from daemon.snapshot import State
from taps.ros.messages import REPEAT_S, Translator
from tests.daemon.publish.stream.test_server import GEOMETRY, raw_scan

STORE = get_typestore(Stores.ROS2_HUMBLE)


def pose(t: float) -> Pose:
    return Pose(seq=1, t_mono=t, t_sent=t, t_utc=1.7e9 + t, state=3, state_name="TRACKING", reason=0)


def tile(fill: int) -> MapTiles:
    cells = zlib.compress(np.full((SIDE, SIDE), fill, np.int8).tobytes())
    return MapTiles(map_id=1, resolution=0.05, side=SIDE, unit=0.1, version=1, more=False, tiles=((2, 3, cells),))


def told(translator: Translator, topic: str, *frames: Any) -> list[Any]:
    out = [one for frame in frames for one in translator.convert(frame) if one.topic == topic]
    kind = {
        "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/map": "nav_msgs/msg/OccupancyGrid",
        "/scan": "sensor_msgs/msg/LaserScan",
    }[topic]
    return [STORE.deserialize_cdr(one.data, kind) for one in out]


def test_a_map_that_was_reset_does_not_stay_latched() -> None:
    """The last message on a latched topic is what everybody gets who comes later: it was the map that had gone."""
    translator = Translator(Mount())
    (before,) = told(translator, "/map", tile(20), pose(1.0))
    assert set(before.data) == {100}
    (after,) = told(translator, "/map", tile(0), pose(2.0), pose(2.0 + REPEAT_S))
    assert (after.info.width, after.info.height, list(after.data)) == (1, 1, [-1])
    assert not told(translator, "/map", pose(3.0 + 2.0 * REPEAT_S))


def test_beams_without_an_echo_are_infinite_and_those_that_say_nothing_are_no_number() -> None:
    """REP-117."""
    raw = replace(raw_scan(), code=np.array([GEOMETRY.dmax + 1, 0, 8], np.int32), ranges=np.zeros(3, np.int32))
    (scan,) = told(Translator(Mount()), "/scan", pose(1.0), msgspec.convert(scan_message(raw), Scan))
    np.testing.assert_array_equal(scan.ranges, np.array([np.inf, np.nan, np.nan], np.float32))


@pytest.mark.parametrize("state", list(State))
def test_a_guess_is_no_pose(state: State) -> None:
    """Who reads /pose alone takes it for where the robot is, as evo does; trajectories leave guesses out, too."""
    known = msgspec.structs.replace(pose(1.0), pose=(1.0, 2.0, 0.5), covariance=(1.0, 0.0, 1.0, 0.0, 0.0, 1.0))
    found = told(Translator(Mount()), "/pose", msgspec.structs.replace(known, state=int(state)))
    assert len(found) == (state not in (State.LOST, State.RELOCATING, State.AMBIGUOUS))


PLACES = ("/pose", "/odom", "/tf")


def placed(t: float, x: float, utc: float = 1.7e9) -> Pose:
    """A snapshot with a pose at ``t`` (s), sent 10 ms later; ``utc``: minus CLOCK_MONOTONIC."""
    T = (x, 0.0, 0.0)
    return msgspec.structs.replace(
        pose(t), pose=T, odom=T, covariance=(0.01, 0.0, 0.01, 0.0, 0.0, 0.01), t_sent=t + 0.01, t_utc=utc + t + 0.01
    )


def stamps(translator: Translator, *frames: Any) -> dict[str, list[int]]:
    """Stamps of the poses of each topic, ns, in order of appearance."""
    out = [one for frame in frames for one in translator.convert(frame) if one.topic in PLACES]
    return {topic: [one.t_ns for one in out if one.topic == topic] for topic in PLACES}


def test_no_two_poses_have_one_stamp() -> None:
    """A cycle without a new measurement, a late correction of the same instant, and a snapshot of an earlier one."""
    translator = Translator(Mount())
    frames = [
        placed(t, x) for t, x in ((1.0, 0.0), (1.0, 0.0), (1.025, 0.1), (1.025, 0.7), (1.01, 0.1), (1.0250001, 0.8))
    ]
    found = stamps(translator, *frames, placed(1.05, 0.8))
    assert found == {key: [round(1000000.0 * (1700000000.0 + t)) * 1000 for t in (1.0, 1.025, 1.05)] for key in PLACES}


def test_poses_stay_in_order_over_a_restart_of_the_daemon() -> None:
    translator = Translator(Mount())
    before = stamps(translator, placed(1.0, 0.0), placed(1.025, 0.0))
    translator.restart()
    after = stamps(translator, placed(1.025, 5.0, 1.7e9 - 0.3), placed(1.05, 5.0, 1.7e9 - 0.3))
    assert [t_ns / 1e9 for t_ns in after["/pose"]] == [1.7e9 + 1.05]
    assert before["/pose"][-1] < after["/pose"][0]


@pytest.mark.parametrize("ordered", [True, False], ids=["file", "live"])
def test_utc_that_is_set_back_goes_into_live_topics_and_not_into_a_file(ordered: bool) -> None:
    """Other nodes follow the computer's clock; a file stays readable in one pass."""
    translator = Translator(Mount(), ordered=ordered)
    found = stamps(translator, placed(1.0, 0.0), placed(2.0, 0.0, 1.7e9 - 3600.0), placed(3.0, 0.0, 1.7e9 - 3600.0))
    back = 0.0 if ordered else 3600.0
    assert [t_ns / 1e9 for t_ns in found["/pose"]] == [1.7e9 + 1.0, 1.7e9 + 2.0 - back, 1.7e9 + 3.0 - back]
    forward = stamps(translator, placed(4.0, 0.0, 1.7e9 + 60.0))
    assert forward["/pose"] == [round(1.7e9 + 64.0) * 10**9]
