"""What the files of an imported map may be: their kind, their size, where links lead, and the time they take."""

import io
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from daemon.maps.map_server import BadMapServer, load, png_reader
from daemon.maps.map_server.picture import read_picture
from daemon.maps.map_server.pixels import BadPicture
from tests.daemon.support.odd_files import KINDS, planted

GREYS = np.array([[0, 254, 205], [100, 88, 255]], np.uint8)
CELLS = [[-1, 1, 0], [1, 0, -1]]
MOST = 50_000_000
WRONG = "(it is a .*, not a regular file|Is a directory|Too many levels of symbolic links|it is a link out of .*)"


def described(folder: Path, image: str) -> Path:
    path = folder / "floor.yaml"
    path.write_text(f"image: {image}\nresolution: 0.05\norigin: [0, 0, 0]\n")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a map's image, beside another one."""
    for name in ("here", "elsewhere"):
        (tmp_path / name).mkdir()
        Image.fromarray(GREYS).save(tmp_path / name / "map.pgm")
    return tmp_path / "here"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("linked", [False, True])
def test_only_files_are_read(folder: Path, kind: str, linked: bool) -> None:
    planted(folder / "it", kind)
    if linked:
        (folder / "link").symlink_to("it")
    name = "link" if linked else "it"
    begun = time.monotonic()
    with pytest.raises(BadMapServer, match=rf"floor.yaml: the image \S*/{name} cannot be read: {WRONG}; copy it"):
        load(described(folder, name))
    with pytest.raises(BadMapServer, match=f"{name}: cannot be read: {WRONG}; name map_server's YAML file"):
        load(folder / name)
    assert time.monotonic() - begun < 5.0


def test_a_device_that_is_named_is_not_read(folder: Path) -> None:
    with pytest.raises(BadMapServer, match="/dev/zero cannot be read: it is a device, not a regular file"):
        load(described(folder, "/dev/zero"))


@pytest.mark.parametrize(
    "image", ["map.pgm", "./map.pgm", "sub/../map.pgm", "../elsewhere/map.pgm", "link.pgm", "sub/in.pgm"]
)
def test_where_the_image_may_be(folder: Path, image: str) -> None:
    (folder / "sub").mkdir()
    (folder / "link.pgm").symlink_to("map.pgm")
    (folder / "sub" / "in.pgm").symlink_to("../map.pgm")
    assert load(described(folder, image))[1].tolist() == CELLS
    (folder.parent / "linked").symlink_to("here")  # the way to the folder is the user's
    assert load(folder.parent / "linked" / "floor.yaml")[1].tolist() == CELLS


def test_the_image_by_its_whole_path_as_map_saver_writes_it(folder: Path) -> None:
    assert load(described(folder, str(folder / "map.pgm")))[1].tolist() == CELLS
    assert load(described(folder, str(folder.parent / "elsewhere" / "map.pgm")))[1].tolist() == CELLS


@pytest.mark.parametrize("image", ["out.pgm", "sub/map.pgm", "../elsewhere/back.pgm", "round.pgm"])
def test_links_lead_nowhere_else(folder: Path, image: str) -> None:
    other = folder.parent / "elsewhere"
    (folder / "out.pgm").symlink_to(other / "map.pgm")
    (folder / "sub").symlink_to(other)
    (other / "back.pgm").symlink_to(folder / "map.pgm")
    (folder / "round.pgm").symlink_to("round.pgm")
    with pytest.raises(BadMapServer, match=r"is a link|Too many levels"):
        load(described(folder, image))


def test_sizes_have_limits(tmp_path: Path) -> None:
    path = tmp_path / "big"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # takes no room
    with pytest.raises(BadMapServer, match="big: cannot be read: it is larger than 65536 bytes"):
        load(path)
    with pytest.raises(BadMapServer, match=r"the image .*big cannot be read: it is larger"):
        load(described(tmp_path, "big"))


@pytest.mark.parametrize("kind", ["png", "bmp", "jpeg", "tiff", "gif", "ppm"])
def test_the_kinds_of_image_that_nav2_reads(folder: Path, kind: str) -> None:
    grey = np.kron(np.array([[0, 255], [255, 0]], np.uint8), np.ones((16, 16), np.uint8))
    Image.fromarray(grey).convert("RGB").save(folder / f"a.{kind}")
    cells = load(described(folder, f"a.{kind}"))[1]
    assert cells.tolist() == (grey[::-1] == 0).tolist()


def large_png(side: int) -> bytes:
    """Noise, every line by the slowest filter (Paeth)."""
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    lines = np.random.default_rng(1).integers(0, 256, (side, side + 1), np.uint8)
    lines[:, 0] = 4
    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    packed = zlib.compress(lines.tobytes(), 1)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def test_the_slowest_kind_of_a_large_png_takes_seconds() -> None:
    data = large_png(7000)
    begun = time.process_time()
    assert read_picture(data, MOST).values.shape == (7000, 7000, 1)
    assert time.process_time() - begun < 15.0


