"""Bad scans through the whole step, by each method: a reason, no exception, no wrong pose, and it goes on."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimator.measurements import UNLIMITED, Array, Beam, Odometry, Record, Scan
from estimator.numerics import se2
from estimator.paper import LUMILOOP, METHODS, method
from estimator.pipeline import Settings, State, new_state, step
from estimator.result import Reason, StepResult
from tests.estimator.scan_matching.test_bad_input import OUTSIDE
from tests.estimator.test_pipeline import BEARING, path, scan_at

pytestmark = pytest.mark.jit

N = len(BEARING)
STILL = np.zeros(3)
BENT = np.concatenate((BEARING[: N // 2], BEARING[N // 2 :][::-1]))

MALFORMED: dict[str, Callable[[Scan], Scan]] = {
    "a range too few": lambda scan: replace(scan, range_m=scan.range_m[:-1].copy()),
    "a beam too many": lambda scan: replace(scan, beam=np.append(scan.beam, np.uint8(1))),
    "single precision": lambda scan: replace(scan, range_m=scan.range_m.astype(np.float32)),
    "every second of an array": lambda scan: replace(scan, range_m=np.repeat(scan.range_m, 2)[::2]),
    "kinds that are no bytes": lambda scan: replace(scan, beam=scan.beam.astype(np.int64)),
    "two dimensions": lambda scan: replace(
        scan, bearing_rad=BEARING[None].copy(), range_m=scan.range_m[None].copy(), beam=scan.beam[None].copy()
    ),
    "a bearing that is no number": lambda scan: replace(scan, bearing_rad=np.where(np.arange(N) == 7, np.nan, BEARING)),
    "a bearing without end": lambda scan: replace(scan, bearing_rad=np.where(np.arange(N) == N - 1, np.inf, BEARING)),
    "one bearing for all": lambda scan: replace(scan, bearing_rad=np.zeros(N)),
    "bearings that hardly differ": lambda scan: replace(scan, bearing_rad=1e-300 * np.arange(N)),
    "a field of a degree": lambda scan: replace(scan, bearing_rad=np.linspace(0.0, np.radians(1.0), N)),
    "a field of twenty degrees, clockwise": lambda scan: replace(scan, bearing_rad=np.linspace(0.35, 0.0, N)),
    "beams in a bunch, and one away from it": lambda scan: replace(
        scan, bearing_rad=np.append(np.linspace(0.0, 0.1, N - 1), 2.0)
    ),
    "bearings that turn back": lambda scan: replace(scan, bearing_rad=BENT),
    "bearings of two turns": lambda scan: replace(scan, bearing_rad=np.linspace(-7.0, 7.0, N)),
    "a mount that is no number": lambda scan: replace(scan, T_base_lidar=np.array((0.0, np.nan, 0.0))),
    "a mount without end": lambda scan: replace(scan, T_base_lidar=np.array((0.0, 0.0, np.inf))),
    "a mount a mile away": lambda scan: replace(scan, T_base_lidar=np.array((1609.0, 0.0, 0.0))),
    "a mount turned beyond all digits": lambda scan: replace(scan, T_base_lidar=np.array((0.0, 0.0, 1e300))),
    "a mount of twenty turns": lambda scan: replace(scan, T_base_lidar=np.array((0.0, 0.0, 40.0 * np.pi))),
    "bearings a million turns on": lambda scan: replace(scan, bearing_rad=BEARING + 2e6 * np.pi),
    "a mount of two numbers": lambda scan: replace(scan, T_base_lidar=np.zeros(2)),
    "noise that is no number": lambda scan: replace(scan, sigma_m=np.nan),
    "noise below nothing": lambda scan: replace(scan, sigma_m=-0.01),
    "noise without end": lambda scan: replace(scan, sigma_m=np.inf),
    "no time": lambda scan: replace(scan, t_begin=np.nan, t_end=np.nan),
    "the end of time": lambda scan: replace(scan, t_end=np.inf),
    "an end before its beginning": lambda scan: replace(scan, t_begin=scan.t_end + 0.01),
    "a sweep of a year": lambda scan: replace(scan, t_begin=scan.t_end - 3.2e7),
}

WITHOUT_POINTS: dict[str, Callable[[Scan], Scan]] = {
    "no beams": lambda scan: replace(scan, bearing_rad=BEARING[:0], range_m=np.empty(0), beam=np.empty(0, np.uint8)),
    "three beams": lambda scan: replace(scan, bearing_rad=BEARING[:3], range_m=np.ones(3), beam=np.ones(3, np.uint8)),
    "nothing said": lambda scan: replace(scan, beam=np.full(N, Beam.NONE, np.uint8)),
    "all free": lambda scan: replace(scan, beam=np.full(N, Beam.FREE, np.uint8)),
    "unknown kinds": lambda scan: replace(scan, beam=np.full(N, 77, np.uint8)),
    **{
        f"ranges of {value}": lambda scan, value=value: replace(scan, range_m=np.full(N, value))  # type: ignore[misc]
        for value in (np.nan, np.inf, -np.inf, -1.0, 0.0, -0.0, 1e9, 1e300)
    },
}

MISFITS: dict[str, Callable[[Scan], Scan]] = {
    "inside a wall": lambda scan: replace(scan, range_m=np.full(N, 0.02)),
    "inside a rough wall": lambda scan: replace(scan, range_m=np.random.default_rng(1).uniform(0.02, 0.06, N)),
    "covered by a cloth": lambda scan: replace(scan, range_m=np.full(N, 0.3)),
    "a random range for each beam": lambda scan: replace(scan, range_m=np.random.default_rng(2).uniform(0.1, 30.0, N)),
    "mounted the other way": lambda scan: replace(scan, T_base_lidar=np.array((0.0, 0.0, np.pi))),
    "a room of half the size": lambda scan: replace(scan, range_m=0.5 * scan.range_m),
}


def settled(name: str, scans: int = 12) -> tuple[State, Array]:
    """A robot that has come to a stop after a short drive, and where it is."""
    state = method(name)(Settings(), None).state
    truth, noise = path(60)[:scans], np.random.default_rng(1)
    for k, T in enumerate(truth):
        records: list[Record] = [scan_at(T, 0.05 * k, k, noise)]
        if k:
            records.append(Odometry(0.05 * (k - 1), 0.05 * k, se2.between(truth[k - 1], T)))
        step(state, records, UNLIMITED)
    for _ in range(10):
        t = state.motion.t_mono + 0.05
        stand(state, t, scan_at(truth[-1], t, 49, noise))
    return state, truth[-1]


def stand(state: State, t: float, scan: Scan | None) -> StepResult:
    """Wheels that say that the robot stands, and a scan."""
    wheels = Odometry(state.motion.t_odometry, t, STILL)
    return step(state, [wheels] if scan is None else [wheels, scan], UNLIMITED)


def honest(result: StepResult, truth: Array) -> bool:
    """Finite; and what it claims to know is right, to 5 cm or to its own ellipse."""
    e = se2.compose(result.T_map_odom, result.T_odom_base) - truth
    e[2] = se2.wrap(e[2])
    finite = np.isfinite(result.T_odom_base).all() and np.isfinite(result.covariance).all()
    inside = float(e @ np.linalg.solve(result.covariance + np.diag((1e-6, 1e-6, 1e-7)), e)) < OUTSIDE
    return bool(finite) and (bool(np.hypot(e[0], e[1]) < 0.05) or inside)


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_no_scan_is_refused(name: str) -> None:
    state, T = settled(LUMILOOP, 4)
    before = state.motion.T_odom_base
    scan = MALFORMED[name](scan_at(T, 0.7, 50))
    result = stand(state, 0.7, scan)
    assert result.match is not None
    assert result.match.reason is Reason.MALFORMED
    np.testing.assert_allclose(result.T_odom_base, before, atol=1e-9)
    assert honest(result, T)
    again = stand(state, 0.75, scan_at(T, 0.75, 51))
    assert again.match is not None
    assert again.match.ok
    assert again.t_mono == 0.75


@pytest.mark.parametrize("name", MALFORMED)
def test_a_robot_that_is_switched_on_with_it_waits_for_a_scan(name: str) -> None:
    state = new_state()
    result = step(state, [MALFORMED[name](scan_at(STILL, 0.2, 50))], UNLIMITED)
    assert result.match is not None
    assert result.match.reason is Reason.MALFORMED
    assert result.keyframe < 0
    first = step(state, [scan_at(STILL, 0.3, 51)], UNLIMITED)
    assert first.keyframe > 0


@pytest.mark.parametrize("method_name", METHODS)
def test_scans_without_points_say_so(method_name: str) -> None:
    state, T = settled(method_name)
    t, before = 1.2, state.motion.T_odom_base
    for k, change in enumerate(WITHOUT_POINTS.values()):
        result = stand(state, t + 0.05 * k, change(scan_at(T, t + 0.05 * k, 50 + k)))
        assert result.match is not None
        assert result.match.reason is Reason.TOO_FEW_POINTS
        np.testing.assert_allclose(result.T_odom_base, before, atol=1e-9)
        assert honest(result, T)
    again = stand(state, 2.5, scan_at(T, 2.5, 99))
    assert again.match is not None
    assert again.match.ok


@pytest.mark.parametrize("method_name", METHODS)
@pytest.mark.parametrize("name", MISFITS)
def test_scans_that_fit_nowhere_move_nothing(name: str, method_name: str) -> None:
    """Two are passed over; a third in a row begins the map anew, at the place where the robot is."""
    state, T = settled(method_name)
    for k in range(5):
        t = 1.2 + 0.05 * k
        result = stand(state, t, MISFITS[name](scan_at(T, t, 50 + k)))
        assert result.match is not None
        assert not result.match.ok or k > 2
        assert honest(result, T)
    for k in range(5):
        t = 1.6 + 0.05 * k
        result = stand(state, t, scan_at(T, t, 80 + k))
        assert honest(result, T)
    assert result.match is not None
    assert result.match.ok


@pytest.mark.parametrize("method_name", METHODS)
def test_a_scan_from_before_is_too_late(method_name: str) -> None:
    state, T = settled(method_name)
    far = path(60)[0]
    late = stand(state, 1.2, scan_at(far, 0.3, 3))
    assert late.match is not None
    assert late.match.reason is Reason.LATE
    assert honest(late, T)
    same = stand(state, 1.25, scan_at(T, 1.25, 51))
    assert same.match is not None
    assert same.match.ok


def test_a_clock_that_was_set_back_costs_one_scan() -> None:
    state, T = settled(LUMILOOP)
    said = [step(state, [scan_at(T, 0.05 * k - 100.0, k)], UNLIMITED) for k in range(5)]
    assert [result.match.reason for result in said if result.match is not None] == [
        Reason.LATE,
        *[Reason.CONVERGED] * 4,
    ]
    assert all(honest(result, T) for result in said)


@pytest.mark.parametrize("method_name", METHODS)
def test_the_same_scan_again_and_again_is_the_same_place(method_name: str) -> None:
    """A stuck device: what is known does not shrink to nothing, and the pose stays."""
    state, T = settled(method_name)
    scan = scan_at(T, 1.2, 50, np.random.default_rng(4))
    for _ in range(40):
        result = step(state, [scan], UNLIMITED)
        assert result.match is not None
        assert result.match.ok
        assert honest(result, T)
    again = stand(state, 1.3, scan_at(T, 1.3, 51))
    assert again.match is not None
    assert again.match.ok


@pytest.mark.parametrize("method_name", METHODS)
def test_a_scan_that_is_repeated_while_the_wheels_drive_is_no_measurement(method_name: str) -> None:
    """A lidar whose driver or relay sends one scan again and again: the wheels carry the pose, as far as they do."""
    state, T = settled(method_name)
    noise, ahead = np.random.default_rng(4), np.array((0.02, 0.0, 0.0))
    frozen, said = scan_at(T, 1.2, 50, noise), list[StepResult]()
    frozen.beam[:9], frozen.range_m[:9] = int(Beam.NONE), np.nan
    for _ in range(20):
        T = se2.compose(T, ahead)
        t = state.motion.t_mono + 0.05
        wheels = Odometry(state.motion.t_odometry, t, ahead)
        said.append(step(state, [wheels, replace(frozen, t_begin=t, t_end=t)], UNLIMITED))
    reasons = [result.match.reason for result in said if result.match is not None]
    assert reasons[4:] == [Reason.REPEATED] * 16
    assert np.abs(said[-1].T_odom_base - T)[0] < 0.1
    assert honest(said[-1], T)
    back = stand(state, state.motion.t_mono + 0.05, scan_at(T, state.motion.t_mono + 0.05, 51, noise))
    assert back.match is not None
    assert back.match.ok
    assert honest(back, T)


def test_a_hundred_thousand_beams() -> None:
    """Two hundred times the map's density, no error, no other place."""
    state, T = settled(LUMILOOP)
    n = 100_000
    bearing = np.linspace(BEARING[0], BEARING[-1], n)
    ranges = np.interp(bearing, BEARING, scan_at(T, 0.0, 0).range_m)
    ranges += np.random.default_rng(1).normal(0.0, 0.01, n)
    scan = Scan(1.2, 1.2, 50, STILL.copy(), bearing, ranges, np.ones(n, np.uint8), 0.01)
    result = stand(state, 1.2, scan)
    assert result.match is not None
    assert result.match.ok
    assert result.match.queries == n
    assert honest(result, T)


