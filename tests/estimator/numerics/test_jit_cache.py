"""Kernels are kept by what shaped them; those of earlier versions are removed, those that may be running are not."""

import os
import time
from pathlib import Path

import pytest

from estimator.numerics import jit, jit_cache

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
