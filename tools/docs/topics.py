"""``python -m tools.docs.topics``: docs/topics.md, an index of the pages for users from A to Z.

It has the headings of those pages, the keys of the configuration, the names of registers and the commands.
"""

import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Final, NamedTuple

import yaml

from daemon.config.loader import options

ROOT: Final = Path(__file__).parents[2]
FOR_USERS: Final = ("Start", "How to", "Reference", "How it works")
HEAD: Final = """<!-- Written by `python -m tools.docs.topics`, from the headings of the pages; do not edit. -->
# Index

Headings, keys of the configuration (*key*), registers with their address (*register*) and commands (*command*).
"""
REPEATED: Final = re.compile(r"magic|version|seq|seq_end|link_\d+_\w+|fault_\d+|restarts_\w+|\w+_(p50|p99|max)")
"""Registers that every block has, or that are numbered."""


class Entry(NamedTuple):
    """A line of the index: its word, where it leads, and what it is there."""

    word: str
    link: str
    note: str


def titles() -> dict[str, str]:
    """Of each page for users the name that the navigation gives it."""
    sections = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    pages = [page for section in sections for name, inner in section.items() if name in FOR_USERS for page in inner]
    return {file: title for page in pages for title, file in page.items()}


def anchor(heading: str) -> str:
    """GitHub's anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def headings(file: str, title: str) -> Iterator[Entry]:
    """Its headings below the first."""
    text = re.sub(r"^```.*?^```", "", (ROOT / "docs" / file).read_text(), flags=re.MULTILINE | re.DOTALL)
    for heading in re.findall(r"^##+ (.+)$", text, re.MULTILINE):
        if heading.startswith("lumiloop "):
            yield Entry(f"`{heading}`", f"{file}#{anchor(heading)}", "command")
        else:
            word = re.sub(r"^\d+\. ", "", heading)
            yield Entry(word[0].upper() + word[1:], f"{file}#{anchor(heading)}", title)


def registers() -> Iterator[Entry]:
    """Names in the tables of Modbus, each at its first place."""
    seen, section = set[str](), ""
    for line in (ROOT / "docs" / "modbus.md").read_text().splitlines():
        if line.startswith("## "):
            section = anchor(line[3:])
        row = re.match(r"\| (\d+) \| `(\w+)` \| \w*int\d+ \|", line)
        if row and row[2] not in seen and not REPEATED.fullmatch(row[2]):
            seen.add(row[2])
            yield Entry(f"`{row[2]}`", f"modbus.md#{section}", f"register {row[1]}")


def entries() -> list[Entry]:
    """All of them, in alphabetical order."""
    found = [entry for file, title in titles().items() for entry in headings(file, title)]
    found += [Entry(title, file, "page") for file, title in titles().items()]
    found += [Entry(f"`{option.path}`", "configuration.md", "key") for option in options()]
    return sorted({*found, *registers()}, key=lambda entry: (_sorted_by(entry.word), entry.link))


def _sorted_by(word: str) -> str:
    return re.sub(r"^(a|the|lumiloop) ", "", word.strip("`").lower())


def page() -> str:
    """The text of docs/topics.md."""
    parts = [HEAD]
    for letter, group in groupby(entries(), lambda entry: _sorted_by(entry.word)[0].upper()):
        rows = [f"* [{entry.word}]({entry.link}), {entry.note}" for entry in group]
        parts.append("\n".join([f"## {letter}", "", *rows]))
    return "\n".join([parts[0], "\n\n".join(parts[1:])]) + "\n"


def main() -> None:
    """Print the page."""
    print(page(), end="")


if __name__ == "__main__":
    main()
