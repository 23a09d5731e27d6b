"""Methods by name: the door, a lit drive by the paper's method, its pause, its map step, and pIC without light."""

import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import UNLIMITED, Array, Command, LightEpoch, Odometry, Order, Record, Scan
from estimator.numerics import se2
from estimator.paper import LUMILOOP, METHODS, UnknownMethod, method
from estimator.paper.methods import PaperMethod
from estimator.paper.pose_weighting import combine
from estimator.pipeline import new_state, step
from estimator.result import Fix, LinkState, StepResult
from estimator.state import Settings
from tests.estimator.lit import scans, together
from tests.estimator.test_pipeline import drive, path, scan_at
from tools.sim.light.link_drive import LightRun, room_run

DARK = (14.0, 18.0)
"""Span in which all lamps but three are covered, s."""
NOTHING = 1e-100
"""A weight below is none."""


def test_an_unknown_method_is_refused_by_name() -> None:
    with pytest.raises(UnknownMethod, match="no method 'slam': choose from lumiloop, paper, pic"):
        method("slam")


@pytest.mark.parametrize("code", ["import estimator.pipeline", "import estimator.paper", "import daemon.app"])
def test_nothing_of_the_paper_is_loaded_unless_it_is_asked_for(code: str) -> None:
    check = f"import sys\n{code}\nassert not [name for name in sys.modules if name.startswith('estimator.paper.')]"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.jit
@pytest.mark.parametrize("name", METHODS)
def test_a_drive_without_light_is_followed_by_each(name: str) -> None:
    run = method(name)(Settings(), None)
    assert not run.lit
    truth, results = drive(run.state, odometry=True, n=40)
    off = se2.between(se2.between(truth[0], truth[-1]), se2.between(results[0].T_odom_base, results[-1].T_odom_base))
    assert np.hypot(off[0], off[1]) < 0.1
    assert results[-1].lights is None


@pytest.mark.jit
def test_without_light_the_prediction_is_t1_and_weighs_nothing() -> None:
    run = method("paper")(Settings(), None)
    assert isinstance(run, PaperMethod)
    drive(run.state, odometry=True, n=10)
    assert run.matcher.share < NOTHING


def test_pic_knows_no_light() -> None:
    survey = room_run(seed=1).survey
    run = method("pic")(Settings(), LightsSetup(survey, clock_ppm=0.0))
    assert not run.lit
    assert run.state.light is None


@pytest.mark.jit
def test_lumiloop_is_the_pipeline() -> None:
    named, state, noise = method(LUMILOOP)(Settings(), None), new_state(), np.random.default_rng(1)
    for k, T in enumerate(path(10)):
        scan = scan_at(T, 0.05 * k, k, noise)
        one, other = named.step([scan], UNLIMITED), step(state, [scan], UNLIMITED)
        np.testing.assert_array_equal(one.T_odom_base, other.T_odom_base)


def covered(epochs: Iterable[LightEpoch], span: tuple[float, float]) -> Iterator[LightEpoch]:
    """The same, with three links at most within a span."""
    for epoch in epochs:
        if not span[0] <= epoch.t_end < span[1]:
            yield epoch
            continue
        few = np.argsort(-epoch.amplitude)[:3]
        yield replace(
            epoch,
            ids=epoch.ids[few],
            amplitude=epoch.amplitude[few],
            variance=epoch.variance[few],
            flags=epoch.flags[few],
            lamps=tuple(epoch.lamps[k] for k in few.tolist()),
        )


