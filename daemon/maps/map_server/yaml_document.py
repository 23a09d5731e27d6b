"""YAML reader for map descriptions (YAML 1.2): the first document of a file, as text, lists and mappings.

It reads block and flow collections, quoted and plain scalars over several lines, block scalars, comments, tags, anchors
and aliases. Scalars stay text, because yaml-cpp, which nav2 uses, converts quoted and plain ones alike. Merge keys and
collections as keys do not occur in such files and are refused.
"""

from __future__ import annotations

import re
from typing import Final

Node = str | list["Node"] | dict[str, "Node"]

DEEPEST: Final = 32
"""Most collections within one another."""
MOST_NODES: Final = 10_000
"""Most scalars and collections, repeated aliases included."""
_SHOWN: Final = 60
_ESCAPES: Final = {
    "0": "\0", "a": "\a", "b": "\b", "t": "\t", "\t": "\t", "n": "\n", "v": "\v", "f": "\f", "r": "\r", "e": "\x1b",
    " ": " ", '"': '"', "/": "/", "\\": "\\", "N": "\x85", "_": "\xa0", "L": "\u2028", "P": "\u2029",
}  # fmt: skip
_HEX: Final = {"x": 2, "u": 4, "U": 8}
_PROPERTY: Final = re.compile(r"([&!][^\s,\[\]{}]*)(?:\s+|$)")
_BEFORE_QUOTE: Final = " \t\n[{,:"
"""Characters behind which a quote begins a quoted text; elsewhere it is a character of a plain one."""
_NULLS: Final = ("~", "null", "Null", "NULL")


class BadYaml(Exception):
    """Text that this reader does not understand; the message begins with the line's number."""


def parse(text: str) -> Node:
    """The first document of a text; an empty one is empty text.

    Raises:
        BadYaml: not YAML, or a kind of it that does not occur in map descriptions.
    """
    return _Parser(text).document()


