"""The documentation site builds without a warning and needs no network; its page of commands is current."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tools.docs import commands, topics
from tools.docs.site import within

ROOT = Path(__file__).parents[3]


def test_the_page_of_commands_is_current() -> None:
    assert (ROOT / "docs" / "commands.md").read_text() == commands.page(), "run: make docs"


def test_the_index_is_current_and_leads_to_headings_keys_and_registers() -> None:
    assert (ROOT / "docs" / "topics.md").read_text() == topics.page(), "run: make docs"
    found = {entry.word: entry for entry in topics.entries()}
    assert found["`map_x`"].note == "register 18"
    assert found["`integrity.alert_m`"].link == "configuration.md"
    assert found["`lumiloop map align`"].link == "commands.md#lumiloop-map-align"
    assert found["The flight recorder"].link == "replay.md#the-flight-recorder"


def test_the_page_of_commands_names_each_option() -> None:
    section = commands.page().partition("\n## lumiloop map align\n")[2].partition("\n## ")[0]
    assert {"--point", "--out"} <= set(re.findall(r"^ {4}(--\w+)", section, re.MULTILINE))


@pytest.mark.parametrize(
    ("link", "page", "kept"),
    [
        ("[a](modbus.md#faults)", "index.md", "[a](modbus.md#faults)"),
        ("[`a.b`](../estimator/a.py)", "theory.md", "`a.b`"),
        ("[a](../modbus.md)", "results/README.md", "[a](../modbus.md)"),
        ("[a](../../README.md)", "results/README.md", "a"),
        ("[a](https://zenoh.io/../x)", "index.md", "[a](https://zenoh.io/../x)"),
        ("![a](../x.png)", "index.md", "![a](../x.png)"),
    ],
)
def test_links_out_of_the_folder_become_text(link: str, page: str, kept: str) -> None:
    assert within(f"See {link}.", page) == f"See {kept}."


def test_the_site_builds_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="make docs installs it")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 50
    for page in pages:
        loaded = re.findall(r"""<(?:script|img|iframe)\b[^>]*\bsrc="?([^"\s>]+)""", page.read_text())
        loaded += re.findall(r"""<link\b[^>]*\brel="?(?:stylesheet|preconnect|preload)\b[^>]*>""", page.read_text())
        assert not [one for one in loaded if "//" in one], page.name
    assert (tmp_path / "search" / "search_index.js").stat().st_size > 10_000
