"""What the Makefile promises of all its targets."""

import os
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_no_two_targets_run_at_once(tmp_path: Path) -> None:
    """Suites judge against the wall clock, and share ports and the folder ``out``."""
    path = tmp_path / "Makefile"
    path.write_text(f"include {ROOT}/Makefile\none two:\n\t@echo begin $@; sleep 0.2; echo end $@\n")
    command = ["make", "-s", "-j4", "-f", str(path), "one", "two"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["begin one", "end one", "begin two", "end two"]


def shown(*words: str) -> str:
    """What a command writes; a ``make`` that runs these tests hands its own words down by the environment."""
    own = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MAKEOVERRIDES", "ARGS")}
    return subprocess.run(words, cwd=ROOT, env=own, capture_output=True, text=True, check=True).stdout


def test_the_orderly_suites_read_every_file_with_such_tests() -> None:
    """`make test-system` reads the files that its ``grep`` finds; a mark that is given elsewhere would go unseen."""
    said = shown("make", "-n", "test-system")
    (found,) = set(re.findall(r"\$\((grep .* \| sort)\)", said))
    read = set(shown("sh", "-c", found).split())
    marked = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "tests").rglob("*.py")
        if re.search(r"mark\.(system|realtime)\b", path.read_text())
    }
    assert "tests/systemd/test_container.py" in read
    assert marked <= read
    assert "grep" not in shown("make", "-n", "test-system", "ARGS=tests/hil -x")
