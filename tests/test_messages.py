"""Messages that a person reads, collected from the sources: their sentences are short, their words those in use.

A message is a string of three words or more that is no docstring: of a log line, a fault, a remedy, a refusal, a help
text, a line of a report, a text of the web page.
"""

import ast
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Final

import pytest

from tests.test_docs_prose import NOT_USED as NOT_IN_PAGES

ROOT: Final = Path(__file__).parents[1]
PAGE: Final = ROOT / "taps" / "view" / "page"
MEAN: Final = 8.0
LONGEST: Final = 25
"""Words of a sentence; a value, a name or a text between backticks is one."""
CLAUSES: Final = 2
"""Parts between semicolons, of one sentence."""
NOT_USED: Final = re.compile(
    r"\b(mend(?:s|ed)?|begun|knocked|dazzled|dissents?|guess(?:es)?|nobody|somebody|everybody|anybody|"
    r"ask(?:s|ed)? for|looked (?:at|for)|passed over|left out|carried|goes on|gone on|come(?:s)? back|is there|"
    r"do(?:es)? not (?:fit the place|shine)|by itself|again and again|for want of|hangs?|places?|pictures?)\b",
    re.IGNORECASE,
)
"""Further words of the list in docs/glossary.md, and words that do not name the cause, the place or the action."""
NO_PROSE: Final = (
    "daemon/cli/lamps/codes.py",  # C source
    "daemon/cli/manual/completion.py",  # scripts of shells
    "daemon/cli/manual/man_pages.py",  # roff
    "daemon/publish/document",  # pages, tested as such
    "hal/fake/lidar/models.py",  # replies of sensors
    "hal/fake/lidar/info_replies.py",
    "taps/ros/types.py",  # ROS interface definitions
)
SPOKEN: Final = {"raise", "debug", "info", "warning", "error", "exception", "critical", "log"}
WORD: Final = re.compile(r"\S*\w\S*")


class Message:
    """A message with its place in the sources; ``{}`` stands for a value."""

    def __init__(self, path: Path, line: int, text: str) -> None:
        self.place = f"{path.relative_to(ROOT)}:{line}"
        self.text = text

    def sentences(self) -> Iterator[str]:
        """Yields the sentences, without code."""
        plain = re.sub(r"`[^`]*`", "code", self.text)
        yield from (one for one in re.split(r"(?<=[.!?])\s+|\n+", plain) if WORD.search(one))


def _text(node: ast.expr) -> str | None:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"%(?:\(\w+\))?[-+#0]*\d*(?:\.\d+)?[a-zA-Z](?![a-z])", "{}", node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return None


def _silent(tree: ast.AST) -> set[ast.AST]:
    """Returns the strings that are docstrings or parts of other strings."""
    found: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):
            found.add(node.value)
        elif isinstance(node, ast.JoinedStr):
            found.update(inner for inner in ast.walk(node) if inner is not node)
    return found


def _spoken(tree: ast.AST) -> Iterator[ast.AST]:
    """Yields what the estimator shows to a person: errors, log lines, and the reasons of scan matches."""
    for node in ast.walk(tree):
        called = node.func.attr if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) else ""
        of_matches = isinstance(node, ast.ClassDef) and node.name == "Reason"
        if isinstance(node, ast.Raise) or called in SPOKEN or of_matches:
            yield from ast.walk(node)


def of_source(path: Path, source: str) -> Iterator[Message]:
    """Yields the messages of a Python source."""
    tree = ast.parse(source)
    silent = _silent(tree)
    nodes = set(_spoken(tree)) if path.is_relative_to(ROOT / "estimator") else set(ast.walk(tree))
    for node in nodes - silent:
        text = _text(node) if isinstance(node, ast.expr) else None
        if text is not None and _is_prose(text):
            yield Message(path, node.lineno, text)


def _is_prose(text: str) -> bool:
    words = re.findall(r"[A-Za-z_]{2,}", text.replace("{}", " "))
    code = re.search(r"::|\w\(\w+\[|</|\$\{|'none'|[{}]{3}|^void\(|\(\?[<!]|\w\? \w|charset", text)
    return len(words) >= 3 and " " in text.strip() and code is None and text.count("\n") < 4


