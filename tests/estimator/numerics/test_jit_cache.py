"""The cache of compiled kernels: which are kept, for which processor, and how they are loaded."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimator.numerics import jit, jit_cache
from tests.rotation import share

DAY = 86400.0


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def left_behind(root: Path, name: str, days: float) -> Path:
    folder = root / f"kernels-{name}"
    (folder / "estimator_1").mkdir(parents=True)
    (folder / "estimator_1" / "a.nbc").touch()
    os.utime(folder, (time.time() - days * DAY,) * 2)
    return folder


def test_the_latest_used_are_kept(root: Path) -> None:
    old = [left_behind(root, f"{k:02}", 10.0 + k) for k in range(10)]
    alien = root / "maps"
    alien.mkdir()
    ours = jit_cache._choose_cache()
    assert ours == root / f"kernels-{jit_cache.source_key()}"
    assert sorted(root.iterdir()) == sorted([alien, ours, *old[: jit_cache.KEPT]])


def test_what_was_used_this_week_is_kept(root: Path) -> None:
    fresh = [left_behind(root, f"{k:02}", 0.5 * k) for k in range(10)]
    jit_cache._choose_cache()
    assert all(folder.exists() for folder in fresh)


def test_not_even_a_busy_week_fills_the_disk(root: Path) -> None:
    fresh = [left_behind(root, f"{k:02}", 0.01 * k) for k in range(jit_cache.MOST + 5)]
    ours = jit_cache._choose_cache()
    assert sorted(root.iterdir()) == sorted([ours, *fresh[: jit_cache.MOST]])


def test_nothing_is_looked_at_when_ours_is_there_already(root: Path) -> None:
    ours = jit_cache._choose_cache()
    os.utime(ours, (0.0, 0.0))
    old = [left_behind(root, f"{k:02}", 100.0) for k in range(10)]
    assert jit_cache._choose_cache() == ours
    assert all(folder.exists() for folder in old)
    assert time.time() - ours.stat().st_mtime < DAY  # it counts as used


def test_what_cannot_be_removed_stays(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = [left_behind(root, f"{k:02}", 100.0) for k in range(jit_cache.KEPT + 1)]
    old[-1].rename(root / "elsewhere")
    (root / old[-1].name).symlink_to(root / "elsewhere")  # rmtree refuses a link
    jit_cache._choose_cache()
    assert (root / "elsewhere").exists()


@pytest.mark.parametrize(("name", "value"), [("BOUNDSCHECK", "1"), ("CPU_NAME", "generic"), ("OPT", "0")])
def test_other_machine_code_has_another_directory(
    root: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    ours = jit_cache._choose_cache()
    monkeypatch.setenv(f"NUMBA_{name}", value)
    other = jit_cache._choose_cache()
    assert other != ours
    monkeypatch.undo()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(root))
    assert jit_cache._choose_cache() == ours


def test_every_setting_that_is_looked_at_exists() -> None:
    """A name that numba has renamed would no longer tell the two apart."""
    assert [name for name in jit_cache.SHAPING if not hasattr(jit._numba_config, name)] == []


ROOT = Path(__file__).parents[3]
PAIR = '''
import numpy as np
from estimator.numerics.jit import kernel

@kernel("f8(f8[::1])")
def total(values):
    """Its body is written into the one below."""
    found = 0.0
    for value in values:
        found += value
    return found

@kernel("f8(f8[::1])")
def mean(values):
    return total(values) / values.size

@kernel("f8[::1](f8[::1])")
def twice(values):
    """What it returns is memory that it has taken."""
    both = np.empty(2 * values.size)
    for k in range(both.size):
        both[k] = values[k % values.size]
    return both
'''
ASK = """
import json, sys
import llvmlite.binding, numpy as np
from numba.core import event
from numba.core.runtime import _nrt_python
from numba.core.runtime.nrt import rtsys
import estimator.numerics.jit_cache_load
seen = {"compiled": 0, "read": 0}
class Count(event.Listener):
    def on_start(self, _): seen["compiled"] += 1
    def on_end(self, _): pass
event.register("numba:compile", Count())
parse = llvmlite.binding.parse_bitcode
def counted(data):
    seen["read"] += 1
    return parse(data)
llvmlite.binding.parse_bitcode = counted
BEFORE
import pair
seen["ready to compile"] = "numba.np.arraymath" in sys.modules
seen["ready to count"] = rtsys._init
for _ in range(100):
    assert pair.twice(np.arange(3.0)).tolist() == [0.0, 1.0, 2.0] * 2
_nrt_python.memsys_enable_stats()
given = [pair.twice(np.arange(3.0)) for _ in range(10)]
del given
seen["kept memory"] = _nrt_python.memsys_get_stats_alloc() - _nrt_python.memsys_get_stats_free()
seen["values"] = pair.total(np.arange(4.0)), pair.mean(np.arange(4.0))
try:
    pair.mean(np.arange(4))
except TypeError as error:
    seen["refused"] = str(error)
print(json.dumps(seen))
"""


def ask(folder: Path, before: str = "") -> dict[str, Any]:
    (folder / "pair.py").write_text(PAIR)
    places = {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": f"{ROOT}:{folder}"}
    words = [sys.executable, "-c", ASK.replace("BEFORE", before)]
    done = subprocess.run(words, env={**os.environ, **places}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    seen: dict[str, Any] = json.loads(done.stdout)
    assert seen.pop("values") == [6.0, 1.5]
    assert seen.pop("refused").startswith("No matching definition")
    assert seen.pop("kept memory") == 0
    return seen


@pytest.mark.jit
def test_a_start_without_anything_to_compile_neither_gets_ready_to_nor_reads_bitcode(tmp_path: Path) -> None:
    assert ask(tmp_path)["compiled"] == 3 + 2  # numba's own, of ``empty``
    assert ask(tmp_path) == {"compiled": 0, "read": 0, "ready to compile": False, "ready to count": False}


@pytest.mark.jit
def test_who_is_compiled_later_takes_what_was_kept_into_itself(tmp_path: Path) -> None:
    ask(tmp_path)
    (left,) = (tmp_path / "cache").rglob("pair.mean-*.nbi")
    left.unlink()
    assert ask(tmp_path) == {"compiled": 1, "read": 1, "ready to compile": True, "ready to count": True}
    assert ask(tmp_path) == {"compiled": 0, "read": 0, "ready to compile": False, "ready to count": False}


@pytest.mark.jit
def test_a_numba_that_is_made_otherwise_loads_kernels_in_its_own_way(tmp_path: Path) -> None:
    ask(tmp_path)
    other = "estimator.numerics.jit_cache_load._known = False"
    assert ask(tmp_path, other)["compiled"] == 0
    assert ask(tmp_path, other)["ready to compile"]


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
