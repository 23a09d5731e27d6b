"""What CONTRIBUTING.md names exists; the hooks are `make check`; `make quick` chooses the right tests."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tools.ci import durations
from tools.ci.imports import Tree
from tools.ci.quick import Choice, Why, changed, choose, fit, is_named_after, merge_base

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "CONTRIBUTING.md").read_text()
FOLDERS = ("hal", "estimator", "daemon", "taps", "tools", "systemd", "tests", "docs", "requirements")
STAMP = ".venv/.dev-stamp"
NEEDS_GIT = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def make(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """A ``make`` that neither makes the environment anew nor inherits from the one that runs these tests."""
    own = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MAKEOVERRIDES", "ARGS", "REASON", "VENV")}
    return subprocess.run(
        ["make", "-s", "-o", STAMP, *words], cwd=ROOT, env=own | variables, capture_output=True, text=True
    )


# the page


def test_the_page_is_short() -> None:
    assert len(PAGE.splitlines()) <= 150


def test_paths_that_the_page_names_exist() -> None:
    named = set(re.findall(r"`((?:\w[\w.-]*/)*\w[\w.-]*/?)`", PAGE))
    paths = {name for name in named if name.split("/")[0] in FOLDERS or re.search(r"\.(md|toml|sh)$", name)}
    assert {"hal/lidar.py", "SECURITY.md", "tests/faults/cells.toml"} <= paths
    assert not [path for path in sorted(paths) if not (ROOT / path).exists()]


def layout() -> Iterator[tuple[str, str]]:
    """Folder and entry of each word in the layout."""
    folder = ""
    for line in re.findall(r"^    (.+)$", PAGE.partition("## Layout")[2].partition("\n* ")[0], re.MULTILINE):
        if head := re.match(r"(\w+)/ ", line):
            folder = head[1]
        else:
            yield from ((folder, entry) for entry in line.split())


def test_packages_of_the_layout_exist() -> None:
    entries = list(layout())
    assert {"hal", "estimator", "daemon", "taps", "tools", "tests"} == {folder for folder, _ in entries}
    missing = [
        f"{folder}/{entry}"
        for folder, entry in entries
        if not (ROOT / folder / entry).is_dir() and not (ROOT / folder / f"{entry}.py").is_file()
    ]
    assert not missing


def test_names_are_in_the_files_that_the_page_says() -> None:
    pairs = re.findall(r"`(\w+)`(?: of| in| with[^`]*?)\s+`([\w/]+\.py)`", PAGE)
    assert ("_BUILT_IN", "hal/registry.py") in pairs
    assert not [(name, path) for name, path in pairs if not re.search(rf"\b{name}\b", (ROOT / path).read_text())]


def test_programs_and_targets_that_the_page_names_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = set(re.findall(r"(?:`|^    )make ([a-z-]+)", PAGE, re.MULTILINE))
    assert {"check", "quick", "test", "bless", "hooks"} <= named <= targets
    for module in re.findall(r"python -m ((?:\w+\.)*\w+)", PAGE):
        path = ROOT / module.replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module


# make


def test_hooks_are_the_commands_of_make_check() -> None:
    """In their order; and each finds the locked tool, not one that is installed beside it."""
    (repo,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    hooks = [hook["entry"] for hook in repo["hooks"]]
    assert hooks == make("-n", "check").stdout.splitlines()
    assert all(entry.startswith(".venv/bin/") for entry in hooks)
    assert all(hook["language"] == "system" and not hook["pass_filenames"] for hook in repo["hooks"])


def test_a_blessing_wants_a_reason() -> None:
    done = make("bless")
    assert done.returncode != 0
    assert "REASON" in done.stdout


def test_a_reason_reaches_the_program_as_it_is() -> None:
    said = make("-n", "bless", "REASON=x").stdout
    assert '--reason "$REASON"' in said, "the shell must not read quotes and dollars in it"


def test_quick_leaves_out_what_make_test_leaves_out() -> None:
    """Read, not asked with ``make -n``: a line with ``$(MAKE)`` in it runs even then."""
    recipes = re.findall(r"^(quick|test): venv.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {name: re.findall(r'(-m|--marks) "(\S+)"', recipe) for name, recipe in recipes} == {
        "quick": [("--marks", "$(QUICK)")],
        "test": [("-m", "$(QUICK)")],
    }


def test_editors_break_lines_where_ruff_does() -> None:
    ruff = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]
    assert f"max_line_length = {ruff['line-length']}" in (ROOT / ".editorconfig").read_text()


def test_locks_hold_the_tools_of_the_groups() -> None:
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["dependency-groups"]
    for lock, names in {"dev": ("test", "dev"), "bench": ("test", "dev", "bench")}.items():
        rows = (ROOT / f"requirements/{lock}.lock").read_text()
        locked = {name.replace("_", "-") for name in re.findall(r"^([\w.-]+)", rows.lower(), re.MULTILINE)}
        tools = {re.match(r"[\w.-]+", tool) for name in names for tool in groups[name] if isinstance(tool, str)}
        assert {tool[0].lower().replace("_", "-") for tool in tools if tool} <= locked


def test_the_locked_setuptools_takes_the_licence() -> None:
    """`pip install --no-build-isolation -e .` builds with the one of the environment."""
    for lock in ("requirements/dev.lock", "requirements/build.txt"):
        (version,) = re.findall(r"^setuptools==(\d+)", (ROOT / lock).read_text(), re.MULTILINE)
        assert int(version) >= 77, lock


# make quick: the choice


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A small source tree: a package with a face, tests that mirror it, a helper of the tests."""
    for name, text in {
        "hal/__init__.py": "",
        "hal/bus/__init__.py": "from hal.bus.i2c import Bus\n",
        "hal/bus/i2c.py": "class Bus: ...\n",
        "hal/clock.py": "",
        "hal/port/__init__.py": "",
        "hal/port/i2c.py": "",
        "docs/bus.md": "",
        "systemd/hal.service": "",
        "tests/__init__.py": "",
        "tests/helper.py": "import hal.bus.i2c\n",
        "tests/data/head.bin": "",
        "tests/data/test_data.py": "",
        "tests/test_docs.py": "PAGES = ['docs']\n",
        "tests/test_units.py": "UNIT = 'hal.service'\n",
        "tests/hal/bus/test_i2c.py": "def test() -> None:\n    from hal.bus.i2c import Bus\n",
        "tests/hal/bus/test_i2c_frames.py": "",
        "tests/hal/port/test_i2c.py": "import hal.port.i2c\n",
        "tests/hal/test_clock.py": "import hal.clock\n",
        "tests/hal/test_face.py": "import json\nimport hal.clock\nfrom hal.bus import Bus\n",
        "tests/hal/test_through.py": "from tests import helper\n",
        "tests/hal/test_broken.py": "def (:\n",
    }.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def chosen(root: Path, *paths: str) -> list[tuple[str, str]]:
    return [(choice.path.removeprefix("tests/"), choice.why.name) for choice in choose(Tree(root), paths)]


