"""The shortest-link mechanism on epochs: which links are used, which are paused, and what place comes of them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.cdma.data_frame import LampFrame
from estimator.cdma.epoch import BlockFlag, LightEpoch, LinkFlag
from estimator.light_filter.lamp_catalogue import catalogue_of
from estimator.light_filter.survey import Survey
from estimator.measurements import Array
from estimator.paper.lateration import Prior
from estimator.paper.lateration_model import Solver, SolverSettings
from estimator.paper.shortest_link import PAUSED, Selection, links_of, misfit, select
from estimator.result import LinkState
from tests.estimator.paper.lamps import GRID, SURVEY, epoch_at, epoch_of, receiver_at, rss_of

SETTINGS = SolverSettings(Solver.LS, 4)
T = np.array((1.9, 2.1, 0.7))
XY = receiver_at(T)


def selected(
    epoch: LightEpoch, prior: Prior | None = None, survey: Survey = SURVEY, settings: SolverSettings = SETTINGS
) -> Selection:
    return select(epoch, catalogue_of(survey), survey, settings, prior)


def states(found: Selection, xy: Array | None = None) -> dict[int, LinkState]:
    return {link.code: link.state for link in links_of(found, SETTINGS, xy)}


def test_the_four_shortest_links_give_the_place() -> None:
    """Distances by inversion of Eq. 1 and 2 are exact here, so the place of Eq. 4 is; the others are paused."""
    found = selected(epoch_at(T))
    assert found.position is not None
    np.testing.assert_allclose(found.position.xy, XY, atol=1e-6)
    nearest = sorted(GRID, key=lambda lamp: math.hypot(lamp.x - XY[0], lamp.y - XY[1]))
    used = {lamp.code for lamp in nearest[:4]}
    assert found.accepted == {GRID[code].lamp_id for code in used}
    assert states(found) == {code: LinkState.ACCEPTED if code in used else LinkState.PAUSED for code in range(9)}
    links = links_of(found, SETTINGS, None)
    assert [link.amplitude for link in links] == sorted((link.amplitude for link in links), reverse=True)


def test_the_shortest_link_is_not_always_the_strongest() -> None:
    """A lamp of a hundredth of the power is as short a link; its distance is what counts."""
    near = min(GRID, key=lambda lamp: math.hypot(lamp.x - XY[0], lamp.y - XY[1]))
    dim = replace(near, power_w=0.01 * near.power_w)
    survey = replace(SURVEY, lamps=tuple(dim if lamp is near else lamp for lamp in GRID))
    found = selected(epoch_of([(lamp.code, rss_of(lamp, XY)) for lamp in survey.lamps]), survey=survey)
    assert found.received[found.clear[0]].code == near.code
    assert near.lamp_id in found.accepted


def test_fewer_than_link_n_clear_links_pause_light_as_a_whole() -> None:
    for count in (1, 2, 3):
        found = selected(epoch_at(T, codes=range(count)))
        assert found.position is None
        assert found.accepted == frozenset()
        assert set(states(found).values()) == {LinkState.PAUSED}
    assert selected(epoch_at(T, codes=(0, 1, 3, 4))).position is not None


def test_link_n_is_a_setting() -> None:
    epoch = epoch_at(T, codes=range(6))
    assert len(selected(epoch, settings=SolverSettings(Solver.LS, 3)).accepted) == 3
    assert len(selected(epoch, settings=SolverSettings(Solver.LS, 6)).accepted) == 6
    assert selected(epoch, settings=SolverSettings(Solver.LS, 7)).position is None


def test_a_link_is_paused_by_itself() -> None:
    """An unknown code, a faint one and one that came by walls alone are left out; the other four give the place."""
    strengths = {code: rss_of(GRID[code], XY) for code in (0, 1, 3, 4)}
    links = [*strengths.items(), (77, 1e-6), (5, 1e-10), (7, 7e-10), (8, math.nan)]
    found = selected(epoch_of(links))
    assert found.position is not None
    np.testing.assert_allclose(found.position.xy, XY, atol=1e-6)
    assert states(found) == {
        **dict.fromkeys(strengths, LinkState.ACCEPTED),
        **{77: LinkState.UNSURVEYED, 5: LinkState.FAINT, 7: LinkState.RIM, 8: LinkState.FAINT},
    }
    flagged = selected(epoch_of(strengths.items(), flags={4: LinkFlag.FAINT}))
    assert flagged.position is None
    assert states(flagged)[4] is LinkState.FAINT


def test_an_unusable_block_pauses_all() -> None:
    links = [(code, rss_of(GRID[code], XY)) for code in range(9)]
    assert selected(epoch_of(links, block=BlockFlag.STALLED)) is PAUSED
    assert PAUSED.accepted == frozenset()


def test_a_code_in_use_twice_needs_the_place() -> None:
    far = replace(GRID[4], lamp_id=900, x=40.0)
    survey = replace(SURVEY, lamps=(*GRID, far))
    prior = Prior(XY + np.array((0.3, -0.2)), 0.1 * np.eye(2))
    assert states(selected(epoch_at(T), None, survey))[4] is LinkState.TWIN
    known = selected(epoch_at(T), prior, survey)
    assert 104 in known.accepted
    both = selected(epoch_of([(k, rss_of(GRID[k], XY)) for k in range(9)], flags={4: LinkFlag.TWIN}), prior, survey)
    assert states(both)[4] is LinkState.TWIN
    assert next(link for link in links_of(both, SETTINGS, None) if link.code == 4).lamp_id is None


def test_a_lamp_may_describe_itself() -> None:
    """The paper's coded (x, y, i): a lamp that no survey names is used once its frame is received."""
    survey, new = replace(SURVEY, lamps=GRID[:4]), GRID[4]
    frame = LampFrame(new.lamp_id, new.x, new.y, new.z, new.power_w, math.degrees(math.acos(2 ** (-1 / new.order))))
    links = [(code, rss_of(GRID[code], XY)) for code in (0, 1, 3, 4)]
    assert selected(epoch_of(links), survey=survey).position is None
    found = selected(epoch_of(links, frames={4: frame}), survey=survey)
    assert found.position is not None
    assert new.lamp_id in found.accepted
    np.testing.assert_allclose(found.position.xy, XY, atol=1e-3)


