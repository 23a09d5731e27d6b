"""The kernels with every index checked, and for a processor without AVX and FMA: same tests, same poses.

Each way has its own directory of compiled kernels, so the first run compiles for about a minute.
"""

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.rotation import share

ROOT = Path(__file__).parents[3]
WAYS: dict[str, dict[str, str]] = {
    "as usual": {},
    "indices checked": {"NUMBA_BOUNDSCHECK": "1"},
    "generic processor": {"NUMBA_CPU_NAME": "generic"},
}
OTHERS = ["indices checked", "generic processor"]
CHOSEN = (
    *("scan_matching/test_distance_region", "numerics/test_symmetric3", "scan_matching/test_line_features"),
    *("scan_matching/test_deskew", "scan_matching/test_icp", "paper/test_registration"),
    *("scan_matching/test_match_trace", "test_pipeline", "scan_matching/test_bad_input"),
    *("cdma/test_correlation_kernels", "light_filter/test_lambertian"),
)
"""Tests of the kernels of search, match, map, step and light that take seconds."""

TOLERANCE = 1e-9
"""m, rad, uA. Results are not the same bits: sums may be taken in any order (fast math), vectors have other widths, and
without FMA every product is rounded. Measured: 3e-14 after 40 scans, each matched on what those before have laid."""

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


def child(way: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python with kernels compiled in this way."""
    environment = {**os.environ, **WAYS[way]}
    return subprocess.run(
        [sys.executable, *words], cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=840
    )


@cache
def made_by(way: str) -> dict[str, Any]:
    done = child(way, "-m", "tests.estimator.target_poses")
    assert done.returncode == 0, done.stderr
    content: dict[str, Any] = json.loads(done.stdout)
    return content


def test_an_index_that_is_out_of_bounds_is_noticed() -> None:
    """The check is not only asked for, it is there, and in the usual way it is not."""
    code = (
        "import numpy as np\nfrom tests.estimator.one_kernel import element\n"
        "try:\n    element(np.zeros(3), 3)\nexcept IndexError:\n    print('noticed')"
    )
    done = {way: child(way, "-c", code) for way in WAYS}
    assert [one.returncode for one in done.values()] == [0, 0, 0], [one.stderr[-500:] for one in done.values()]
    said = {way: one.stdout for way, one in done.items()}
    assert said == {"as usual": "", "indices checked": "noticed\n", "generic processor": ""}


def marked(way: str) -> object:
    """One way with each commit: the two of them take minutes."""
    return pytest.param(way, marks=share(OTHERS.index(way), len(OTHERS)))


@pytest.mark.parametrize("way", [marked(way) for way in OTHERS])
def test_the_estimators_tests_pass(way: str) -> None:
    files = [f"tests/estimator/{name}.py" for name in CHOSEN]
    done = child(way, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow and not system", *files)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]


@pytest.mark.parametrize("way", [marked(way) for way in OTHERS])
def test_the_poses_are_those_of_the_usual_way(way: str) -> None:
    usual, other = made_by("as usual"), made_by(way)
    assert usual["directory"] != other["directory"]
    assert usual["figures"].keys() == other["figures"].keys()
    for name, values in usual["figures"].items():
        np.testing.assert_allclose(other["figures"][name], values, rtol=0.0, atol=TOLERANCE, err_msg=name)
