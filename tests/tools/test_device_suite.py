"""The suite on devices (tests/hil): what its options and its table of devices say before the first test."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.hil import conftest
from tests.hil.test_ends import suite


@pytest.mark.parametrize("capture", [(), ("-p", "no:capture")])
def test_that_kernels_are_compiled_is_said_also_where_nothing_is_captured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capture: tuple[str, ...]
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    code, said, _ = suite(tmp_path, *capture, "-k", "probe_finds_it")
    assert code == 0, said
    assert "the kernels of this tree are compiled first, once: that takes a minute or two" in said
    assert list(tmp_path.glob("cache/*/warm-*"))


def test_whatever_opens_a_device_is_known_as_of_it() -> None:
    """Else a wrong name is said only after kernels were compiled."""
    opens = {
        made.name: str(option.value)
        for made in ast.parse(Path(conftest.__file__).read_text()).body
        if isinstance(made, ast.FunctionDef) and any("fixture" in ast.unparse(by) for by in made.decorator_list)
        for call in ast.walk(made)
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "_device"
        if isinstance(option := call.args[1], ast.Constant)  # it is a variable where this table is gone through
    }
    assert opens == conftest.DEVICE_OF
