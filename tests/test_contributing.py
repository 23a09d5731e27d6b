"""CONTRIBUTING.md names what exists; the hooks are `make check`; `make bless` wants a reason; locks fit the groups."""

import os
import re
import subprocess
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "CONTRIBUTING.md").read_text()
MAKEFILE = (ROOT / "Makefile").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def make(*words: str) -> subprocess.CompletedProcess[str]:
    """A ``make`` that neither renews the environment nor inherits from the one that runs these tests."""
    own = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MAKEOVERRIDES", "ARGS", "REASON", "VENV")}
    command = ["make", "-s", "-o", ".venv/.dev-stamp", *words]
    return subprocess.run(command, cwd=ROOT, env=own, capture_output=True, text=True)


def test_paths_packages_and_names_of_the_page_exist() -> None:
    layout = re.findall(r"^    (.+)$", PAGE.partition("## Layout")[2].partition("\n* ")[0], re.MULTILINE)
    folder, paths = "", set[str]()
    for line in layout:
        if head := re.match(r"(\w+)/ ", line):
            folder = head[1]
        else:
            paths |= {f"{folder}/{entry}" for entry in line.split()}
    assert {"hal", "estimator", "daemon", "taps", "tools", "tests"} == {path.split("/")[0] for path in paths}
    named = re.findall(r"`((?:\w[\w.-]*/)*\w[\w.-]*/?)`", PAGE)
    paths |= {name for name in named if (ROOT / name.split("/")[0]).is_dir() or re.search(r"\.(md|toml|sh)$", name)}
    assert {"hal/lidar.py", "SECURITY.md", "tests/faults/cells.toml"} <= paths
    assert not [path for path in sorted(paths) if not ((ROOT / path).exists() or (ROOT / f"{path}.py").is_file())]
    pairs = re.findall(r"`(\w+)`(?: of| in| with[^`]*?)\s+`([\w/]+\.py)`", PAGE)
    assert ("_BUILT_IN", "hal/registry.py") in pairs
    assert not [(name, path) for name, path in pairs if not re.search(rf"\b{name}\b", (ROOT / path).read_text())]


def test_programs_and_targets_of_the_page_exist() -> None:
    named = set(re.findall(r"(?:`|^    )make ([a-z-]+)", PAGE, re.MULTILINE))
    targets = set(re.findall(r"^([a-z-]+):", MAKEFILE, re.MULTILINE))
    assert {"check", "quick", "test", "bless", "hooks"} <= named <= targets
    for module in re.findall(r"python -m ((?:\w+\.)*\w+)", PAGE):
        path = ROOT / module.replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module


def test_hooks_are_the_commands_of_make_check() -> None:
    """In their order, with the locked tools and not with others that are installed."""
    (repo,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert [hook["entry"] for hook in repo["hooks"]] == make("-n", "check").stdout.splitlines()
    assert all(hook["entry"].startswith(".venv/bin/") and not hook["pass_filenames"] for hook in repo["hooks"])
    assert f"max_line_length = {PROJECT['tool']['ruff']['line-length']}" in (ROOT / ".editorconfig").read_text()


def test_a_blessing_wants_a_reason_and_the_shell_does_not_read_it() -> None:
    done = make("bless")
    assert done.returncode != 0
    assert "REASON" in done.stdout
    assert '--reason "$REASON"' in make("-n", "bless", "REASON=x").stdout


def test_quick_leaves_out_what_make_test_leaves_out() -> None:
    recipes = re.findall(r"^(quick|test): venv.*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)
    marks = {name: re.findall(r'(-m|--marks) "(\S+)"', recipe) for name, recipe in recipes}
    assert marks == {"quick": [("--marks", "$(QUICK)")], "test": [("-m", "$(QUICK)")]}


def test_locks_hold_the_tools_of_the_groups() -> None:
    for lock, names in {"dev": ("test", "dev"), "bench": ("test", "dev", "bench")}.items():
        rows = (ROOT / f"requirements/{lock}.lock").read_text()
        locked = {name.replace("_", "-") for name in re.findall(r"^([\w.-]+)", rows.lower(), re.MULTILINE)}
        groups = [tool for name in names for tool in PROJECT["dependency-groups"][name] if isinstance(tool, str)]
        assert {name.lower().replace("_", "-") for tool in groups for name in re.findall(r"^[\w.-]+", tool)} <= locked
    for lock in ("requirements/dev.lock", "requirements/build.txt"):
        (version,) = re.findall(r"^setuptools==(\d+)", (ROOT / lock).read_text(), re.MULTILINE)
        assert int(version) >= 77, f"{lock}: the licence expression of the metadata needs it"