def test_lamps_in_a_line_leave_two_places_until_one_is_known() -> None:
    epoch = epoch_of([(code, rss_of(GRID[code], XY)) for code in (0, 3, 6)])
    settings = SolverSettings(Solver.LS, 3)
    assert selected(epoch, settings=settings).position is None
    found = selected(epoch, Prior(XY + 0.2, 0.04 * np.eye(2)), settings=settings)
    assert found.position is not None
    np.testing.assert_allclose(found.position.xy, XY, atol=1e-5)


def test_residuals_are_of_received_against_expected_rss() -> None:
    """By hand: one RSS 10 % too strong has the residual ln 1.1 at the true place, the others none."""
    links = [(code, rss_of(GRID[code], XY) * (1.1 if code == 4 else 1.0)) for code in (0, 1, 3, 4)]
    found = selected(epoch_of(links))
    assert found.used is not None
    residuals = {link.code: link.residual for link in links_of(found, SETTINGS, XY)}
    assert residuals[4] == pytest.approx(math.log(1.1), abs=1e-9)
    assert residuals[0] == pytest.approx(0.0, abs=1e-9)
    elsewhere = XY + np.array((0.3, 0.1))
    for link in links_of(found, SETTINGS, elsewhere):
        expected = rss_of(GRID[link.code], elsewhere)
        assert link.residual == pytest.approx(math.log(link.amplitude / expected), abs=1e-9)
    by_hand = [(link.residual or 0.0) / (link.sigma or 1.0) for link in links_of(found, SETTINGS, XY)]
    assert misfit(found.used, SETTINGS, XY) == pytest.approx(np.mean(np.square(by_hand)))
    assert misfit(found.used, SETTINGS, XY) < misfit(found.used, SETTINGS, elsewhere)
