"""Descriptions as YAML permits them, against PyYAML's reading; and text that is none, bounded in time and memory."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from daemon.maps.map_server import BadMapServer, describe
from daemon.maps.map_server.yaml_document import DEEPEST, BadYaml, parse

HERE = Path("floor.yaml")
REST = "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
DOCUMENTS = [
    "image: map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\n" + REST,
    "{image: map.pgm, resolution: 0.05, origin: [-1.0, 2.0, 0.5], negate: 0, free_thresh: 0.196}",
    '{"image":"map.pgm","resolution":5.0e-2,"origin":[-1.0,2.0,0.5],\n "negate":0}\n',
    "image: map.pgm\nresolution: 0.05\norigin: [-1.0,\n  2.0,   # metres\n  0.5]\n" + REST,
    "image: map.pgm\nresolution: 0.05\norigin:\n  - -1.0\n  - 2.0\n  - 0.5\n" + REST,
    "image: map.pgm\nresolution: 0.05\norigin:\n- -1.0\n- 2.0\n\n# yaw\n- 0.5\n" + REST,
    "%YAML 1.2\n---\n# floor\nimage: 'map.pgm'\nresolution: \"0.05\"\norigin: ['-1.0', \"2.0\", 0.5]\n...\nmore: [",
    "image: map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\n---\nimage: other.pgm\n",
    "  image: map.pgm\n  resolution: 0.05\n  origin: [-1, +2., .5]\n",
    "image: !!str map.pgm\nresolution: !!float 0.05\norigin: &corner [-1.0, 2.0, 0.5]\nother: *corner\n",
    "image:\n  map.pgm\nresolution:\n  0.05\norigin:\n  [-1.0, 2.0, 0.5]\n",
    "image: >-\n  map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\n",
    "image: |-\n  map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\n",
    "by:\n  name: Ann\n  at: [{a: 1, b: [2, 3]}, c]\nimage: map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\n",
    "a:\n  - name: a\n    z: 1\n  - name: b\n    z: 2\nimage: map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\n",
    "layers:\n- name: a\n  z: {}\n- []\n-\n  - 1\nimage: map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\n",
    "'image': map.pgm\n\"resolution\": 0.05\norigin: [-1.0, 2.0, 0.5]\nnote: it's 5 o'clock \"here\"\n",
    'image: "m\\x61p.pgm"\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\nnote: "a \\"b\\" \\u00e4 # c" # d\n',
    "image: map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\nmore: 'it''s # no' # yes\nlast: \"c:\\\\\" # d\n",
    "image: map.pgm\r\nresolution: 0.05\r\norigin: [-1.0, 2.0, 0.5]\r\n",
    "note: one\n  two\n  three\nempty:\nnothing: ~\nimage: map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\n",
    'note: "over\n  two lines"\nimage: map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\n',
    "\ufeffimage: map.pgm # floor\nresolution: 0.05 # m\norigin: [-1.0, 2.0, 0.5] # m\n",
    "url: http://a.example/b#c\nimage: map.pgm\nresolution: 0.05\norigin: [ -1.0 , 2.0 , 0.5 , ]\n",
]  # fmt: skip


def without_nulls(node: object) -> object:
    """PyYAML's text loader leaves ``~`` and ``null`` as text; here they are empty."""
    if isinstance(node, dict):
        return {key: without_nulls(value) for key, value in node.items()}
    if isinstance(node, list):
        return [without_nulls(value) for value in node]
    return "" if node == "~" else node


@pytest.mark.parametrize("text", DOCUMENTS)
def test_documents_are_read_as_pyyaml_reads_them(text: str) -> None:
    first = next(iter(yaml.load_all(text, yaml.BaseLoader)))
    assert parse(text) == without_nulls(first)


@pytest.mark.parametrize("text", DOCUMENTS)
def test_every_way_to_write_it_is_the_same_map(text: str) -> None:
    told = describe(HERE, text)
    assert (told.image, told.resolution, told.origin) == (Path("map.pgm"), 0.05, (-1.0, 2.0, 0.5))
    assert (told.negate, told.occupied, told.free, told.mode) == (False, 0.65, 0.196, "trinary")


@pytest.mark.parametrize("word", ["1", "true", "True", "TRUE", "yes", "On", "Y"])
def test_truth_as_yaml_cpp_reads_it(word: str) -> None:
    assert describe(HERE, DOCUMENTS[0].replace("negate: 0", f"negate: {word}")).negate


@pytest.mark.parametrize("word", ["tRUE", "2", "[1]", "maybe", "1_0", "0x1F"])
def test_what_is_no_truth_is_refused(word: str) -> None:
    with pytest.raises(BadMapServer, match="`negate` is"):
        describe(HERE, DOCUMENTS[0].replace("negate: 0", f"negate: {word}"))


@pytest.mark.parametrize("number", ["1_0", "nan", "inf", ".nan", "0x1", "1e", "٣", "[0.05]", ""])
def test_what_is_no_number_is_refused(number: str) -> None:
    with pytest.raises(BadMapServer, match="`resolution` is"):
        describe(HERE, DOCUMENTS[0].replace("resolution: 0.05", f"resolution: {number}"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("image: 'map.pgm\nresolution: 1\n", "line 1 begins the quoted text without an end"),
        ("a: [1, {b: 2\nc: 3\n", "line 1 begins the list or mapping without an end"),
        ("a: *b\n", "line 1 names an anchor that does not exist"),
        ("a: 'b' c\n", "line 1 continues after its value"),
        ("a: b: c\n  d: e\n", "is not `key: value`"),
        ("a: 1\n   b: 2\n", "is not `key: value`"),
        ("\ta: 1\n", "is indented by a tab"),
        ("{a: 1, a: 2}\n", "repeats `a`"),
        ('a: "\\q"\n', "not a YAML escape"),
        ("[1, 2]\n", "line 1 is not `key: value`"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(text: str, says: str) -> None:
    with pytest.raises(BadMapServer, match=says):
        describe(HERE, text)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 30_000,
        "a: " + "[" * 30_000 + "]" * 30_000,
        "- " * 30_000,
        "".join(" " * n + f"a{n}:\n" for n in range(300)),
        "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 60)),
        "a: '" + "''" * 30_000,
        "a: [" + "'" * 60_000,
        "'" * 60_000,
        "a: " + "&b " * 20_000,
        "{" + "a, " * 20_000 + "}",
        "a: ['" + "\n" * 60_000,
        "a: [\n" + "b,\n" * 20_000,
        "a" + " " * 60_000 + "b",
        "a: 'b" + " " * 60_000 + "c' d",
        "a: ['b'" * 8_000,
    ],
    ids=range(15),
)
def test_text_that_is_made_to_be_expensive_is_not(text: str) -> None:
    begun = time.process_time()
    with pytest.raises(BadMapServer):
        describe(HERE, text)
    assert time.process_time() - begun < 3.0


def test_collections_within_one_another_have_a_limit() -> None:
    assert parse("a: " + "[" * (DEEPEST - 1) + "]" * (DEEPEST - 1))
    with pytest.raises(BadYaml, match="has more content than a map description"):
        parse("a: " + "[" * (DEEPEST + 1) + "]" * (DEEPEST + 1))


@example('[:.! "bx\n,\'~.~:x*a-"|{ ,*|.!-}\\]\na')
@given(st.text(alphabet="ab:-[]{},'\"#&*!|>%\\ \n\t~?x0.", max_size=80))
def test_no_text_does_more_than_be_refused(text: str) -> None:
    with contextlib.suppress(BadYaml):
        parse(text)
