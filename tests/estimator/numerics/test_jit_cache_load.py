"""Kernels that were compiled before: loaded without what only compiling needs, and still good for who is compiled."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

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
