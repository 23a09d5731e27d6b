"""`make quick`: the most specific tests of a change come first, and the run ends in time."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tools.ci.quick import changed, choose, is_named_after

ROOT = Path(__file__).parents[3]
FILES = {
    ".gitignore": "__pycache__/\n.pytest_cache/\n",
    "hal/__init__.py": "", "hal/clock.py": "NOW = 0\n", "hal/bus/i2c.py": "", "hal/old.py": "", "README.md": "",
    "tests/__init__.py": "",
    "tests/hal/test_clock.py": "import hal.clock\n\n\ndef test(): assert hal.clock.NOW == 1\n",
    "tests/hal/test_clock_alone.py": "",
    "tests/hal/test_all.py": "import json\nimport hal.bus.i2c\nfrom hal import clock\n",
    "tests/hal/test_broken.py": "def (:\n",
    "tests/hal/bus/test_i2c.py": "",
}  # fmt: skip


def git(root: Path, *words: str) -> None:
    who = ["-c", "user.name=nobody", "-c", "user.email=nobody@localhost", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", "-C", str(root), *who, *words], check=True, capture_output=True)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A branch with a commit after main, a deletion and an untracked file."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for words in ("init -q -b main", "add -A", "commit -q -m Begin", "switch -q -c work"):
        git(tmp_path, *words.split())
    (tmp_path / "hal/clock.py").write_text("NOW = 1\n")
    git(tmp_path, "commit", "-q", "-a", "-m", "Change")
    (tmp_path / "hal/old.py").unlink()
    (tmp_path / "hal/new one.py").write_text("")
    return tmp_path


def test_changes_count_from_the_merge_base_with_main(tree: Path) -> None:
    assert changed(tree) == ["hal/clock.py", "hal/new one.py", "hal/old.py"]
    assert changed(tree, "HEAD") == ["hal/new one.py", "hal/old.py"]
    with pytest.raises(RuntimeError, match="no-such"):
        changed(tree, "no-such")


def test_the_most_specific_test_comes_first(tree: Path) -> None:
    names = ["test_clock.py", "test_clock_alone.py", "test_all.py"]
    assert choose(tree, ["hal/clock.py"]) == [f"tests/hal/{name}" for name in names]
    assert choose(tree, ["hal/bus/i2c.py"]) == ["tests/hal/bus/test_i2c.py", "tests/hal/test_all.py"]
    assert choose(tree, ["hal/clock.py", "tests/hal/test_broken.py"])[0] == "tests/hal/test_broken.py"
    assert choose(tree, ["README.md"]) == []
    assert is_named_after("tests/test_makefile.py", "Makefile")
    assert is_named_after("tests/estimator/test_cdma.py", "estimator/cdma/decoder.py")
    assert not is_named_after("tests/hal/photodiode/test_driver.py", "hal/hokuyo/driver.py")


@pytest.mark.parametrize(
    ("body", "seconds", "code", "said"),
    [
        ("assert hal.clock.NOW == 1", 60.0, 0, "1 passed"),
        ("assert hal.clock.NOW == 2", 60.0, 1, "1 failed"),
        ("pass\n\ndef test_late(): pass", 1.0, 0, "left out: 1 tests of tests/hal/test_clock.py"),
        ("threading.Event().wait()", 6.0, 0, "left out: 1 tests of tests/hal/test_clock.py"),
    ],
)
def test_the_program_runs_the_tests_and_ends_in_time(
    tree: Path, body: str, seconds: float, code: int, said: str
) -> None:
    (tree / "tests/hal/test_broken.py").unlink()
    (tree / "tests/hal/test_clock.py").write_text(f"import hal.clock, threading\n\ndef test(): {body}\n")
    program = f"from pathlib import Path; from tools.ci import quick; quick.BUDGET_S = {seconds}; "
    program += "raise SystemExit(quick.main(['--marks', ''], Path.cwd()))"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTEST_ADDOPTS": ""}
    done = subprocess.run([sys.executable, "-c", program], cwd=tree, env=environment, capture_output=True, text=True)
    assert done.returncode == code, done.stdout + done.stderr
    assert said in done.stdout
