"""What a result promises beyond its pose: its frame, that it stays as it was, an uncertainty that is not too small."""

import math

import numpy as np
import pytest

from estimator.measurements import UNLIMITED, Array, Beam, Command, Odometry, Order, Scan
from estimator.numerics import se2
from estimator.pipeline import new_state, step

BEARING = np.radians(np.linspace(-135.0, 135.0, 541))
PERIOD = 0.1
FAR = 12.0


def corridor(t: float, seq: int) -> Scan:
    """A plain corridor along the lidar's x axis, 2 m wide, whose ends are out of sight."""
    side = np.abs(np.sin(BEARING))
    reach = 1.0 / np.maximum(side, 1e-9) + np.random.default_rng(seq).normal(0.0, 0.01, len(BEARING))
    kind = np.where(reach < FAR, np.uint8(Beam.HIT), np.uint8(Beam.NONE))
    return Scan(t, t, seq, np.zeros(3), BEARING, reach, kind, 0.01)


def known(yaw: float) -> Array:
    """Axes said to be known in the corridor when a person has said that it lies at ``yaw`` in the map."""
    state = new_state()
    for seq in range(5):
        step(state, [corridor(PERIOD * seq, seq)], UNLIMITED)
    pose = np.array((3.0, 4.0, yaw))
    step(state, [Command(5 * PERIOD, Order.SET_POSE, pose)], UNLIMITED)
    result = step(state, [corridor(6 * PERIOD, 6)], UNLIMITED)
    assert result.match is not None
    assert result.match.ok
    return result.known_axes


def test_known_axes_are_those_of_the_map_frame() -> None:
    assert known(0.0).tolist() == [0.0, 1.0, 1.0]
    assert known(0.5 * math.pi).tolist() == [1.0, 0.0, 1.0], "the corridor runs along y of the map"
    assert known(0.25 * math.pi).tolist() == [0.0, 0.0, 1.0], "neither axis alone says where along the corridor it is"


def test_a_result_stays_as_it_was() -> None:
    state = new_state()
    first = None
    before: dict[str, Array] = {}
    for seq in range(8):
        moved = Odometry(PERIOD * (seq - 1), PERIOD * seq, np.array((0.02 * seq, 0.0, 0.0)))
        result = step(state, [corridor(PERIOD * seq, seq), moved], UNLIMITED)
        if first is None:
            first = result
            before = {name: np.copy(getattr(result, name)) for name in ("T_odom_base", "velocity", "covariance")}
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(first, name), value, err_msg=name)


@pytest.mark.parametrize("silence", [3.0, 15.0, 60.0])
def test_a_gap_that_nothing_witnessed_leaves_a_wide_uncertainty(silence: float) -> None:
    state = new_state()
    for seq in range(10):
        step(state, [corridor(PERIOD * seq, seq)], UNLIMITED)
    later = step(state, [corridor(PERIOD * 10 + silence, 10)], UNLIMITED)
    along, across = np.sqrt(np.diag(later.covariance))[:2]
    assert along > 0.3 * (silence - 1.0), "a robot may have driven on at walking pace"
    assert across < max(0.05, 2e-3 * along), "the walls say where it is across, a tenth of a degree left open"
    assert np.isfinite(later.T_odom_base).all()


def test_a_gap_that_odometry_bridged_does_not() -> None:
    state = new_state()
    for seq in range(10):
        step(state, [corridor(PERIOD * seq, seq)], UNLIMITED)
    end = 9 * PERIOD
    for _ in range(600):
        step(state, [Odometry(end, end + 0.05, np.array((0.02, 0.0, 0.0)))], UNLIMITED)
        end += 0.05
    later = step(state, [corridor(end, 10)], UNLIMITED)
    assert math.sqrt(later.covariance[0, 0]) < 0.5, "12 m at a few per cent"
    assert se2.between(np.zeros(3), later.T_odom_base)[0] == pytest.approx(12.0, abs=0.1)
