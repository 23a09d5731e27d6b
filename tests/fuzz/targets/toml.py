"""Texts that people write: the configuration, a survey of the lamps, a map server's description."""

from collections.abc import Callable

from daemon.config import loader, survey_loader
from daemon.config.schema import Config
from daemon.maps import map_server
from tests.daemon.support.map_maker import SURVEY
from tests.fuzz.targets import a_file, refused

MEGABYTES = 3

DESCRIPTION = (
    b"image: a.pgm\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)


def seeds() -> list[bytes]:
    whole = loader.dump(Config())
    return [
        whole.encode(),
        b'[lidar]\ndevice = "auto"\n[modbus]\nport = 1502\nwrite = true\n',
        b"[lidar]\nmount = [0.1, 0.0, 0.0]\n[photodiode]\nlever = [0.0, 0.0, 0.4]\n",
        survey_loader.dump(SURVEY).encode(),
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
        assert loader.dump(loader.load(file))

    def feed(data: bytes) -> None:
        file.write_bytes(data)
        said = refused(configured, by=loader.ConfigError)
        assert not said or "a.toml" in said
        said = refused(survey_loader.read_survey, file, by=survey_loader.SurveyError)
        assert not said or "a.toml" in said
        said = refused(map_server.load, file, by=map_server.BadMapServer)
        assert not said or file.parent.name in said

    return feed
