"""Image reader for imported maps: PGM (Netpbm) and PNG by itself, with Pillow also BMP, JPEG, TIFF and GIF."""

from __future__ import annotations

import io
import re
import struct
import warnings
import zlib
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from daemon.maps.map_server.pixels import BadPicture, Picture, check_size
from daemon.maps.map_server.png_reader import chunks_of, read_png
from daemon.maps.png import SIGNATURE
from daemon.system.extras import how_to_install

if TYPE_CHECKING:  # an extra
    from PIL.Image import Image

_PGM: Final = re.compile(rb"P([25])((?:\s+|#[^\n]*\n)+)(\d+)((?:\s+|#[^\n]*\n)+)(\d+)((?:\s+|#[^\n]*\n)+)(\d+)")
_HEAD: Final = 4096
"""Bytes in which the head of a PGM must end."""
_FORMATS: Final = ("PNG", "BMP", "JPEG", "TIFF", "GIF", "PPM")
_DAMAGED: Final = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    EOFError,
    KeyError,
    IndexError,
    struct.error,
    zlib.error,
)
"""What Pillow raises for damaged files."""


def read_picture(data: bytes, most: int) -> Picture:
    """Decode an image of at most ``most`` pixels.

    Raises:
        BadPicture: it is of another kind, or damaged, or too large.
    """
    if data[:2] in (b"P2", b"P5"):
        return _pgm(data, most)
    png = data.startswith(SIGNATURE)
    if png:
        chunks_of(data)  # its checksums
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        if png:
            return read_png(data)
        with_pillow = f"with Pillow also BMP, JPEG, TIFF and GIF: {how_to_install('images')}"
        raise BadPicture(f"is neither PGM nor PNG; {with_pillow}") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a size that is checked here, and of other small defects
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                check_size(*image.size, most)
                return _converted(image)
    except (UnidentifiedImageError, Image.DecompressionBombError):
        raise BadPicture("is neither PGM, PNG, BMP, JPEG, TIFF nor GIF of a usable size; convert it to one") from None
    except _DAMAGED as error:
        raise BadPicture(f"cannot be decoded ({error}); copy it again") from None


def _converted(image: Image) -> Picture:
    """Pixels of an image of any mode."""
    if "A" in image.getbands() or "transparency" in image.info:
        return Picture(np.asarray(image.convert("RGBA")), 255, transparent=True)
    if image.mode.startswith("I"):
        return Picture(np.clip(np.asarray(image), 0, 65535).astype(np.uint16)[..., None], 65535)
    if image.mode in ("1", "L"):
        return Picture(np.asarray(image.convert("L"))[..., None], 255)
    return Picture(np.asarray(image.convert("RGB")), 255)


def _pgm(data: bytes, most: int) -> Picture:
    head = _PGM.match(data[:_HEAD])
    if head is None:
        raise BadPicture("its head is not a PGM head: P5 or P2, columns, rows, largest value")
    if max(len(head[at]) for at in (3, 5, 7)) > 9:
        raise BadPicture("its head has a number that is too large")
    columns, rows, largest = int(head[3]), int(head[5]), int(head[7])
    check_size(columns, rows, most)
    if not 0 < largest < 65536:
        raise BadPicture(f"its largest value is {largest}; expected 1 to 65535")
    count = rows * columns
    values = _decimals(data[head.end() :], count) if head[1] == b"2" else _bytes(data[head.end() + 1 :], largest)
    if len(values) < count:
        raise BadPicture(f"ends after {len(values)} of its {count} pixels; copy it again")
    values = values[:count]
    if values.min() < 0 or values.max() > largest:
        raise BadPicture(f"has values beyond its largest one, {largest}; export it again")
    values = values.reshape(rows, columns, 1)
    if largest < 256:
        return Picture(values.astype(np.uint8, copy=False), largest)
    return Picture(values.astype(np.uint16, copy=False), largest)


def _bytes(data: bytes, largest: int) -> npt.NDArray[Any]:
    if largest < 256:
        return np.frombuffer(data, np.uint8)
    return np.frombuffer(data[: len(data) // 2 * 2], ">u2")


def _decimals(data: bytes, count: int) -> npt.NDArray[Any]:
    """Whole numbers in text, up to ``count`` of them."""
    text = re.sub(rb"#[^\n]*", b"", data)
    if text.translate(None, b"0123456789 \t\n\r\v\f"):
        raise BadPicture("contains text that is not a whole number; export it again")
    if not text.strip():
        return np.empty(0, np.int64)
    try:
        return np.fromstring(text.decode(), np.int64, count, sep=" ")
    except ValueError:  # fewer than ``count``
        return np.fromstring(text.decode(), np.int64, sep=" ")
