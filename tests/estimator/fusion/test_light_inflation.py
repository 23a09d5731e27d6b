"""How far a position from light is trusted: less where lamps had to be bent, at a start, and under a row."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.fusion.light_inflation import (
    BENT,
    BENT_MOST,
    IN_ROW,
    TRUST,
    UNGUIDED,
    YOUNG,
    doubted,
    doubted_covariance,
)
from estimator.result import Fix, LightsResult


def told(bent: float = 0.0) -> LightsResult:
    P = np.diag((0.05, 0.04, 0.03)) ** 2
    return LightsResult(0.0, Fix.GOOD, np.zeros(3), P, (), frozenset(), 0.5 * np.linalg.inv(P), np.zeros(3), bent=bent)


@pytest.mark.parametrize(
    ("bent", "known_m", "in_row", "factor"),
    [
        (0.0, 100.0, 0.0, TRUST),  # lamps that are as they have been, a place long known
        (0.0, 100.0, 1.0, TRUST),
        (1.0, 100.0, 0.0, TRUST + BENT),
        (1.0, 0.0, 0.0, TRUST + BENT),  # at a start, too: lamps are bent there because the place is not yet right
        (0.2, 0.0, 0.0, TRUST + YOUNG),
        (40.0, 0.0, 0.0, TRUST + BENT * BENT_MOST),  # no lamp puts light out of use
        (math.nan, 0.0, 0.0, TRUST + BENT * BENT_MOST),
        (2.0, 0.0, 1.0, TRUST + 2.0 * BENT + IN_ROW),
        (0.0, 0.5, 0.0, TRUST + YOUNG / math.e),
        (0.0, 1.0, 1.0, TRUST + YOUNG / math.e**2 + IN_ROW / math.e),
    ],
)
def test_the_factor(bent: float, known_m: float, in_row: float, factor: float) -> None:
    P, raised = doubted_covariance(told(bent), known_m, in_row=in_row)
    assert raised == pytest.approx(factor, rel=1e-6)
    assert pytest.approx(factor * told().covariance) == P
    assert doubted(told(bent), known_m, in_row=in_row).gained == pytest.approx(told().gained / factor)


def test_a_start_is_believed_sooner_under_lamps_that_are_no_row() -> None:
    wide, narrow = (doubted_covariance(told(), 1.0, in_row=share)[1] for share in (0.0, 1.0))
    assert TRUST < wide < TRUST + 0.5 < TRUST + 2.0 < narrow


def test_without_wheels_it_is_believed_less() -> None:
    assert doubted_covariance(told(), 0.3, wheels=False)[1] == UNGUIDED * doubted_covariance(told(), 0.3)[1]


def test_a_heading_that_may_be_any_is_no_less_certain_than_that() -> None:
    vague = replace(told(), covariance=np.diag((0.01, 0.01, 100.0)))
    assert doubted(vague, 0.0).covariance[2, 2] == pytest.approx(np.pi**2 / 3.0)