ODD = st.sampled_from([0.0, -0.0, -1.0, 1e-300, 1e300, np.nan, np.inf, -np.inf, 80.0, 80.1])
LENGTH = st.one_of(st.integers(0, 12), st.just(N))
NARROW = st.tuples(st.floats(-2.0, 2.0), st.floats(1e-12, 0.4), st.sampled_from((-1.0, 1.0)))
SPAN = st.one_of(
    st.just((float(BEARING[0]), float(BEARING[-1]))),
    st.tuples(ODD, ODD),
    st.just((1.0, -1.0)),
    NARROW.map(lambda one: (one[0], one[0] + one[1] * one[2])),
)
FUZZ = st.tuples(
    LENGTH,
    SPAN,
    st.sampled_from(("room", "noise", "odd", "same", "far")),
    st.integers(0, 2**32 - 1),
    st.one_of(st.just(0.01), ODD),
    st.one_of(st.floats(0.0, 0.3), ODD),
    st.tuples(*[st.one_of(st.just(0.0), ODD.filter(lambda offset: not 1e-6 < abs(offset) < 30.0))] * 3),
)
"""Beams, first and last bearing, ranges, seed, noise, time since the last scan, mount: none that could be a robot's, or
it would be another one from scan to scan, which nobody can tell from one that was carried."""


