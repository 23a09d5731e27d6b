"""The search for further lamps: with a small part of the effort where there is none, with all of it where there is."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.cdma.acquisition import Index, Search
from estimator.cdma.acquisition_budget import EMPTY, LONGEST, LONGEST_FOREIGN, RISE, SPREAD, TURNS, Watch
from estimator.cdma.gold_codes import gold_codes
from tests.estimator.cdma_scene import Run, ceiling, currents

CODES = 129
SLICE = 150


def calm() -> Watch:
    watch = Watch(CODES)
    for _ in range(EMPTY):
        watch.on_block(5, 1.0, odd=False)
        watch.on_sweep(0)
    watch.on_block(5, 1.0, odd=False)
    return watch


def test_full_effort_until_blocks_were_looked_through_without_a_find() -> None:
    watch = Watch(CODES)
    watch.on_block(5, 1.0, odd=False)
    for finds in [0] * (EMPTY - 1) + [1] + [0] * (EMPTY - 1):
        assert watch.allow(SLICE) == SLICE
        watch.on_sweep(finds)
    assert watch.allow(SLICE) == SLICE
    watch.on_sweep(0)
    assert 0 < watch.allow(SLICE) < SLICE


def test_calm_it_never_stops_and_a_sweep_takes_no_more_blocks_than_stated() -> None:
    watch, tried, blocks = calm(), 0, 0
    while tried < CODES:
        for _ in range(2):
            codes = watch.allow(SLICE)
            watch.spend(codes)
            tried += codes
        assert watch.allow(SLICE) == 0, "two cycles per block do not make it twice as much"
        watch.on_block(5, 1.0, odd=False)
        blocks += 1
    assert blocks == SPREAD


@pytest.mark.parametrize(
    ("lit", "noise", "odd"), [(5, 1.01 * RISE, False), (4, 1.0, False), (0, 1.0, False), (5, 1.0, True), (5, 0.0, True)]
)
def test_full_effort_at_once(lit: int, noise: float, odd: bool) -> None:
    watch = calm()
    assert watch.calm
    watch.on_block(lit, noise, odd)
    assert watch.allow(SLICE) == SLICE
    assert not watch.calm


def test_a_lamp_lost_for_good_lets_it_be_calm_again() -> None:
    watch = calm()
    for _ in range(EMPTY):
        watch.on_block(4, 1.0, odd=False)
        watch.on_sweep(0)
    assert watch.calm
    watch.on_block(6, 1.0, odd=False)
    assert watch.calm, "one that comes into sight again is no loss"


def one_more(run: Run, current_a: float) -> int:
    """Switch on another lamp, and say which."""
    code = next(k for k in range(CODES) if k not in run.codes())
    like = run.ceiling.lamps[-1]
    run.ceiling.lamps.append(replace(like, code=code, lamp_id=code, current_a=current_a, phase_chips=91.7))
    return code


@pytest.mark.jit
@pytest.mark.parametrize("seed", range(40, 46))
@pytest.mark.parametrize(("current_a", "blocks"), [(30e-9, 5), (9e-9, LONGEST)])
def test_a_new_lamp_is_found_in_the_time_stated(seed: int, current_a: float, blocks: int) -> None:
    """A strong one raises the residual and calls for all of the effort; a weak one waits for the slow sweep."""
    run = Run(ceiling(seed, np.full(4, 80e-9)))
    run.settle(20 + seed % SPREAD)
    assert run.decoder.watch.calm
    new = one_more(run, current_a)
    took = next(k + 1 for k, (_, epoch) in enumerate(run.blocks(40)) if new in epoch.ids.tolist())
    assert took <= blocks


@pytest.mark.jit
@pytest.mark.parametrize("seed", range(40, 44))
@pytest.mark.parametrize(("hangs", "blocks"), [(True, LONGEST), (False, LONGEST_FOREIGN)])
def test_one_that_hangs_here_is_looked_for_more_often(seed: int, hangs: bool, blocks: int) -> None:
    scene = ceiling(seed, np.full(4, 80e-9))
    run = Run(scene, hung=tuple(lamp.code for lamp in scene.lamps))
    new = one_more(run, 9e-9)
    weak = run.ceiling.lamps.pop()
    run = Run(scene, hung=(*run.hung, new) if hangs else run.hung)
    run.settle(20 + seed % SPREAD)
    assert run.decoder.watch.calm
    run.ceiling.lamps.append(weak)
    took = next(k + 1 for k, (_, epoch) in enumerate(run.blocks(60)) if new in epoch.ids.tolist())
    assert took <= blocks


@pytest.mark.jit
def test_calm_every_code_has_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that hang here in each slow sweep, all others in one of `TURNS`."""
    scene, tried = ceiling(1, currents(4.6, 5.3)[:6]), list[int]()
    hung = tuple(sorted(lamp.code for lamp in scene.lamps))
    run = Run(scene, hung=hung)
    run.settle(20)
    attempt = Search._try

    def noted(self: Search, job: object, clock: float, some: Index) -> object:
        tried.extend(some.tolist())
        return attempt(self, job, clock, some)  # type: ignore[arg-type]  # it is a Job

    monkeypatch.setattr(Search, "_try", noted)
    run.settle(4 * SPREAD * TURNS)
    assert run.decoder.watch.calm
    times = np.bincount(tried, minlength=CODES)
    foreign = np.setdiff1d(np.arange(CODES), hung)
    assert times[foreign].min() >= 3
    assert times[foreign].max() <= 5
    assert times[list(hung)].min() >= 4 * TURNS - 1
    assert times[list(hung)].max() <= 5 * TURNS


@pytest.mark.jit
def test_calm_a_sixth_of_the_codes_is_tried_per_block(monkeypatch: pytest.MonkeyPatch) -> None:
    run, tried = Run(ceiling(1, currents(4.6, 5.3)[:6])), list[int]()
    run.settle(20)
    attempt = Search._try

    def counted(self: Search, job: object, clock: float, some: Index) -> object:
        tried.append(len(some))
        return attempt(self, job, clock, some)  # type: ignore[arg-type]  # it is a Job

    monkeypatch.setattr(Search, "_try", counted)
    run.settle(4 * SPREAD)
    whole = len(gold_codes(run.decoder.profile.degree))
    assert 3 * whole <= sum(tried) <= 5 * whole