class _Texts(HTMLParser):
    """Texts, titles and labels of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[int, str]] = []

    def handle_data(self, data: str) -> None:
        self.found.append((self.getpos()[0], data))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [(self.getpos()[0], text) for key, text in attrs if key in ("title", "aria-label") and text]


def of_page() -> Iterator[Message]:
    """Yields the messages of the web page."""
    index = PAGE / "index.html"
    parser = _Texts()
    parser.feed(index.read_text())
    yield from (Message(index, line, text) for line, text in parser.found if _is_prose(text))
    for path in sorted(PAGE.glob("*.js")):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            for quoted in re.findall(r'"((?:[^"\\]|\\.)*)"|`([^`]*)`', line.partition(" // ")[0]):
                text = re.sub(r"\$\{[^}]*\}", "{}", "".join(quoted))
                if _is_prose(text) and re.match(r"[A-Za-z{]", text) and not re.search(r"[=<>]|px ", text):
                    yield Message(path, number, text)


def messages() -> Iterator[Message]:
    """Yields all messages of the program."""
    for room in ("daemon", "hal", "taps", "estimator", "tools/demo"):
        for path in sorted((ROOT / room).rglob("*.py")):
            if not str(path.relative_to(ROOT)).startswith(NO_PROSE):
                yield from of_source(path, path.read_text())
    yield from of_page()


ALL: Final = list(messages())


def unsaid(text: str) -> list[str]:
    """Returns the words of a message that are not used."""
    plain = re.sub(r"`[^`]*`", "", text)
    return [found[0] for pattern in (NOT_IN_PAGES, NOT_USED) for found in pattern.finditer(plain)]


def test_messages_are_found() -> None:
    source = (
        '"""Not a docstring of three words."""\n'
        'log.info("lamp %d is not received", 3)\n'
        'raise ValueError(f"{path}: no such file; "\n    f"name {another!r} file")\n'
        'key = "two words"\n'
    )
    found = {message.text for message in of_source(ROOT / "daemon" / "x.py", source)}
    assert found == {"lamp {} is not received", "{}: no such file; name {} file"}
    assert [message.text for message in of_source(ROOT / "estimator" / "x.py", 'A = "as seen elsewhere here"\n')] == []
    assert list(Message(ROOT / "x", 1, "One two. `a b` three?\nFour").sentences()) == [
        "One two.",
        "code three?",
        "Four",
    ]
    assert unsaid("mend it, or let go of `mend`") == ["let go", "mend"]
    rooms = {message.place.partition("/")[0] for message in ALL}
    assert rooms == {"daemon", "hal", "taps", "estimator", "tools"}
    assert {"faults.py", "parser.py", "moment_report.py", "main.js", "index.html"} <= {
        message.place.rpartition(":")[0].rpartition("/")[2] for message in ALL
    }


def test_sentences_are_short() -> None:
    lengths = [(len(WORD.findall(part)), message.place, part) for message in ALL for part in _parts(message)]
    assert [one for one in lengths if one[0] > LONGEST] == []
    assert sum(number for number, *_ in lengths) / len(lengths) <= MEAN


def _parts(message: Message) -> Iterator[str]:
    """Yields what is read in one breath: a cause and its remedy are parted by a semicolon."""
    for sentence in message.sentences():
        yield from (part for part in sentence.split(";") if WORD.search(part))


def test_sentences_are_no_chains() -> None:
    chains = [(message.place, one) for message in ALL for one in message.sentences() if one.count(";") >= CLAUSES]
    assert chains == []


@pytest.mark.parametrize("room", ["daemon", "hal", "taps", "estimator", "tools"])
def test_words_are_those_in_use(room: str) -> None:
    found = [(one.place, unsaid(one.text), one.text) for one in ALL if one.place.startswith(f"{room}/")]
    assert [one for one in found if one[1]] == []


def test_remedies_are_no_questions() -> None:
    asking = [one for one in ALL if "?" in re.sub(r"`[^`]*`", "", one.text) and "did you mean" not in one.text]
    assert [(one.place, one.text) for one in asking] == []
