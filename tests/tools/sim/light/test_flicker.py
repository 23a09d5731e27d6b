"""The air interface is not seen: every line of every code stays below the no-effect level of IEEE 1789."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools.sim.light.flicker import lines, low_risk, no_effect, table, worst
from tools.sim.light.transmitter import Lamp

LAMP = Lamp(code=0, current_a=1.0, lamp_id=1234, position_m=(12.5, -3.25, 2.8))


def test_every_code_of_profile_a_with_and_without_data() -> None:
    without = [worst(replace(LAMP, code=code, data=False), 5000.0, 7) for code in range(129)]
    framed = [worst(replace(LAMP, code=code), 5000.0, 7) for code in range(0, 129, 4)]
    assert max(without) < 0.5
    assert max(framed) < 0.15


def test_without_manchester_it_would_be_seen() -> None:
    assert max(worst(replace(LAMP, code=code, data=False), 5000.0, 7, manchester=False) for code in range(129)) > 25.0


def test_profile_b_is_of_low_risk_and_profile_d_of_none() -> None:
    for code in range(65):
        frequency, modulation = lines(replace(LAMP, code=code, depth=0.1, data=False), 825.0, 6)
        assert np.all(modulation < low_risk(frequency))
    assert max(worst(replace(LAMP, code=code, data=False), 20_000.0, 9) for code in range(0, 513, 16)) < 0.1


def test_lines_have_the_power_of_the_waveform() -> None:
    frequency, modulation = lines(replace(LAMP, data=False), 5000.0, 7)
    assert np.sum(modulation**2) / 2 == pytest.approx(0.66 * 30.0**2, rel=0.05)  # the rest lies above 5 kHz
    assert frequency[0] == pytest.approx(5000 / 127)


def test_limits_are_the_standards() -> None:
    f = np.array([50.0, 100.0, 2000.0, 4000.0])
    np.testing.assert_allclose(no_effect(f)[:3], [0.5, 3.33, 66.6])
    np.testing.assert_allclose(low_risk(f)[:2], [1.25, 8.0])
    assert np.isinf(no_effect(f)[3])
    assert np.isinf(low_risk(f)[2])


def test_the_table_of_the_page_on_the_air_interface() -> None:
    page = (Path(__file__).parents[4] / "docs" / "air-interface.md").read_text()
    for name in ("A", "B", "D"):
        for row in table(name, data=False):
            assert row in page
