"""What a cycle pays for a state that is taken: little, however many submaps there are."""

from dataclasses import replace

import pytest

from daemon.recording.checkpoint import capture
from daemon.recording.restore import restore
from estimator.measurements import UNLIMITED, LightEpoch, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import step
from estimator.state import State
from estimator.stored_map import restored
from tests.daemon.support.map_maker import Shape, image
from tests.estimator.lit import lit_state, scans, together
from tools.sim.light.link_drive import room_run


def state(submaps: int, loose: int = 0) -> State:
    return restored(image(Shape(submaps=submaps, frames=1, beams=3, loose=loose)))


def test_what_is_copied_at_once_does_not_grow_with_the_submaps() -> None:
    few, many = (capture(state(count, loose=count - 1), {}).copied_bytes for count in (4, 104))
    assert many - few < 100, "not even a reference to each"


def test_submaps_are_those_that_were_there_when_it_was_taken() -> None:
    before = state(5)
    keys, places = list(before.map.graph.submaps), [submap.place() for submap in before.map.graph.submaps.values()]
    taken = capture(before, {"one": before.map.graph.submaps[keys[2]]})
    del before.map.graph.submaps[keys[0]]
    after, rest = restore(taken.nodes())
    assert list(after.map.graph.submaps) == keys
    assert rest["one"] is after.map.graph.submaps[keys[2]]
    assert all(
        (one.place() == place).all() for one, place in zip(after.map.graph.submaps.values(), places, strict=True)
    )


@pytest.mark.jit
def test_a_drive_in_which_the_laser_tells_light_the_way_goes_on_from_any_moment() -> None:
    """The same poses to the last bit, also between a scan and the next, and in the middle of a leap."""
    run = replace(room_run(seed=4, people=0), seconds=12.0)
    first, then = lit_state(run), None
    guided = 0
    pending: list[Record] = []
    for count, record in enumerate(together(run.light(), scans(run))):
        pending.append(record)
        if not isinstance(record, Scan | LightEpoch):
            continue
        if count % 37 == 36:
            then, _ = restore(capture(first, {}).nodes())
            assert first.light is not None
            guided += first.light.has_motion
        if isinstance(record, Scan) and 6.0 < record.t_end < 6.3:  # somebody stands before it, all at once
            record = pending[-1] = replace(record, range_m=record.range_m.clip(max=1.5))
        one = step(first, pending, UNLIMITED)
        two = step(then, pending, UNLIMITED) if then is not None else one
        pending = []
        poses = [se2.compose(result.T_map_odom, result.T_odom_base) for result in (one, two)]
        assert (poses[0] == poses[1]).all()
        assert (one.covariance == two.covariance).all()
    assert guided > 3