def test_the_most_specific_test_comes_first(tree: Path) -> None:
    assert chosen(tree, "hal/bus/i2c.py") == [
        ("hal/bus/test_i2c.py", "NAMED_AND_USES"),
        ("hal/bus/test_i2c_frames.py", "NAMED"),
        ("hal/test_face.py", "USES"),
        ("hal/test_through.py", "HELPER"),
    ]


def test_a_test_that_imports_little_else_comes_before_one_that_imports_much(tree: Path) -> None:
    (tree / "tests/hal/test_a_whole.py").write_text("import json, os, sys, hal.clock\n")
    assert [path for path, _ in chosen(tree, "hal/clock.py")] == [
        "hal/test_clock.py",
        "hal/test_a_whole.py",
        "hal/test_face.py",
    ]


def test_a_changed_test_comes_before_those_of_changed_modules(tree: Path) -> None:
    assert chosen(tree, "hal/clock.py", "tests/hal/test_through.py")[0] == ("hal/test_through.py", "CHANGED")


def test_a_changed_helper_of_tests_counts_as_imported(tree: Path) -> None:
    assert chosen(tree, "tests/helper.py") == [("hal/test_through.py", "USES")]


def test_a_module_that_is_gone_still_has_its_tests(tree: Path) -> None:
    (tree / "hal/clock.py").unlink()
    assert chosen(tree, "hal/clock.py")[0] == ("hal/test_clock.py", "NAMED_AND_USES")


