"""Priors of poses in the graph, and the graph when it is made sparse."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from estimator.fusion.map_odom_filter import correct
from estimator.fusion.map_pose import SurveyAlignment
from estimator.mapping.constraints import Constraints
from estimator.mapping.graph_pose_prior import Said, said, surplus, take
from estimator.mapping.graph_sparsification import LOOPS, SLACK, WAYS, handed_on, surest, thinned, vagueness
from estimator.mapping.loop_closure import take_answer
from estimator.mapping.map_frame import shift_map
from estimator.mapping.pose_graph import UPPER, Graph, optimise
from estimator.mapping.relative_covariance import tied
from estimator.measurements import Answer, Array
from estimator.numerics import se2
from estimator.relocalisation.hypothesis_tracking import Watch
from estimator.state import State
from tests.estimator.circuit import TOLD, circuit, driven, run_jobs

VAGUE = np.diag((0.4**2, 0.4**2, 0.1**2))
SURE = np.diag((0.04**2, 0.04**2, 0.02**2))
HOW = (50, 1e-4, 10.0)


def lit(tie: Array, told: Array = SURE) -> tuple[State, Array]:
    """After a drive, light has said of each submap but the newest where it lies; the tie is as sure as said."""
    state, truth = driven(settings=None)
    state.use(replace(state.settings, loops=TOLD))
    state.pose.alignment = SurveyAlignment(placed=True, P=tie.copy())
    for submap in state.map.graph.submaps.values():
        submap.light = truth[submap.first - 1], told
    return state, truth[-1]


def solve(state: State) -> None:
    state.map.graph.stale = True
    take_answer(state.map, state.pose, state.motion, Answer(0.0, -1, None))
    run_jobs(state)


def off(state: State, truth: Array) -> float:
    x, y, _ = se2.between(truth, se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)).tolist()
    return float(np.hypot(x, y))


def test_a_robot_that_light_hardly_holds_is_moved_by_what_the_map_knows() -> None:
    state, truth = lit(VAGUE)
    before = off(state, truth)
    solve(state)
    assert state.pose.alignment is not None
    assert before > 0.25
    assert off(state, truth) < 0.12
    assert np.all(np.diag(state.pose.alignment.P) < 0.25 * np.diag(VAGUE))


@pytest.mark.parametrize("since", [0, 61])
def test_hearing_the_map_does_not_move_the_map(since: int) -> None:
    """The solution has put it where it belongs; moved with the robot once more, it tore where ``since`` lies."""
    state, truth = lit(VAGUE)
    assert state.pose.alignment is not None
    state.pose.alignment.since = since
    solve(state)
    *older, newest = state.map.graph.submaps.values()
    places = circuit()
    away = [np.hypot(*se2.between(places[piece.first - 1], piece.T_map_submap)[:2]) for piece in older]
    assert max(away) < 0.08
    T = se2.compose(newest.T_map_submap, se2.between(newest.T_odom_submap, state.motion.T_odom_base))
    assert np.hypot(*se2.between(T, se2.compose(state.pose.T_map_odom, state.motion.T_odom_base))[:2]) < 1e-9
    assert off(state, truth) < 0.12


def test_what_the_map_says_is_of_the_survey_even_if_light_moves_it_meanwhile() -> None:
    """Light moves map and robot by 0.15 m while the graph is being solved; its anchors, and so its word, stay."""
    ends = []
    for moved in (0.0, 0.15):
        state, truth = lit(VAGUE)
        state.map.graph.stale = True
        take_answer(state.map, state.pose, state.motion, Answer(0.0, -1, None))
        answers = [Answer(0.0, job.job_id, job.run()) for job in state.jobs.take()]
        T_map_base = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
        T_odom_base = state.motion.T_odom_base
        shift = correct(state.pose, T_map_base + np.array((moved, 0.0, 0.0)), T_odom_base, T_odom_base)
        shift_map(state.map, shift.moved, shift.since)
        for answer in answers:
            take_answer(state.map, state.pose, state.motion, answer)
        run_jobs(state)
        ends.append(off(state, truth))
    assert max(ends) < 0.15


def test_a_map_that_was_wrong_is_given_up_for_light_that_comes_back() -> None:
    """A pose that the map has moved far is held by nothing that light could not take back at once."""
    state, _ = lit(VAGUE)
    tie, newest = state.pose.alignment, state.map.graph.newest
    assert tie is not None
    assert newest is not None
    tie.proved = True
    take(state.map, state.pose, state.motion, Said(newest.T_map_submap + np.array((0.1, 0.0, 0.0)), SURE))
    assert not tie.broken
    tie.P = VAGUE.copy()
    take(state.map, state.pose, state.motion, Said(newest.T_map_submap + np.array((0.8, 0.0, 0.0)), SURE))
    assert tie.broken


@pytest.mark.parametrize("how", ["light disagrees", "adrift", "watched"])
def test_a_map_that_may_be_wrong_is_not_heard(how: str) -> None:
    state, _ = lit(VAGUE)
    tie, newest = state.pose.alignment, state.map.graph.newest
    assert tie is not None
    assert newest is not None
    if how == "light disagrees":
        tie.odd_since = 1.0
    elif how == "adrift":
        state.map.parts.detached = 1
    else:
        state.map.parts.trial = Watch(first=newest.key, until_m=1.0)
    take(state.map, state.pose, state.motion, Said(newest.T_map_submap + np.array((0.1, 0.0, 0.0)), SURE))
    np.testing.assert_array_equal(tie.P, VAGUE)


def test_the_same_map_heard_again_tells_nothing_new() -> None:
    state, _ = lit(VAGUE)
    solve(state)
    assert state.pose.alignment is not None
    P, T = state.pose.alignment.P, state.pose.T_map_odom
    for _ in range(3):
        solve(state)
    assert np.trace(state.pose.alignment.P[:2, :2]) > 0.8 * np.trace(P[:2, :2])
    np.testing.assert_allclose(state.pose.T_map_odom, T, atol=0.02)


def test_what_is_mended_is_taken_off_what_the_tie_shares_with_the_pose() -> None:
    state, _ = lit(VAGUE)
    assert state.pose.alignment is not None
    state.pose.alignment.X = 0.5 * VAGUE
    solve(state)
    assert np.all(np.diag(state.pose.alignment.X) < 0.25 * np.diag(0.5 * VAGUE))
    assert len(state.pose.alignment.mended) >= 1


@pytest.mark.parametrize("tie", [np.diag((0.02**2, 0.02**2, 0.005**2)), 1e-4 * VAGUE])
def test_a_robot_that_light_holds_better_stays_where_it_is(tie: Array) -> None:
    state, _ = lit(tie, told=VAGUE)
    solve(state)
    assert state.pose.alignment is not None
    np.testing.assert_array_equal(state.pose.T_map_odom, np.zeros(3))
    np.testing.assert_array_equal(state.pose.alignment.P, tie)


def test_a_map_that_contradicts_what_light_is_sure_of_is_not_followed() -> None:
    """Sure along x and y to a few cm, with the map elsewhere by far more than both allow, but a better heading."""
    tie = np.diag((0.03**2, 0.03**2, 0.3**2))
    state, _ = lit(tie, told=np.diag((0.01**2, 0.01**2, 0.002**2)))
    for submap in state.map.graph.submaps.values():
        T, P = submap.light  # type: ignore[misc]  # all are lit
        submap.light = T + np.array((2.0, -1.0, 0.0)), P
    solve(state)
    assert state.pose.alignment is not None
    np.testing.assert_array_equal(state.pose.alignment.P, tie)
    np.testing.assert_array_equal(state.pose.T_map_odom, np.zeros(3))


def chain(anchored: tuple[int, ...], edges: tuple[tuple[int, int], ...]) -> Graph:
    poses = np.array([(float(k), 0.0, 0.0) for k in range(4)])
    H = np.array([[np.diag((1e4, 1e4, 1e5))[i, j] for i, j in UPPER]])
    between = np.array([se2.between(poses[i], poses[j]) for i, j in edges])
    doubtful = np.zeros(len(edges), np.bool_)
    at, certainty = poses[list(anchored)], np.repeat(H, len(anchored), axis=0)
    ways = np.repeat(H, len(edges), axis=0)
    return Graph(poses, np.array(edges), between, ways, doubtful, np.array(anchored), at, certainty)


@pytest.mark.parametrize(
    ("anchored", "edges", "speaks"),
    [
        ((0, 3), ((0, 1), (1, 2), (2, 3)), True),
        ((3,), ((0, 1), (1, 2), (2, 3)), False),
        ((0, 3), ((0, 1), (2, 3)), False),
    ],
    ids=["one other anchor", "no other anchor", "none that the way joins with it"],
)
def test_the_map_says_nothing_of_a_place_that_nothing_but_the_tie_anchors(
    anchored: tuple[int, ...], edges: tuple[tuple[int, int], ...], speaks: bool
) -> None:
    graph = chain(anchored, edges)
    solution = optimise(graph, *HOW, covariance_of=3)
    word = said(graph, solution, tied(graph, solution.poses, solution.trust, 3), HOW)
    assert (word is not None) is speaks
    if word is not None:  # its anchor's covariance and three steps, the heading's with the lever
        x, y, yaw = np.diag(word.P).tolist()
        assert x == pytest.approx(4e-4, rel=1e-3)
        assert yaw == pytest.approx(4e-5, rel=1e-3)
        assert y == pytest.approx(4e-4 + 1e-5 * (9.0 + 4.0 + 1.0), rel=1e-3)
        np.testing.assert_allclose(word.T_map_newest, (3.0, 0.0, 0.0), atol=1e-9)


sizes = st.floats(0.1, 10.0)
angles = st.floats(-3.0, 3.0)


@given(st.tuples(sizes, sizes, sizes), st.tuples(sizes, sizes, sizes), angles, angles, st.floats(1e-2, 1e2))
def test_surplus_is_what_exceeds_in_each_direction_in_whatever_units(
    one: tuple[float, ...], other: tuple[float, ...], turn: float, lean: float, unit: float
) -> None:
    A = np.zeros((3, 3))
    A[:2, :2] = ((np.cos(turn), -np.sin(turn)), (np.sin(turn), np.cos(turn)))
    A[2, 2], A[2, 0] = 1.0, np.sin(lean)
    L, than = A @ np.diag(one) @ A.T, np.diag(other)
    G = surplus(L, than)
    assert np.linalg.eigvalsh(G).min() > -1e-9
    sum_ = than + G
    assert np.linalg.eigvalsh(sum_ - L).min() > -1e-9 * np.trace(sum_), "no direction is told less than by either"
    np.testing.assert_allclose(surplus(L, sum_), 0.0, atol=1e-8 * np.trace(sum_))
    scale = np.diag((1.0, 1.0, unit))
    np.testing.assert_allclose(
        surplus(scale @ L @ scale, scale @ than @ scale), scale @ G @ scale, rtol=1e-6, atol=1e-9
    )


def test_surplus_over_an_information_that_rounding_has_made_indefinite_is_finite() -> None:
    than = np.diag((1e10, 1e3, -1e-7))
    G = surplus(np.diag((1.0, 1.0, 1e6)), than)
    assert np.isfinite(G).all()
    assert G[2, 2] == pytest.approx(1e6, rel=0.1)
    assert abs(G[0, 0]) < 1.0


def graph(n: int, m: int, share: float, seed: int) -> Constraints:
    """Ways and loops between ``n`` submaps at random, of any certainty; pairs may repeat."""
    rng = np.random.default_rng(seed)
    a = rng.integers(0, n, m)
    b = (a + rng.integers(1, n, m)) % n
    root = rng.normal(0.0, 1.0, (m, 3, 3)) + 2.0 * np.eye(3)
    H = (root @ root.transpose(0, 2, 1)) * 10.0 ** rng.uniform(1.0, 5.0, (m, 1, 1))
    upper = H[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return Constraints(10 + 3 * np.column_stack((a, b)), rng.normal(0.0, 1.0, (m, 3)), upper, rng.random(m) < share)


def parts(n: int, edges: np.ndarray) -> tuple[int, list[int]]:
    whole = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    count, label = connected_components(whole, directed=False)
    return int(count), label.tolist()


@given(st.integers(2, 40), st.integers(0, 1500), st.floats(0.0, 1.0), st.integers(0, 10_000))
@settings(max_examples=150, deadline=None)
def test_few_stay_and_nothing_comes_loose(n: int, m: int, share: float, seed: int) -> None:
    made, keys = graph(n, m, share, seed), 10 + 3 * np.arange(n)
    kept = thinned(keys, made)
    if m <= SLACK * (WAYS + LOOPS) * n:
        assert kept.all()
        return
    edges = (made.between - 10) // 3
    of_ways = parts(n, edges[~made.loop])
    assert parts(n, edges[kept & ~made.loop]) == of_ways
    assert parts(n, edges[kept]) == parts(n, edges)
    least = sum(len({*pair}) == 2 for pair in np.sort(np.array(of_ways[1])[edges], axis=1).tolist()) and of_ways[0]
    doubled = 2 * n  # a pair that a tree runs along stays as often as it is there: `Constraints.add` has one
    assert (kept & ~made.loop).sum() <= (WAYS + 1) * n + doubled + np.bincount(pair_of(edges[~made.loop], n)).max() * n
    assert (kept & made.loop).sum() <= LOOPS * n + least * (least - 1) // 2


def pair_of(edges: np.ndarray, n: int) -> np.ndarray:
    return np.append(edges.min(axis=1) * n + edges.max(axis=1), 0)


def test_vagueness_is_the_trace_of_the_covariance() -> None:
    made = graph(9, 60, 0.5, 1)
    traces = [np.trace(made.covariance(row)) for row in range(60)]
    np.testing.assert_allclose(vagueness(made.information), traces, rtol=1e-4)


def test_the_surest_of_either_end_stay_and_of_equals_the_latest() -> None:
    edges = np.array(((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (0, 1)))
    vague = np.array((5.0, 1.0, 2.0, 3.0, 9.0, 5.0))
    asked = np.array((True, True, True, True, False, True))
    # 0 keeps (0, 2); 1 the latest of its two equals; 3 and 4 have one each
    assert surest(edges, vague, asked, 1).tolist() == [False, True, True, True, False, True]


@given(st.integers(3, 30), st.integers(2, 600), st.floats(0.0, 1.0), st.integers(0, 10_000))
@settings(max_examples=100, deadline=None)
def test_a_submap_taken_out_hands_on_little_and_tears_nothing(n: int, m: int, share: float, seed: int) -> None:
    made, keys = graph(n, m, share, seed), 10 + 3 * np.arange(n)
    ends = np.searchsorted(keys, made.between)
    gone = int(ends[0, 0])
    before = parts(n, ends)[1]
    rows = handed_on(keys, made, int(keys[gone]))
    loops = int(made.loop[rows].sum())
    foreign = len(set(parts(n, ends[~made.loop])[1])) - 1
    assert loops <= LOOPS + foreign
    assert set(rows) >= set(np.flatnonzero(~made.loop & (ends == gone).any(axis=1)))
    if not len(rows):
        return
    hub, T, P = made.seen_from(int(keys[gone]), int(rows[0]))
    made.reroute(int(keys[gone]), hub, se2.inverse(T), P, rows)
    assert not (made.between == keys[gone]).any()
    after = parts(n, np.searchsorted(keys, made.between))[1]
    rest = [k for k in range(n) if k != gone]
    same = {(before[a] == before[b]) == (after[a] == after[b]) for a in rest for b in rest}
    assert same == {True}
