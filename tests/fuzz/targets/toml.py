"""Texts that people write: the configuration, a survey of the lamps, a map server's description."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from daemon import configfile, mapserver, surveyfile
from daemon.config import Config
from tests.daemon.mapmaker import SURVEY

MEGABYTES = 3
PARSERS = ("daemon/configfile.py", "daemon/config.py", "daemon/surveyfile.py", "daemon/mapserver.py")

DESCRIPTION = (
    b"image: a.pgm\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)


def seeds() -> list[bytes]:
    whole = configfile.dump(Config())
    return [
        whole.encode(),
        b'[lidar]\ndevice = "auto"\n[modbus]\nport = 1502\nwrite = true\n',
        b"[lidar]\nmount = [0.1, 0.0, 0.0]\n[photodiode]\nlever = [0.0, 0.0, 0.4]\n",
        surveyfile.dump(SURVEY).encode(),
        DESCRIPTION,
        DESCRIPTION + b"mode: trinary\n# a comment\n",
        b"\xef\xbb\xbf[lidar]\r\ndevice = 'x'\r\n",
    ]


def mend(data: bytes) -> bytes:
    """Text, so that it gets past the first look."""
    return data.decode("utf-8", "ignore").replace("\0", "").encode()


def feeder() -> Callable[[bytes], None]:
    holder = tempfile.TemporaryDirectory(prefix="lumiloop-fuzz-")
    file = Path(holder.name) / "a.toml"

    def feed(data: bytes) -> None:
        assert holder
        file.write_bytes(data)
        try:
            config = configfile.load(file)
            assert configfile.load(None) is not None
            assert configfile.dump(config)
        except configfile.ConfigError as error:
            assert "a.toml" in str(error)
        try:
            surveyfile.read_survey(file)
        except surveyfile.SurveyError as error:
            assert "a.toml" in str(error)
        try:
            mapserver.load(file)
        except mapserver.BadMapServer as error:
            assert "a.toml" in str(error) or ".pgm" in str(error) or file.parent.name in str(error)

    return feed
