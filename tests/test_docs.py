"""The documents: every relative link leads somewhere, every command and make target named exists."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.cli.parser import main

ROOT = Path(__file__).parents[1]
ROOMS = ("daemon", "estimator", "hal", "taps", "tools", "tests", "systemd")
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]


def anchors(page: Path) -> set[str]:
    """GitHub's anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith(("http:", "https:")):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name) if name else page
        assert file.exists(), f"{page.name}: {target}"
        if anchor:
            assert anchor in anchors(file), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = set(re.findall(r"(?:^|`| )make ([a-z][a-z-]+)(?=[`\s]*(?:#|`|$))", page.read_text(), re.MULTILINE))
    assert named <= targets, f"{page.name} names {sorted(named - targets)}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_commands_exist(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help", "all"]) == 0
    known = capsys.readouterr().out
    for command in set(re.findall(r"(?:`|bin/|^ {4,})lumiloop ([a-z][a-z0-9-]+)\b", page.read_text(), re.MULTILINE)):
        assert re.search(rf"^\s+{command} ", known, re.MULTILINE), f"{page.name} names `lumiloop {command}`"


def test_every_equation_of_the_paper_leads_to_functions_that_exist() -> None:
    page = (ROOT / "docs" / "theory.md").read_text()
    rows = re.findall(r"^\| (Eq\. \d+|[^|]+?) \| .*$", page, re.MULTILINE)
    assert [f"Eq. {number}" for number in range(1, 16)] == [row for row in rows if row.startswith("Eq.")]
    named = re.findall(r"\[`(\w+)\.(\w+)`\]\(\.\./(estimator/\w+/\w+\.py)\)", page)
    assert len(named) == page.count("](../")
    for module, name, file in named:
        assert Path(file).stem == module
        assert re.search(rf"^(def|class) {name}\b", (ROOT / file).read_text(), re.MULTILINE), f"{module}.{name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_source_files_exist(page: Path) -> None:
    files = {path.name for room in ROOMS for path in (ROOT / room).rglob("*.py")}
    named = set(re.findall(r"`(?:[\w./]*/)?(\w+\.py)`", page.read_text()))
    assert named <= files, f"{page.name} names {sorted(named - files)}"


def test_the_subscription_protocol_is_a_list_of_three_steps() -> None:
    section = (ROOT / "docs" / "udp.md").read_text().partition("## Subscribing\n")[2].partition("\n## ")[0]
    assert re.findall(r"^(\d\. \S+ \S+) ", section, re.MULTILINE) == ["1. Send ASK", "2. Send ASK", "3. Ask again"]


def test_words_for_the_fuzz_target_are_options_of_pytest() -> None:
    row, recipe = re.findall(r"^fuzz:.*\n\t.*", (ROOT / "Makefile").read_text(), re.MULTILINE)[0].splitlines()
    page = re.findall(r"`make fuzz` \([^)]*\)", (ROOT / "docs" / "performance.md").read_text())[0]
    words = re.findall(r'ARGS="(-\w) (\w+)"', row + page)
    assert ("-m", "slow") in words
    (file,) = re.findall(r"tests/\S+\.py", recipe)
    for option, word in words:
        command = [sys.executable, "-m", "pytest", "-q", "--collect-only", "-m", "not slow", file, option, word]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, f"{option} {word}: {done.stdout}{done.stderr}"


def programs() -> dict[str, list[tuple[str, list[str]]]]:
    """Of each module that the documents start with ``python -m`` or ``make``: where, and with which options."""
    found: dict[str, list[tuple[str, list[str]]]] = {}
    for page in PAGES:
        text = page.read_text().replace("\\\n", "")
        told = re.findall(r"python -m ((?:tools|hal|tests)[\w.]*)([^\n`#]*)", text)
        for target, words in re.findall(r"make (experiments|bench|demo|soak)\b(?: ARGS=(\"[^\"]*\"|\S+))?", text):
            told.append((MADE[target], words.strip('"`')))
        for module, words in told:
            options = re.findall(r"(?<![\w-])--[a-z][a-z-]*", words)
            found.setdefault(module.rstrip("."), []).append((page.name, options))
    return found


MADE = {"experiments": "tools.experiments", "bench": "tools.bench", "demo": "tools.demo.run", "soak": "tools.soak"}


HELP = """
import contextlib, io, json, runpy, sys
said = {}
for module in sys.argv[1:]:
    out, code = io.StringIO(), 0
    sys.argv = [module, "--help"]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        except SystemExit as end:
            code = end.code or 0
        except Exception as error:
            code = repr(error)
    said[module] = code, out.getvalue()
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def helps() -> dict[str, tuple[object, str]]:
    """How each program ends that is asked for its help, and what it says; one process, which loads numba once."""
    command = [sys.executable, "-c", HELP, *sorted(programs())]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said: dict[str, tuple[object, str]] = json.loads(done.stdout)
    return said


@pytest.mark.parametrize("module", sorted(programs()))
def test_programs_of_the_documents_know_the_options_named(module: str, helps: dict[str, tuple[object, str]]) -> None:
    """Each is started for its help, with what is installed for the tests."""
    code, said = helps[module]
    assert code == 0, said
    for page, options in programs()[module]:
        for option in options:
            assert re.search(rf"{option}\b", said), f"{page}: {module} {option}"


def test_no_picture_is_kept_beside_the_one_that_a_command_keeps() -> None:
    """It would stay as it is when the figures change."""
    pictures = {path.name for path in (ROOT / "docs" / "images").glob("*.png")}
    assert not pictures & {path.name for path in (ROOT / "docs" / "results").glob("*.png")}
    assert (
        set(re.findall(r"`([\w-]+\.png)`", (ROOT / "docs" / "images" / "README.md").read_text())) - {"map.png"}
        == pictures
    )


def test_the_glossary_leads_to_files_that_exist() -> None:
    page = (ROOT / "docs" / "glossary.md").read_text()
    named = re.findall(r"`((?:estimator|daemon|hal|taps)/[\w/]+(?:\.py|/))`", page)
    assert len(named) > 40
    assert [path for path in named if not (ROOT / path).exists()] == []
