"""How surely a map lies in the survey's frame at one of its places."""

import numpy as np
import pytest

from estimator.mapping.keyframe import Submap
from estimator.mapping.map_frame import BENT, alignment_covariance
from estimator.mapping.submap_graph import SubmapGraph
from estimator.measurements import Array
from estimator.numerics import se2

HERE = np.array((20.0, 0.0, 0.0))


def atlas_of(lit: int, off: Array, sigma: float = 0.05) -> SubmapGraph:
    """A hall's way of 20 m in submaps, the last ``lit`` of which light has placed, ``off`` from where they lie."""
    atlas = SubmapGraph()
    for key in range(1, 11):
        T = np.array((2.0 * key, 0.0, 0.0))
        light = (T + off, np.diag((sigma**2, sigma**2, 0.05**2))) if key > 10 - lit else None
        atlas.submaps[key] = Submap(key, key, T, se2.identity(), light=light)
    return atlas


def covariance_of(graph: SubmapGraph, T_map_base: Array, first: int | None) -> Array:
    """At a place, of a map that was left at its origin."""
    left = np.zeros(3), np.diag((0.03**2, 0.03**2, 0.04**2))
    return alignment_covariance(graph.submaps.values(), T_map_base, first, left)


def test_without_light_at_its_submaps_it_is_what_was_known_swung_out() -> None:
    P = covariance_of(atlas_of(0, np.zeros(3)), HERE, None)
    np.testing.assert_allclose(P[1, 1], 0.03**2 + (20.0 * 0.04) ** 2)
    near = covariance_of(atlas_of(10, np.zeros(3)), np.array((0.5, 0.0, 0.0)), None)
    assert near[0, 0] == pytest.approx(0.03**2), "where the map was left that is surer than the whole"


def test_light_at_many_submaps_holds_the_whole_map() -> None:
    few, many = (covariance_of(atlas_of(lit, np.zeros(3)), HERE, None) for lit in (2, 10))
    assert np.all(np.diag(many) < np.diag(few))
    assert np.sqrt(many[1, 1]) < 0.15
    assert np.all(np.linalg.eigvalsh(many - BENT) > 0.0)


def test_light_that_disagrees_with_the_map_says_less() -> None:
    agrees, not_so = (covariance_of(atlas_of(10, np.array((0.0, off, 0.0))), HERE, None) for off in (0.0, 0.5))
    assert np.trace(not_so) > 1.5 * np.trace(agrees)


def test_submaps_that_are_no_part_of_the_map_say_nothing_of_it() -> None:
    np.testing.assert_allclose(
        covariance_of(atlas_of(3, np.zeros(3)), HERE, 8), covariance_of(atlas_of(0, np.zeros(3)), HERE, 8)
    )