def test_an_interlaced_png_is_read(tmp_path: Path) -> None:
    image = Image.fromarray(np.random.default_rng(1).integers(0, 256, (9, 13), np.uint8))
    plain, laced = io.BytesIO(), tmp_path / "laced.png"
    image.save(plain, "png")
    adam7(np.asarray(image), laced)
    found = read_picture(laced.read_bytes(), MOST)
    np.testing.assert_array_equal(found.values, read_picture(plain.getvalue(), MOST).values)


def adam7(grey: np.ndarray, path: Path) -> None:
    """Write an interlaced PNG, which Pillow does not."""
    import struct
    import zlib

    passes = ((0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1))
    raw = b"".join(b"\0" + line.tobytes() for y, x, dy, dx in passes for line in grey[y::dy, x::dx] if line.size)
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", grey.shape[1], grey.shape[0], 8, 0, 0, 0, 1)),
        (b"IDAT", zlib.compress(raw)),
        (b"IEND", b""),
    ]
    chunks = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


@pytest.fixture
def without_pillow(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "PIL"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "PIL", None)


@pytest.mark.usefixtures("without_pillow")
def test_without_pillow_a_png_of_moderate_size_is_read_and_the_remedy_is_named(tmp_path: Path) -> None:
    begun = time.process_time()
    assert read_picture(large_png(1000), MOST).values.shape == (1000, 1000, 1)
    assert time.process_time() - begun < 10.0
    assert 1000**2 < png_reader.MOST < 3000**2
    with pytest.raises(BadPicture, match=r"3000 x 3000 pixels; .* with Pillow: .*lumiloop\[images\]"):
        read_picture(large_png(3000), MOST)
    adam7(GREYS, tmp_path / "laced.png")
    with pytest.raises(BadPicture, match=r"interlaced PNG, which needs Pillow: .*lumiloop\[images\]"):
        read_picture((tmp_path / "laced.png").read_bytes(), MOST)
    with pytest.raises(BadPicture, match=r"neither PGM nor PNG; with Pillow also BMP.*lumiloop\[images\]"):
        read_picture(b"BM" + bytes(60), MOST)


@pytest.mark.parametrize("with_it", [True, False])
def test_both_decoders_read_a_png_alike(with_it: bool, request: pytest.FixtureRequest) -> None:
    rng = np.random.default_rng(2)
    images = [Image.fromarray(rng.integers(0, 256, shape, np.uint8)) for shape in ((17, 23), (17, 23, 3), (17, 23, 4))]
    images += [images[0].quantize(16), images[0].convert("LA"), Image.fromarray(np.asarray(images[0]) > 99)]
    expected = [np.asarray(one.convert("RGBA")).astype(float) for one in images]
    files = []
    for one in images:
        files.append(io.BytesIO())
        one.save(files[-1], "png")
    if not with_it:
        request.getfixturevalue("without_pillow")
    for file, values in zip(files, expected, strict=True):
        found = read_picture(file.getvalue(), MOST)
        np.testing.assert_allclose(found.grey, values[..., :3].mean(axis=2) / 255.0)
        np.testing.assert_allclose(1.0 if found.alpha is None else found.alpha, values[..., 3] / 255.0)


@pytest.mark.parametrize("kind", ["png", "bmp", "jpeg", "tiff", "gif", "ppm"])
def test_damaged_images_are_refused(kind: str) -> None:
    file = io.BytesIO()
    Image.fromarray(np.random.default_rng(3).integers(0, 256, (40, 40, 3), np.uint8)).save(file, kind)
    data, rng = file.getvalue(), np.random.default_rng(4)
    refused = 0
    for _ in range(300):
        spoiled = bytearray(data[: rng.integers(2, len(data))] if rng.random() < 0.5 else data)
        for at in rng.integers(2, len(spoiled) + 1, 4):
            spoiled[min(at, len(spoiled) - 1)] ^= int(rng.integers(1, 256))
        try:
            assert read_picture(bytes(spoiled), 1 << 20).values.size < 4 << 20
        except BadPicture:
            refused += 1
    assert refused > 50


def test_an_image_that_unpacks_to_more_than_the_limit_is_refused_before() -> None:
    bomb = io.BytesIO()
    Image.new("1", (20_000, 20_000)).save(bomb, "png")
    assert len(bomb.getvalue()) < 1 << 20
    with pytest.raises(BadPicture, match=r"20000 x 20000 pixels; 1 to 50000000|usable size"):
        read_picture(bomb.getvalue(), MOST)


def test_a_plain_pgm_of_the_largest_size_fits_into_memory() -> None:
    side = 2000
    data = b"P2\n%d %d\n255\n" % (side, side) + b"254 " * side**2
    begun = time.process_time()
    assert read_picture(data, MOST).values.nbytes == side**2
    assert time.process_time() - begun < 5.0