class _Parser:
    def __init__(self, text: str) -> None:
        self._lines = _first_document(text)
        self._at = 0  # present line
        self._anchors: dict[str, Node] = {}
        self._nodes = 0

    def document(self) -> Node:
        node = self._block(-1, 0)
        if self._next() is not None:
            raise self._bad("is not `key: value`")
        return node

    def _bad(self, problem: str, at: int | None = None) -> BadYaml:
        at = min(self._at if at is None else at, max(0, len(self._lines) - 1))
        shown = self._lines[at].strip()[:_SHOWN] if self._lines else ""
        return BadYaml(f"line {at + 1} {problem}: {shown}")

    def _next(self) -> tuple[int, str] | None:
        """Indentation and content of the next line that has any; None at the end."""
        while self._at < len(self._lines):
            line = _uncommented(self._lines[self._at])
            if content := line.strip():
                indent = len(line) - len(line.lstrip(" "))
                if line[indent] == "\t":
                    raise self._bad("is indented by a tab")
                return indent, content
            self._at += 1
        return None

    def _count(self, depth: int) -> None:
        self._nodes += 1
        if depth > DEEPEST or self._nodes > MOST_NODES:
            raise self._bad("has more content than a map description")

    def _block(self, parent: int, depth: int) -> Node:
        """The block node that is indented further than ``parent``; empty text without one."""
        self._count(depth)
        found = self._next()
        if found is None or found[0] <= parent:
            return ""
        indent, content = found
        if content == "-" or content.startswith("- "):
            return self._sequence(indent, depth)
        if _key_of(content) is not None:
            return self._mapping(indent, depth)
        if content[0] in "[{'\"|>&!*" or parent >= 0:
            self._at += 1
            return self._value(content, parent, depth)
        raise self._bad("is not `key: value`")

    def _sequence(self, indent: int, depth: int) -> Node:
        items: list[Node] = []
        while (found := self._next()) is not None and found[0] == indent and (found[1] + " ").startswith("- "):
            rest = found[1][1:].strip()
            inner = indent + len(found[1]) - len(found[1][1:].lstrip())
            if rest and _key_of(rest) is not None and rest[0] not in "[{":
                self._lines[self._at] = " " * inner + rest  # a mapping that begins behind the dash
                items.append(self._mapping(inner, depth + 1))
            else:
                self._at += 1
                items.append(self._value(rest, indent, depth + 1))
        return items

    def _mapping(self, indent: int, depth: int) -> Node:
        fields: dict[str, Node] = {}
        while (found := self._next()) is not None and found[0] == indent:
            split = _key_of(found[1])
            if split is None:
                raise self._bad("is not `key: value`")
            key, value = split
            if key in fields:
                raise self._bad(f"repeats `{key}`")
            self._at += 1
            following = self._next() if not value else None
            dashed = following is not None and following[0] == indent and (following[1] + " ").startswith("- ")
            fields[key] = self._value(value, indent - dashed, depth + 1)
        if found is not None and found[0] > indent:
            raise self._bad("is not `key: value`")
        return fields

    def _value(self, text: str, indent: int, depth: int) -> Node:
        """The node that begins with ``text``, the rest of the line before the present one."""
        anchor = ""
        while match := _PROPERTY.match(text):
            anchor = match[1][1:] if match[1][0] == "&" else anchor
            text = text[match.end() :]
        if not text:
            node = self._block(indent, depth)
        else:
            self._count(depth)
            node = self._inline(text, indent, depth)
        if anchor:
            self._anchors[anchor] = node
        return node

    def _inline(self, text: str, indent: int, depth: int) -> Node:
        if text[0] == "*":
            return self._alias(text[1:], depth)
        if text[0] in "|>":
            return self._literal(text, indent)
        if text[0] in "[{'\"":
            begun = self._at - 1
            extent = _Extent()
            while (end := extent.end(text)) < 0:
                if self._at >= len(self._lines):
                    what = "the list or mapping" if text[0] in "[{" else "the quoted text"
                    raise self._bad(f"begins {what} without an end", begun)
                line = self._lines[self._at]
                text += "\n" + (line.strip() if text[0] in "'\"" else _uncommented(line).strip())
                self._at += 1
            if text[end:].strip():
                raise self._bad("continues after its value", self._at - 1)
            return self._flow(_Cursor(text[:end]), depth) if text[0] in "[{" else _unquoted(text[:end])
        while (found := self._next()) is not None and found[0] > indent:
            if _key_of(found[1]) is not None:
                raise self._bad("is not `key: value`")
            text += " " + found[1]
            self._at += 1
        return "" if text in _NULLS else text

    def _alias(self, name: str, depth: int) -> Node:
        if name not in self._anchors:
            raise self._bad("names an anchor that does not exist", self._at - 1)
        for _ in range(_size(self._anchors[name])):
            self._count(depth)
        return self._anchors[name]

    def _literal(self, head: str, indent: int) -> str:
        """A block scalar: its lines, folded to one where it begins with ``>``."""
        lines: list[str] = []
        while self._at < len(self._lines):
            line = self._lines[self._at]
            if line.strip() and len(line) - len(line.lstrip(" ")) <= indent:
                break
            lines.append(line.strip())
            self._at += 1
        text = (" " if head[0] == ">" else "\n").join(lines).rstrip()
        return text if head[1:2] == "-" else text + "\n"

    def _flow(self, cursor: _Cursor, depth: int) -> Node:
        """A flow node, from its first character."""
        self._count(depth)
        anchor = ""
        while match := _PROPERTY.match(cursor.rest()):
            anchor = match[1][1:] if match[1][0] == "&" else anchor
            cursor.at += match.end()
        begin = cursor.skip()
        node: Node
        if begin in ("[", "{"):
            node = self._flow_collection(cursor, begin, depth)
        elif begin in ("'", '"'):
            if (size := _Extent().end(cursor.rest())) < 0:
                raise self._bad("begins a quoted text without an end", self._at - 1)
            node = _unquoted(cursor.take(size))
        else:
            plain = re.match(r"(?:[^,\[\]{}:]|:(?![\s,\[\]{}]|$))*", cursor.rest())
            text = " ".join((cursor.take(plain.end()) if plain else "").split())
            node = self._alias(text[1:], depth) if text[:1] == "*" else "" if text in _NULLS else text
        if anchor:
            self._anchors[anchor] = node
        return node

    def _flow_collection(self, cursor: _Cursor, begin: str, depth: int) -> Node:
        items: list[Node] = []
        fields: dict[str, Node] = {}
        end = "]" if begin == "[" else "}"
        cursor.at += 1
        while (character := cursor.skip()) != end:
            if not character or character == ",":
                raise self._bad("has a list or mapping that cannot be read", self._at - 1)
            node = self._flow(cursor, depth + 1)
            if begin == "{":
                if not isinstance(node, str) or node in fields:
                    raise self._bad(f"repeats `{node}`", self._at - 1)
                value: Node = ""
                if cursor.skip() == ":":
                    cursor.at += 1
                    value = "" if cursor.skip() in (",", end) else self._flow(cursor, depth + 1)
                fields[node] = value
            else:
                items.append(node)
            if cursor.skip() == ",":
                cursor.at += 1
            elif cursor.skip() != end:
                raise self._bad("has a list or mapping that cannot be read", self._at - 1)
        cursor.at += 1
        return items if begin == "[" else fields


