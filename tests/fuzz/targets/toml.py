"""Texts that people write: the configuration, a survey of the lamps, a map server's description."""

from __future__ import annotations

from collections.abc import Callable

from daemon import configfile, mapserver, surveyfile
from daemon.config import Config
from tests.daemon.mapmaker import SURVEY
from tests.fuzz.targets import a_file, refused

MEGABYTES = 3
PARSERS = (
    "daemon/configfile.py",
    "daemon/configwords.py",
    "daemon/config.py",
    "daemon/surveyfile.py",
    "daemon/surveytree.py",
    "daemon/surveywords.py",
    "daemon/mapserver.py",
)

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
    file = a_file("a.toml")

    def configured() -> None:
        assert configfile.dump(configfile.load(file))

    def feed(data: bytes) -> None:
        file.write_bytes(data)
        said = refused(configured, by=configfile.ConfigError)
        assert not said or "a.toml" in said
        said = refused(surveyfile.read_survey, file, by=surveyfile.SurveyError)
        assert not said or "a.toml" in said
        said = refused(mapserver.load, file, by=mapserver.BadMapServer)
        assert not said or file.parent.name in said

    return feed