class Drive:
    """A lit drive by the paper's method, with what each scan came to."""

    def __init__(self, seconds: float = 24.0) -> None:
        self.run: LightRun = replace(room_run(seed=1, people=0), seconds=seconds)
        setup = LightsSetup(self.run.survey, clock_ppm=0.0)
        self.paper = PaperMethod(Settings(history=True), setup)
        self.t: list[float] = []
        self.results: list[StepResult] = []
        self.shares: list[float] = []
        self.pending: list[Record] = []
        for record in together(self.run.odometry(), covered(self.run.light(), DARK), scans(self.run)):
            self.take(record)

    def take(self, record: Record) -> None:
        self.pending.append(record)
        if isinstance(record, Scan):
            self.results.append(self.paper.step(self.pending, UNLIMITED))
            self.pending = []
            self.t.append(record.t_end)
            self.shares.append(self.paper.matcher.share)

    def between(self, begin: float, end: float) -> slice:
        return slice(int(np.searchsorted(self.t, begin)), int(np.searchsorted(self.t, end)))

    def errors(self, part: slice) -> Array:
        """(n, 3) of the published poses in the frame of the survey."""
        poses = np.array([se2.compose(one.T_map_odom, one.T_odom_base) for one in self.results[part]])
        off = poses - self.run.truth(np.array(self.t[part]))
        off[:, 2] = (off[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        return np.asarray(off)


@pytest.fixture(scope="module")
def lit() -> Drive:
    return Drive()


@pytest.mark.jit
def test_a_lit_drive_is_placed_in_the_survey(lit: Drive) -> None:
    """Finite everywhere; within decimetres of the truth once light has placed the map: what Eq. 4 is good for."""
    part = lit.between(10.0, 24.0)
    assert np.isfinite(lit.errors(slice(None))).all()
    assert all(one.placed for one in lit.results[part])
    off = lit.errors(part)
    assert np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()) < 0.4
    assert np.abs(off[:, 2]).max() < 0.2
    assert all(one.protection is None for one in lit.results), "no bound is claimed"
    assert sum(one.match is not None and one.match.ok for one in lit.results) > 0.95 * len(lit.results)


@pytest.mark.jit
def test_t1_comes_from_link_n_links(lit: Drive) -> None:
    shares = lit.shares[lit.between(10.0, DARK[0])]
    assert np.mean(np.array(shares) > 0.05) > 0.9
    for one in lit.results[lit.between(10.0, DARK[0])]:
        assert one.lights is not None
        assert one.lights.fix is Fix.GOOD
        assert len(one.lights.accepted) == 4
        used = [link for link in one.lights.links if link.state is LinkState.ACCEPTED]
        assert {link.lamp_id for link in used} == one.lights.accepted


@pytest.mark.jit
def test_light_is_paused_while_fewer_than_link_n_links_are_clear(lit: Drive) -> None:
    part = lit.between(DARK[0] + 0.1, DARK[1])
    assert max(lit.shares[part]) < NOTHING
    before = lit.results[part.start].T_map_odom
    for one in lit.results[part]:
        assert one.lights is not None
        assert one.lights.fix is Fix.HELD
        assert one.lights.accepted == frozenset()
        assert {link.state for link in one.lights.links} <= {LinkState.PAUSED, LinkState.RIM, LinkState.FAINT}
        np.testing.assert_array_equal(one.T_map_odom, before)
        assert one.match is not None
        assert one.match.ok
    assert any(share > 0.05 for share in lit.shares[lit.between(DARK[1] + 0.1, 24.0)])


@pytest.mark.jit
def test_keyframes_keep_the_light_solution(lit: Drive) -> None:
    frames = list(lit.paper.state.map.keyframes.values())
    assert any(frame.virtual is None for frame in frames), "of the start, and of the pause"
    kept = [frame.virtual for frame in frames if frame.virtual is not None]
    assert len(kept) > 5
    assert all(len(one.accepted) == 4 for one in kept)


@pytest.mark.jit
def test_a_keyframe_moves_the_pose_in_the_map_by_the_weight() -> None:
    """By hand: with the weight 0.25 the robot moves a quarter of the way to where light has it, and the map stays."""
    done = Drive(8.0)
    paper, result = done.paper, done.results[-1]
    assert paper.aligned
    assert paper.light is not None
    first = next(iter(paper.state.map.keyframes.values()))
    laid, newest = first.T_map_keyframe, max(paper.state.map.keyframes)
    paper.light.T = paper.light.T + np.array((0.4, 0.2, 0.1))
    light = paper.light.virtual(result.t_mono)
    assert light is not None
    T2, expected = se2.compose(result.T_map_odom, result.T_odom_base), np.empty(3)
    combine(light.T_map_base, T2, 0.25 * np.eye(3), expected)
    paper.matcher.share = 0.25
    paper._scan_to_map(replace(result, keyframe=newest + 1))
    T = se2.compose(paper.state.pose.T_map_odom, result.T_odom_base)
    np.testing.assert_allclose(T, expected, atol=1e-12)
    off = se2.between(T2, T), se2.between(T2, light.T_map_base)
    assert np.hypot(*off[0][:2]) == pytest.approx(0.25 * np.hypot(*off[1][:2]), rel=0.02)
    np.testing.assert_array_equal(first.T_map_keyframe, laid)


@pytest.mark.jit
def test_an_order_for_the_map_frame_is_followed_by_a_new_placing() -> None:
    done = Drive(8.0)
    t = done.results[-1].t_mono
    paper = done.paper
    reset = paper.step([Command(t, Order.RESET)], UNLIMITED)
    assert not reset.placed
    np.testing.assert_allclose(se2.compose(reset.T_map_odom, reset.T_odom_base), np.zeros(3), atol=1e-9)


@pytest.mark.jit
def test_without_wheels_the_motion_of_the_lidar_moves_the_light_solution() -> None:
    run = replace(room_run(seed=1, people=0), seconds=14.0)
    paper = PaperMethod(Settings(), LightsSetup(run.survey, clock_ppm=0.0))
    pending: list[Record] = []
    for record in together(run.light(), scans(run)):
        pending.append(record)
        if isinstance(record, Scan):
            result = paper.step(pending, UNLIMITED)
            pending = []
    assert result.placed
    off = se2.compose(result.T_map_odom, result.T_odom_base) - run.truth(np.array([result.t_mono]))[0]
    assert np.hypot(off[0], off[1]) < 0.6


@pytest.mark.jit
def test_light_after_the_scan_waits_for_the_next_one() -> None:
    """Within one step: an epoch and wheels that are newer than the scan are not in its T1."""
    done = Drive(8.0)
    paper = done.paper
    assert paper.light is not None
    seen: list[float] = []
    inner = paper.matcher.first
    paper.matcher.first = lambda prior, frame: (seen.append(paper.light.t_epoch), inner(prior, frame))[1]  # type: ignore[union-attr,func-returns-value]
    t, T = done.t[-1], done.run.truth(np.array([done.t[-1]]))[0]
    scan = next(iter(scans(replace(done.run, seconds=0.1), lambda at: np.tile(T, (len(at), 1)))))
    late = replace(next(iter(done.run.light())), t_begin=t + 0.11, t_end=t + 0.16)
    before = paper.light.t_epoch
    paper.step([replace(scan, t_begin=t, t_end=t + 0.1), late, Odometry(t, t + 0.12, np.zeros(3))], UNLIMITED)
    assert seen == [before]
    assert paper.light.t_epoch == t + 0.16