def fuzzed(
    case: tuple[int, tuple[float, float], str, int, float, float, tuple[float, ...]], T: Array, t: float
) -> Scan:
    n, (first, last), kind, seed, sigma, dt, mount = case
    rng = np.random.default_rng(seed)
    with np.errstate(all="ignore"):
        bearing = (
            BEARING.copy() if n == N and first == BEARING[0] else first + (last - first) * np.arange(n) / max(1, n - 1)
        )
        end = t + dt
    ranges = {
        "room": lambda: np.resize(scan_at(T, 0.0, 0, rng).range_m, n),
        "noise": lambda: rng.uniform(0.0, 30.0, n),
        "odd": lambda: rng.choice([0.0, -1.0, 1e-300, 1e300, np.nan, np.inf, 2.0, 2.01, 79.9], n),
        "same": lambda: np.full(n, rng.uniform(0.0, 5.0)),
        "far": lambda: rng.uniform(70.0, 90.0, n),
    }[kind]()
    beam = rng.choice(np.array((0, 1, 1, 1, 2, 200), np.uint8), n)
    return Scan(end, end, seed, np.array(mount), bearing, ranges, beam, sigma)


WAY = float(BEARING[0]), float(BEARING[-1])
FELL_TOGETHER = [
    (N, WAY, "room", 1, 0.01, 80.0, (0.0, 0.0, 0.0)),
    (N, WAY, "room", 0, 0.01, 0.0, (0.0, 0.0, 0.0)),
    (N, WAY, "same", 0, 0.01, 0.0, (0.0, 0.0, 1e300)),
]
"""Eighty seconds nobody speaks of, then a scan whose beams all have one bearing, since the mount's yaw has no digits
left for them: it once fitted a wall nine metres off."""