class _Cursor:
    """A position in the text of a flow collection."""

    def __init__(self, text: str) -> None:
        self._text = text
        self.at = 0

    def rest(self) -> str:
        return self._text[self.at :]

    def skip(self) -> str:
        """The next character that is not blank; empty at the end."""
        while self._text[self.at : self.at + 1].isspace():
            self.at += 1
        return self._text[self.at : self.at + 1]

    def take(self, count: int) -> str:
        self.at += count
        return self._text[self.at - count : self.at]


def _first_document(text: str) -> list[str]:
    """Lines of the first document; directives, its marks and what follows are left empty, so that numbers stay."""
    lines: list[str] = []
    begun = False
    for line in text.lstrip("\ufeff").splitlines():
        if line.startswith("%") and not begun:
            line = ""
        elif line == "---" or line.startswith("--- "):
            if begun and any(one.strip() for one in lines):
                break
            line = "    " + line[4:] if line[4:].strip() else ""
            begun = True
        elif line.rstrip() == "...":
            break
        begun = begun or bool(_uncommented(line).strip())
        lines.append(line)
    return lines


def _uncommented(line: str) -> str:
    """The line without its comment: a ``#`` outside quotes, at the line's start or after a blank, and what follows."""
    at = 0
    while at < len(line):
        if line[at] in "'\"" and (at == 0 or line[at - 1] in _BEFORE_QUOTE):
            if (size := _Extent().end(line[at:])) < 0:
                return line
            at += size
        elif line[at] == "#" and (at == 0 or line[at - 1].isspace()):
            return line[:at]
        else:
            at += 1
    return line


def _key_of(content: str) -> tuple[str, str] | None:
    """Key and value of a line of a block mapping; None where it is none."""
    content = content[2:].lstrip() if content.startswith("? ") else content
    if content[:1] in ("[", "{", "|", ">"):
        return None
    quoted = content[:1] in ("'", '"')
    at = _Extent().end(content) if quoted else 0
    if at < 0:
        return None
    key = _unquoted(content[:at]) if quoted else ""
    colon = content.find(":", at)
    while colon >= 0 and content[colon + 1 : colon + 2] not in ("", " ", "\t"):
        colon = content.find(":", colon + 1)
    if colon < 0 or (quoted and content[at:colon].strip()):
        return None
    return key if quoted else content[:colon].rstrip(), content[colon + 1 :].strip()


class _Extent:
    """Finds the end of the quoted text or the collection that begins a text, which may grow between calls."""

    def __init__(self) -> None:
        self._at = self._depth = 0
        self._quote = ""

    def end(self, text: str) -> int:
        """Index behind it; -1: it has no end yet."""
        while self._at < len(text):
            at, character = self._at, text[self._at]
            self._at += 1
            if self._quote:
                if (character == "\\" and self._quote == '"') or character == self._quote == "'" == text[
                    at + 1 : at + 2
                ]:
                    self._at += 1
                elif character == self._quote:
                    self._quote = ""
            elif character in "'\"" and (at == 0 or text[at - 1] in _BEFORE_QUOTE):
                self._quote = character
            else:
                self._depth += (character in "[{") - (character in "]}")
            if not self._quote and self._depth == 0:
                return self._at
        return -1


def _unquoted(text: str) -> str:
    """Content of a quoted text, its lines folded."""
    first, *more = text[1:-1].split("\n")
    if more:
        middle, last = [line.strip(" \t") for line in more[:-1]], more[-1].lstrip(" \t")
        first = " ".join((first.rstrip(" \t"), *middle, last))
    if text[0] == "'":
        return first.replace("''", "'")
    return re.sub(r"\\(x..|u.{4}|U.{8}|.)", _escaped, first)


def _escaped(match: re.Match[str]) -> str:
    code = match[1]
    if code[0] in _HEX:
        try:
            return chr(int(code[1:], 16))
        except (ValueError, OverflowError):
            raise BadYaml(f"has `\\{code}`, which is not a character") from None
    if code not in _ESCAPES:
        raise BadYaml(f"has `\\{code}`, which is not a YAML escape")
    return _ESCAPES[code]


def _size(node: Node) -> int:
    """Number of scalars and collections in a node."""
    if isinstance(node, str):
        return 1
    return 1 + sum(map(_size, node.values() if isinstance(node, dict) else node))