def test_files_that_are_no_modules_go_by_name_and_folder(tree: Path) -> None:
    assert chosen(tree, "systemd/hal.service") == [("test_units.py", "USES")]
    assert chosen(tree, "docs/bus.md") == [("test_docs.py", "NAMED")]
    assert chosen(tree, "tests/data/head.bin") == [("data/test_data.py", "BESIDE")]
    assert {path for path, _ in chosen(tree, "tests/hal/conftest.py")} == {
        *("hal/bus/test_i2c.py", "hal/bus/test_i2c_frames.py", "hal/port/test_i2c.py", "hal/test_clock.py"),
        *("hal/test_face.py", "hal/test_through.py", "hal/test_broken.py"),
    }


def test_what_has_nothing_to_do_with_the_change_is_not_chosen(tree: Path) -> None:
    assert chosen(tree, "LICENSE") == []
    assert chosen(tree) == []


@pytest.mark.parametrize(
    ("test", "path", "named"),
    [
        ("tests/hal/hokuyo/test_driver.py", "hal/hokuyo/driver.py", True),
        ("tests/hal/photodiode/test_driver.py", "hal/hokuyo/driver.py", False),
        ("tests/hal/test_driver.py", "hal/hokuyo/driver.py", True),
        ("tests/hal/hokuyo/test_driver_states.py", "hal/hokuyo/driver.py", True),
        ("tests/hal/hokuyo/test_drivers.py", "hal/hokuyo/driver.py", False),
        ("tests/tools/test_bench_size.py", "tools/bench/size.py", True),
        ("tests/estimator/test_cdma.py", "estimator/cdma/__init__.py", True),
        ("tests/estimator/test_cdma.py", "estimator/cdma/decoder.py", True),
        ("tests/hal/test_hal.py", "hal/clock.py", False),
        ("tests/test_makefile.py", "Makefile", True),
        ("tests/test_contributing.py", "CONTRIBUTING.md", True),
        ("tests/test_docs.py", "tests/test_docs.py", False),
    ],
)
def test_a_test_is_named_after_a_file(test: str, path: str, named: bool) -> None:
    assert is_named_after(test, path) is named


def choices(*names: str) -> list[Choice]:
    return [Choice(Why.USES, turn, name) for turn, name in enumerate(names)]


def test_what_does_not_fit_into_the_budget_is_left_out() -> None:
    plan = fit(choices("a", "b", "c", "unknown"), {"a": 20.0, "b": 50.0, "c": 10.0}, 40.0)
    assert plan.taken == {"a": 20.0, "c": 10.0, "unknown": 2.0}
    assert plan.left == {"b": 50.0}


def test_where_nothing_fits_the_first_is_begun() -> None:
    plan = fit(choices("a", "b"), {"a": 90.0, "b": 80.0}, 40.0)
    assert (plan.taken, plan.left) == ({"a": 90.0}, {"b": 80.0})
    assert fit([], {}, 40.0).taken == {}


# make quick: the program


