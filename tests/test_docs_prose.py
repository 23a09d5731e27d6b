"""The pages for users: their number of words, and the length of their sentences."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

ROOT: Final = Path(__file__).parents[1]
DOCS: Final = ROOT / "docs"
FOR_USERS: Final = ("Start", "How to", "Reference", "How it works")
MOST_WORDS: Final = 32_000
MEAN: Final = 17.0
LONGEST: Final = 35
GENERATED: Final = {"modbus.md", "udp.md", "codes.md", "commands.md", "configuration.md"}
"""Their texts are those of the program."""
NOT_USED: Final = re.compile(
    r"\b(adrift|anew|afresh|askew|astray|lasers?|witness(?:es)?|lean(?:s|ed)?|bent|hears?|heard|hung|whoever|"
    r"twins?|says?|said|tells?|told|speaks?|carried off|lets? go|stands? still|vague|surer|unsure|"
    r"leaps?|ladder|rungs?|hints?)\b",
    re.IGNORECASE,
)
"""Of the list in docs/glossary.md, those that have no other use."""
GIVEN: Final = {
    "receiver.md": {"the converter says", "leans by 1 deg"},  # calculated tables
}
WORD: Final = re.compile(r"\S*\w\S*")
ITEM: Final = re.compile(r"^ *(?:[*-]|\d+\.) +")


def navigation() -> dict[str, list[str]]:
    """Of each section of the site its pages, in their order."""
    sections: list[dict[str, Any]] = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    return {
        name: [inner]
        if isinstance(inner, str)
        else [one if isinstance(one, str) else next(iter(one.values())) for one in inner]
        for section in sections
        for name, inner in section.items()
    }


PAGES: Final = [page for section in FOR_USERS for page in navigation()[section]]


def uncoded(text: str) -> Iterator[str]:
    """Lines of a page without its blocks of code and its comments."""
    fenced, listed, blank = False, False, True
    for line in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL).splitlines():
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced:
            indent = len(line) - len(line.lstrip())
            if not line.strip():
                blank = True
            elif not (indent >= (8 if listed else 4) and blank):
                blank, listed = False, bool(ITEM.match(line)) or (listed and indent > 0)
                yield line
                continue
            yield ""


def units(text: str) -> Iterator[str]:
    """Paragraphs and items of lists, each in one line; headings, tables and pictures left out."""
    unit: list[str] = []
    for line in [*uncoded(text), ""]:
        apart = not line.strip() or line.lstrip().startswith(("#", "|", "![", "<img"))
        if unit and (apart or ITEM.match(line)):
            yield " ".join(unit)
            unit = []
        if not apart:
            unit.append(ITEM.sub("", line).strip())


def sentences(text: str) -> Iterator[list[str]]:
    """Words of each sentence; what stands between backticks is one word."""
    for unit in units(text):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", unit)
        plain = re.sub(r"`[^`]*`", "code", plain).replace("*", "")
        for sentence in re.split(r"(?<=[.!?])[\"')]* +(?=[\"'(]*[A-Z0-9]|code|lumiloop)", plain):
            if words := WORD.findall(sentence):
                yield words


def test_the_counting_is_right() -> None:
    text = "# Head\n\nOne two. `a b` three four:\n\n    code\n\n* One [two](x.md) x.\n  Goes on.\n\n| a | b |\n"
    assert [len(words) for words in sentences(text)] == [2, 3, 3, 2]
    assert sum(len(WORD.findall(line)) for line in uncoded(text)) == 14


@pytest.mark.parametrize("page", [*PAGES, "faults.md", "glossary.md", "simulator.md"])
def test_sentences_are_short(page: str) -> None:
    lengths = [(len(words), " ".join(words)) for words in sentences((DOCS / page).read_text())]
    assert [one for one in lengths if one[0] > LONGEST] == []
    assert sum(number for number, _ in lengths) / max(1, len(lengths)) <= MEAN


@pytest.mark.parametrize("page", sorted(set(PAGES) - GENERATED))
def test_words_are_those_of_the_glossary(page: str) -> None:
    text = "\n".join(uncoded((DOCS / page).read_text()))
    for given in GIVEN.get(page, ()):
        text = text.replace(given, "")
    plain = re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`\n]*`", "", text))
    assert NOT_USED.findall(plain) == []


def test_the_pages_for_users_can_be_read() -> None:
    words = sum(len(WORD.findall(line)) for page in PAGES for line in uncoded((DOCS / page).read_text()))
    assert words <= MOST_WORDS


def test_every_page_is_in_the_site() -> None:
    found = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}
    assert found - {page for pages in navigation().values() for page in pages} == {
        page for page in found if page.startswith("results/") and page != "results/README.md"
    }
