"""Maps of map_server and nav2: every field and mode, pictures as Pillow writes them, and what is wrong said clearly."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from daemon.maps.map_server import BadMapServer, cells_of, describe, load
from daemon.maps.map_server.picture import read_picture
from daemon.maps.map_server.pixels import BadPicture, Picture

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


@given(st.text(alphabet="image:resolutnrgdc_ths-[],.0123456789#'\"\n \t%", max_size=300))
def test_no_text_does_more_than_be_refused(text: str) -> None:
    with contextlib.suppress(BadMapServer):
        assert describe(HERE, text).resolution > 0.0


@given(st.sampled_from((b"P5\n", b"P2\n", b"P5 4 4 255\n", b"P2 2 2 9\n")), st.binary(max_size=80))
def test_no_bytes_do_more_than_be_refused(head: bytes, data: bytes) -> None:
    with contextlib.suppress(BadPicture):
        assert read_picture(head + data, MOST).grey.max() <= 1.0


def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_bytes(b"image: a\0b.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(BadMapServer, match="`image` must be the name of an image file"):
        load(tmp_path / "a.yaml")