def git(root: Path, *words: str) -> None:
    who = ["-c", "user.name=nobody", "-c", "user.email=nobody@localhost", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", "-C", str(root), *who, *words], check=True, capture_output=True)


@pytest.fixture
def repository(tree: Path) -> Path:
    """The tree as a git repository, on a branch with a commit, a change, a deletion and an untracked file."""
    (tree / ".gitignore").write_text("__pycache__/\n.pytest_cache/\n")
    (tree / "tests/hal/test_broken.py").unlink()
    git(tree, "init", "-q", "-b", "main")
    git(tree, "add", "-A")
    git(tree, "commit", "-q", "-m", "Begin")
    git(tree, "switch", "-q", "-c", "work")
    (tree / "hal/clock.py").write_text("NOW = 1\n")
    git(tree, "commit", "-q", "-a", "-m", "Change")
    (tree / "docs/bus.md").unlink()
    (tree / "hal/bus/i2c.py").write_text("class Bus: ...\n\n")
    (tree / "hal/new one.py").write_text("")
    return tree


def program(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    code = "import sys; from pathlib import Path; from tools.ci.quick import main; sys.exit(main(root=Path.cwd()))"
    paths = {"PYTHONPATH": str(ROOT), "PYTEST_ADDOPTS": ""}
    return subprocess.run(
        [sys.executable, "-c", code, *words], cwd=root, env=os.environ | paths, capture_output=True, text=True
    )


@NEEDS_GIT
def test_changes_count_from_where_the_branch_left_main(repository: Path) -> None:
    differing = ["docs/bus.md", "hal/bus/i2c.py", "hal/clock.py", "hal/new one.py"]
    assert changed(repository, merge_base(repository)) == differing
    assert "hal/clock.py" not in changed(repository, "HEAD")
    assert merge_base(repository, mains=["trunk"]) == merge_base(repository, mains=["work"])
    with pytest.raises(RuntimeError, match="no-such"):
        changed(repository, "no-such")


@NEEDS_GIT
def test_the_program_runs_the_tests_of_the_change(repository: Path) -> None:
    (repository / "tests/hal/test_clock.py").write_text("import hal.clock\n\ndef test(): assert hal.clock.NOW == 1\n")
    done = program(repository, "--marks", "")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed" in done.stdout
    (repository / "hal/clock.py").write_text("NOW = 2\n")
    done = program(repository, "--marks", "")
    assert done.returncode == 1
    assert "1 failed, 1 passed" in done.stdout


@NEEDS_GIT
def test_the_program_says_what_it_leaves_out(repository: Path) -> None:
    cache = repository / ".pytest_cache/v" / durations.KEY
    cache.parent.mkdir(parents=True)
    cache.write_text(json.dumps({"tests/hal/test_clock.py": 70.0}))
    done = program(repository, "--marks", "", "--seconds", "30")
    assert done.returncode == 0
    assert "quick: left out: tests/hal/test_clock.py, about 70 s" in done.stdout
    listed = program(repository, "--list").stdout
    assert "out  tests/hal/test_clock.py  (named and uses)" in listed
    assert "passed" not in listed


@NEEDS_GIT
@pytest.mark.parametrize("hangs", [False, True])
def test_the_program_ends_in_time(repository: Path, hangs: bool) -> None:
    """Between two tests, and inside one that waits for something."""
    wait = "threading.Lock().acquire()" if not hangs else "lock = threading.Lock(); lock.acquire(); lock.acquire()"
    slow = f"import hal.clock, threading, time\n\ndef test_1(): {wait}\n\ndef test_2(): pass\n"
    (repository / "tests/hal/test_clock.py").write_text(slow)
    done = program(repository, "--marks", "", "--seconds", "6" if hangs else "0.5")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "out of time: " in done.stdout
    assert "of tests/hal/test_clock.py" in done.stdout


@NEEDS_GIT
def test_the_program_has_nothing_to_do_without_a_change(repository: Path) -> None:
    git(repository, "add", "-A")
    git(repository, "commit", "-q", "-m", "All")
    done = program(repository, "--base", "HEAD")
    assert done.returncode == 0
    assert done.stdout.startswith("quick: 0 files differ from HEAD; 0 test files")
    assert program(repository, "--base", "no-such").returncode == 2


def test_durations_are_kept_by_file_and_not_of_a_part(tmp_path: Path) -> None:
    (tmp_path / "tests").mkdir()
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "tests/test_a.py").write_text("import time\n\ndef test_1(): time.sleep(0.2)\n\ndef test_2(): pass\n")
    (tmp_path / "tests/test_b.py").write_text("def test(): pass\n")
    before = {"tests/test_b.py": 40.0, "tests/test_gone.py": 3.0}
    cache = tmp_path / ".pytest_cache/v" / durations.KEY
    cache.parent.mkdir(parents=True)
    cache.write_text(json.dumps(before))

    def run(*words: str) -> dict[str, float]:
        command = [sys.executable, "-m", "pytest", "-q", "-p", "tools.ci.durations", *words]
        paths = {"PYTHONPATH": str(ROOT), "PYTEST_ADDOPTS": ""}
        subprocess.run(command, cwd=tmp_path, env=os.environ | paths, capture_output=True, check=True)
        return durations.read(tmp_path)

    assert run("-k", "test_2") == before
    kept = run("-n", "1")
    assert set(kept) == {"tests/test_a.py", "tests/test_b.py"}
    assert kept["tests/test_a.py"] >= 0.2
    assert kept["tests/test_b.py"] < 40.0


@pytest.mark.parametrize("text", [None, "", "[1]", '{"tests/test_a.py": "long"}'])
def test_durations_that_cannot_be_read_are_none(tmp_path: Path, text: str | None) -> None:
    cache = tmp_path / ".pytest_cache/v" / durations.KEY
    cache.parent.mkdir(parents=True)
    if text is not None:
        cache.write_text(text)
    assert durations.read(tmp_path) == {}