@pytest.mark.parametrize("method_name", METHODS)
@settings(max_examples=15, deadline=None)
@given(cases=st.lists(FUZZ, min_size=1, max_size=6))
@example(cases=FELL_TOGETHER)
@example(cases=[(N, (0.0, 1e-300), "room", 0, 0.01, 0.25, (0.0, 0.0, 0.0))])
@example(cases=[(N, (-1.0, -0.97), "room", 1, 0.01, 0.25, (0.0, 0.0, 0.0))])
def test_whatever_comes_the_step_goes_on(
    method_name: str, cases: list[tuple[int, tuple[float, float], str, int, float, float, tuple[float, ...]]]
) -> None:
    """Records at random on a robot that stands: never an exception, never a confident wrong pose, and it recovers."""
    state, T = settled(method_name, 4)
    t = 0.7
    for case in cases:
        scan = fuzzed(case, T, t)
        result = stand(state, t, scan)
        assert result.match is not None
        assert honest(result, T), result.match
        t = max(t + 0.05, min(scan.t_end, t + 0.3)) if np.isfinite(scan.t_end) else t + 0.05
    for k in range(6):
        result = stand(state, t + 0.05 * k, scan_at(T, t + 0.05 * k, 900 + k))
    assert result.match is not None
    assert result.match.ok or result.match.reason is Reason.LATE
    assert honest(result, T)
