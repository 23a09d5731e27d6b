"""Maps of a map server: cells, frames, and the description beside them."""

import contextlib
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from daemon.maps.map_server import BadMapServer, cells_of, describe, load
from daemon.maps.map_server.picture import read_picture
from daemon.maps.map_server.pixels import BadPicture, Picture
from daemon.maps.map_server.yaml_document import DEEPEST, BadYaml, parse

YAML = (
    "image: map.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)
HERE = Path("floor.yaml")
GREYS = np.array([[0, 254, 205], [100, 88, 255]], np.uint8)
MOST = 10_000


def test_every_field_is_read() -> None:
    told = describe(HERE, YAML + "mode: scale\n")
    assert told.image == Path("map.pgm")
    assert (told.resolution, told.origin, told.negate, told.mode) == (0.05, (-1.0, 2.0, 0.5), False, "scale")
    assert (told.occupied, told.free) == (0.65, 0.196)


def test_other_ways_to_write_it() -> None:
    head = '%YAML 1.2\n---\nimage: "a #1.png"  # the floor\nresolution: 5e-2\n'
    text = f"{head}origin:\n- -1\n- 2\n- 0\nnegate: true\nfoo: bar\n"
    told = describe(Path("maps/x.yaml"), text)
    assert told.image == Path("maps/a #1.png")
    assert (told.origin, told.negate, told.mode, told.occupied) == ((-1.0, 2.0, 0.0), True, "trinary", 0.65)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("image: map.pgm\n", ""), "`image` is missing"),
        (("0.05", "0"), "`resolution` is 0 m"),
        (("0.05", "five"), "`resolution` is five; it must be a number"),
        (("[-1.0, 2.0, 0.5]", "[1]"), "`origin` must be"),
        (("[-1.0, 2.0, 0.5]", "[1, 2, x]"), "`origin` is x"),
        (("[-1.0, 2.0, 0.5]", "[1, 2,"), "without an end"),
        (("negate: 0", "negate: 2"), "`negate` is 2"),
        (("free_thresh: 0.196", "free_thresh: 0.7"), "free the smaller"),
        (("negate: 0", "negate: 0\nmode: fancy"), "`mode` is fancy"),
        (("negate: 0", "nonsense"), "line 4 is not `key: value`: nonsense"),
        (("negate: 0", "image: b.pgm"), "repeats `image`"),
    ],
)
def test_what_is_wrong_is_said(change: tuple[str, str], says: str) -> None:
    with pytest.raises(BadMapServer, match=says) as caught:
        describe(HERE, YAML.replace(*change))
    assert str(HERE) in str(caught.value)


def test_pictures_as_pillow_writes_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    grey = rng.integers(0, 256, (37, 53), np.uint8)
    smooth = (np.add.outer(np.arange(40), np.arange(60)) * 2).astype(np.uint8)
    colour = rng.integers(0, 256, (20, 31, 3), np.uint8)
    clear = rng.integers(0, 256, (20, 31, 4), np.uint8)
    for array in (grey, smooth):
        for name in ("a.pgm", "a.png"):
            Image.fromarray(array).save(tmp_path / name)
            found = read_picture((tmp_path / name).read_bytes(), MOST)
            np.testing.assert_allclose(found.grey, array / 255.0)
    Image.fromarray(colour).save(tmp_path / "c.png")
    found = read_picture((tmp_path / "c.png").read_bytes(), MOST)
    np.testing.assert_allclose(found.grey, colour.mean(axis=2) / 255.0)
    Image.fromarray(clear).save(tmp_path / "d.png")
    found = read_picture((tmp_path / "d.png").read_bytes(), MOST)
    assert found.alpha is not None
    np.testing.assert_allclose(found.alpha, clear[..., 3] / 255.0)
    Image.fromarray(grey).quantize(16).save(tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as again:
        expected = np.array(again.convert("RGB")).mean(axis=2) / 255.0
    np.testing.assert_allclose(read_picture((tmp_path / "p.png").read_bytes(), MOST).grey, expected)
    Image.fromarray(grey > 100).save(tmp_path / "b.png")
    np.testing.assert_array_equal(read_picture((tmp_path / "b.png").read_bytes(), MOST).grey, grey > 100)
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "w.png")
    np.testing.assert_allclose(read_picture((tmp_path / "w.png").read_bytes(), MOST).grey, grey / 255.0, atol=1e-9)


