"""The experiment on static grids: halves stay separate, and real places reach the stated numbers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimator.light_filter.lambertian import expected
from tools.experiments.recorded import static
from tools.experiments.recorded.vlp import STATIC_LAMPS, Campaign


@pytest.fixture
def artificial() -> Campaign:
    """Strengths from the model itself at 49 places."""
    x, y = np.meshgrid(np.linspace(0.4, 4.6, 7), np.linspace(0.4, 4.6, 7))
    places = np.column_stack((x.ravel(), y.ravel(), np.full(49, 0.5)))
    data = Campaign("artificial", np.array(STATIC_LAMPS), places, np.ones((49, 5)), None)
    survey = static.nominal(data)
    rss = [expected(survey.lamps, survey, np.array((p[0], p[1], 0.0))).amplitude for p in places]
    return replace(data, rss=1e6 * np.array(rss))


def test_nothing_leaks_between_halves(artificial: Campaign) -> None:
    """Whatever is written into the half that is to be located, what was taught by the other stays the same."""
    train, test = static.halves(artificial, None)
    assert not set(train) & set(test)
    spoiled = artificial.rss.copy()
    spoiled[test] *= np.random.default_rng(1).uniform(0.1, 9.0, spoiled[test].shape)
    both = (artificial, replace(artificial, rss=spoiled))
    one, other = (static.teach(data, train, static.unit_of(data, train)) for data in both)
    assert one.survey == other.survey
    assert one.residuals is not None
    assert other.residuals is not None
    assert np.array_equal(one.residuals.mean, other.residuals.mean)
    assert np.array_equal(one.residuals.sigma, other.residuals.sigma)
    assert one.residuals.noise == other.residuals.noise


@pytest.mark.slow
def test_real_places(log_root: Path) -> None:
    del log_root
    first, second = static.split(("RSS", None, True)), static.split(("RSS_0923", None, True))
    assert len(first) == 73
    assert len(second) == 81
    assert np.median(first) < 0.05
    assert np.percentile(first, 90) < 0.12
    assert np.median(second) < 0.07
    assert np.median(static.across(("RSS", "RSS_0923", "gains and receiver"))) < 0.13
    assert np.median(static.across(("RSS_0923", "RSS", "gains and receiver"))) < 0.13
