"""Soft bits that were kept and restored are gathered on as if nothing had been."""

from __future__ import annotations

import copy
import pickle

import numpy as np

from estimator.cdma.frame_accumulator import BitRings


def test_what_was_kept_goes_on_as_the_original() -> None:
    rings = BitRings(3)
    slots, period = np.array([0, 2]), np.array([5, 40])
    soft, variance = np.array([[1.0, -2.0], [0.5, 3.0]]), np.array([[0.1, 0.2], [0.1, np.inf]])
    rings.add(slots, period, soft, variance)
    restored = [pickle.loads(pickle.dumps(rings)), copy.deepcopy(rings)]
    for one in (rings, *restored):
        one.add(slots, period + 1, soft, variance)
    for one in restored:
        for at in (period, period + 1):
            np.testing.assert_array_equal(one.before(slots, at), rings.before(slots, at))
    assert rings.before(slots, period + 1)[0].any()