def test_plain_pgm_and_comments() -> None:
    found = read_picture(b"P2\n# by hand\n3 2\n255\n0 254 205\n# more\n100 88 255\n", MOST)
    np.testing.assert_allclose(found.grey, GREYS / 255.0)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"MZ\x90", "neither PGM, PNG, BMP, JPEG, TIFF nor GIF"),
        (b"GIF89a", "neither PGM, PNG, BMP, JPEG, TIFF nor GIF"),
        (b"P5\n1234567890 1\n255\n", "a number that is too large"),
        (b"P2\n2 1\n255\n0 -1", "contains text that is not a whole number"),
        (b"P2\n2 1\n255\n", "ends after 0 of its 2 pixels"),
        (b"P2\n1 1\n255\n99999999999999999999999", "beyond its largest"),
        (b"P5 3", "its head is not a PGM head"),
        (b"P5\n3 2\n255\n12345", "ends after 5 of its 6 pixels"),
        (b"P5\n30000 20000\n255\n", "30000 x 20000 pixels"),
        (b"P5\n3 2\n70000\n", "largest value"),
        (b"P2\n1 1\n255\nx", "contains text that is not a whole number"),
        (b"P2\n1 1\n9\n10", "beyond its largest"),
    ],
)
def test_pictures_that_are_none(data: bytes, says: str) -> None:
    with pytest.raises(BadPicture, match=says):
        read_picture(data, MOST)


def test_a_png_that_is_cut_off_or_damaged(tmp_path: Path) -> None:
    Image.fromarray(GREYS).save(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    for cut in range(8, len(data)):
        with pytest.raises(BadPicture):
            read_picture(data[:cut], MOST)
    for at in range(8, len(data), 3):
        with pytest.raises(BadPicture):
            read_picture(data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :], MOST)


def cells_in(mode: str, grey: object, alpha: object = None, negate: int = 0) -> list[list[int]]:
    told = describe(HERE, YAML.replace("negate: 0", f"negate: {negate}") + f"mode: {mode}\n")
    layers = [np.atleast_2d(np.array(layer, np.uint8)) for layer in (grey, alpha) if layer is not None]
    return cells_of(told, Picture(np.stack(layers, axis=2), 255, transparent=alpha is not None)).tolist()


def test_the_rules_of_each_mode() -> None:
    assert cells_in("trinary", GREYS) == [[-1, 1, 0], [1, 0, -1]]  # bottom row first; 100: p 0.61, 88: 0.655
    assert cells_in("trinary", GREYS, negate=1) == [[-1, -1, 1], [0, 1, 1]]
    assert cells_in("scale", [0, 254, 0], alpha=[255, 255, 128]) == [[1, 0, -1]]
    # opacity counts as a fourth colour there, as nav2 does it: black is 1 - 1/4 occupied, half transparent white 1/8
    assert cells_in("trinary", [0, 254, 254], alpha=[255, 255, 0]) == [[1, 0, -1]]
    assert cells_in("raw", [100, 0, 255, 50]) == [[1, 0, -1, -1]]


def test_a_map_of_two_files(tmp_path: Path) -> None:
    (tmp_path / "floor.yaml").write_text(YAML)
    with pytest.raises(BadMapServer, match="No such file"):
        load(tmp_path / "floor.yaml")
    (tmp_path / "map.pgm").write_bytes(b"P5\n3 2\n255\n12345")
    with pytest.raises(BadMapServer, match=r"map.pgm: ends after 5"):
        load(tmp_path / "floor.yaml")
    Image.fromarray(GREYS).save(tmp_path / "map.pgm")
    assert load(tmp_path / "floor.yaml")[1].tolist() == [[-1, 1, 0], [1, 0, -1]]
    (tmp_path / "x.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadMapServer, match="not a text file"):
        load(tmp_path / "x.yaml")
    with pytest.raises(BadMapServer, match="cannot be read"):
        load(tmp_path / "none.yaml")


@given(st.sampled_from((b"P5\n", b"P2\n", b"P5 4 4 255\n", b"P2 2 2 9\n")), st.binary(max_size=80))
def test_no_bytes_do_more_than_be_refused(head: bytes, data: bytes) -> None:
    with contextlib.suppress(BadPicture):
        assert read_picture(head + data, MOST).grey.max() <= 1.0


def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_bytes(b"image: a\0b.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(BadMapServer, match="`image` must be the name of an image file"):
        load(tmp_path / "a.yaml")


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
def test_no_description_does_more_than_be_refused(text: str) -> None:
    with contextlib.suppress(BadYaml):
        parse(text)
