"""What a fleet shares, on a robot's disk: newer replaces older, nothing else, and never half."""

import os
from pathlib import Path

import msgspec
import pytest

from daemon.config.schema import Config, LightsConfig, MapConfig, PhotodiodeConfig
from daemon.config.survey_loader import dump, read_survey
from daemon.maps.store import Store
from estimator.cdma.air_interface import PROFILES
from estimator.light_filter.survey import Lamp, Receiver, Survey
from taps.fleet.messages import Held
from taps.fleet.placing import MAP, RECORD, SURVEY, Offer, Records, Refused, check, install, newest_offer, offer_of
from tests.daemon.support import map_maker
from tests.daemon.support.map_maker import Shape

LAMPS = tuple(Lamp(k + 1, k % 5, 2.0 * k, 1.0, 2.8) for k in range(4))
SHARED = Survey(LAMPS, Receiver(x=0.5))


@pytest.fixture
def survey(tmp_path: Path) -> Path:
    path = tmp_path / "shared.toml"
    path.write_text(dump(SHARED))
    return path


@pytest.fixture
def shared_map(tmp_path: Path) -> Path:
    path = tmp_path / "hall.lumimap"
    path.write_bytes(map_maker.content(Shape(map_id=0x77)))
    return path


def settings(folder: Path) -> Config:
    return Config(map=MapConfig(folder=str(folder / "maps")), lights=LightsConfig(survey=str(folder / "lights.toml")))


def test_a_survey_keeps_the_robots_own_receiver_and_the_file_before(tmp_path: Path, survey: Path) -> None:
    offer, content = offer_of(SURVEY, survey, 3)
    own = tmp_path / "lights.toml"
    where, note = install(offer, content, settings(tmp_path), None)
    assert where == own
    assert "its receiver comes from the shared file" in note
    own.write_text(dump(Survey(LAMPS[:1], Receiver(x=-0.25))))
    _, note = install(offer, content, settings(tmp_path), None)
    assert "[receiver] of this robot is unchanged" in note
    placed = read_survey(own)
    assert placed.lamps == LAMPS
    assert placed.receiver.x == -0.25
    assert read_survey(tmp_path / "lights.toml.before").lamps == LAMPS[:1]
    assert {path.name for path in tmp_path.iterdir()} == {"shared.toml", "lights.toml", "lights.toml.before"}


def test_a_later_fetch_leaves_alone_what_an_earlier_one_has_put_aside(tmp_path: Path, survey: Path) -> None:
    offer, content = offer_of(SURVEY, survey, 3)
    own = tmp_path / "lights.toml"
    versions = [dump(Survey(LAMPS[:1], Receiver(x=x))) for x in (-0.25, -0.5)]
    for text, aside in ((versions[0], ""), (versions[1], "2"), (versions[1], "2"), (versions[0], "")):
        own.write_text(text)
        _, note = install(offer, content, settings(tmp_path), None)
        assert f"the old file is lights.toml.before{aside}" in note
    assert [(tmp_path / f"lights.toml.before{number}").read_text() for number in ("", "2")] == versions


def test_a_survey_is_read_for_the_air_interface_that_this_robot_has(tmp_path: Path) -> None:
    """Where it says no depth, the profile's counts; codes that the profile does not have are refused."""
    path = tmp_path / "shared.toml"
    path.write_text("lamp = [{ lamp_id = 1, code = 3, x = 0.0, y = 0.0, z = 3.0 }]")
    offer, content = offer_of(SURVEY, path, 1)
    given = msgspec.structs.replace(settings(tmp_path), photodiode=PhotodiodeConfig(profile="B"))
    assert PROFILES["B"].depth != PROFILES["A"].depth
    install(offer, content, given, None)
    assert read_survey(tmp_path / "lights.toml").depth == PROFILES["B"].depth
    path.write_text("lamp = [{ lamp_id = 1, code = 500, x = 0.0, y = 0.0, z = 3.0 }]")
    with pytest.raises(Refused, match="code 500 is not in profile"):
        install(*offer_of(SURVEY, path, 2), settings(tmp_path), None)


def test_a_survey_needs_a_place(tmp_path: Path, survey: Path) -> None:
    offer, content = offer_of(SURVEY, survey, 3)
    with pytest.raises(Refused, match=r"set `lights\.survey`, or name a file with --survey FILE"):
        install(offer, content, Config(), None)
    assert install(offer, content, Config(), tmp_path / "elsewhere.toml")[0].exists()


def test_a_disk_that_is_full_leaves_the_survey_as_it_was(
    tmp_path: Path, survey: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offer, content = offer_of(SURVEY, survey, 3)
    own = tmp_path / "lights.toml"
    own.write_text(dump(Survey(LAMPS[:1])))
    before = own.read_bytes()

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(Refused, match="No space left"):
        install(offer, content, settings(tmp_path), None)
    assert own.read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"shared.toml", "lights.toml"}


def test_a_survey_that_cannot_be_checked_for_a_full_disk_is_refused(
    tmp_path: Path, survey: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offer, content = offer_of(SURVEY, survey, 3)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    with pytest.raises(
        Refused, match=r"shared\.toml: cannot be checked, because no temporary file can be written: No such file"
    ):
        install(offer, content, settings(tmp_path), None)


def test_a_map_is_what_the_next_start_takes(tmp_path: Path, shared_map: Path) -> None:
    given = settings(tmp_path)
    maps = Path(given.map.folder)
    maps.mkdir()
    (maps / "map-00001234-00000004.lumimap").write_bytes(map_maker.content(Shape()))
    offer, content = offer_of(MAP, shared_map, 1)
    assert offer.map_id == 0x77
    where, _ = install(offer, content, given, None)
    assert where.name == "map-00000077-00000005.lumimap"
    start = Store(maps).load()
    assert start is not None
    assert start.stored.meta.map_id == 0x77


def test_a_map_that_an_operator_has_placed_is_the_daemons_own_too(tmp_path: Path, shared_map: Path) -> None:
    given = settings(tmp_path)
    daemon = Store(Path(given.map.folder))
    daemon.claim()
    (Path(given.map.folder) / "hall.lumimap").write_bytes(shared_map.read_bytes())
    offer, content = offer_of(MAP, shared_map, 1)
    try:
        with pytest.raises(Refused, match="a running daemon keeps map 00000077 there"):
            install(offer, content, given, None)
    finally:
        daemon.close()


def test_beside_a_running_daemon_another_map_is_put_and_its_own_is_not_touched(
    tmp_path: Path, shared_map: Path
) -> None:
    given = settings(tmp_path)
    daemon = Store(Path(given.map.folder))
    daemon.save(map_maker.content(Shape()), 0x1234)  # which takes the folder
    offer, content = offer_of(MAP, shared_map, 1)
    try:
        where, note = install(offer, content, given, None)
        assert where.name == "map-00000077-00000002.lumimap"
        assert "--switch" in note
        assert daemon.load_map(0x77).stored.meta.map_id == 0x77
        daemon.save(map_maker.content(Shape(submaps=5)), 0x1234)
        assert where.exists()
        with pytest.raises(Refused, match="a running daemon keeps map 00000077 there; stop the daemon"):
            install(offer, content, given, None)
    finally:
        daemon.close()


@pytest.mark.parametrize("kind", [SURVEY, MAP])
def test_what_is_damaged_on_the_way_is_refused_and_nothing_changes(
    tmp_path: Path, survey: Path, shared_map: Path, kind: str
) -> None:
    offer, content = offer_of(kind, survey if kind == SURVEY else shared_map, 1)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for spoilt in (content[:-1], content + b"\0", b"", content[:50] + b"\xff" + content[51:]):
        with pytest.raises(Refused, match=f"{kind} .* version 1: the content .* differs from the announced one"):
            install(offer, spoilt, settings(tmp_path), None)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_what_is_no_survey_or_another_map_than_announced_is_refused(tmp_path: Path, shared_map: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text("lamp = [{ lamp_id = 1, kode = 3 }]")
    with pytest.raises(Refused, match=r"bad\.toml.*unknown key `kode`; did you mean `code`\?"):
        offer_of(SURVEY, bad, 1)
    with pytest.raises(Refused, match="not a map file"):
        offer_of(MAP, bad, 1)
    with pytest.raises(Refused, match="cannot be read: No such file"):
        offer_of(MAP, tmp_path / "none", 1)
    offer, content = offer_of(MAP, shared_map, 1)
    with pytest.raises(Refused, match="contains map 00000077, not 00000001 as announced"):
        install(msgspec.structs.replace(offer, map_id=1), content, settings(tmp_path), None)
    assert not (tmp_path / "maps").exists()


OFFER = Offer(kind=SURVEY, name="lights.toml", version=7, sha256="aa", size=1)


@pytest.mark.parametrize(
    ("offers", "held", "words"),
    [
        ([], None, "no robot shares a survey"),
        ([msgspec.structs.replace(OFFER, kind=MAP)], None, "no robot shares a survey"),
        ([OFFER], Held(8, "bb"), "version 7 is older than version 8, which is installed; .*--version 9"),
        ([OFFER], Held(7, "bb"), "version 7 exists with 2 different contents; .*--version 8"),
        ([OFFER, msgspec.structs.replace(OFFER, sha256="cc")], None, "version 7 exists with 2 different contents"),
    ],
)
def test_what_is_older_or_contradicts_itself_is_refused(offers: list[Offer], held: Held | None, words: str) -> None:
    with pytest.raises(Refused, match=words):
        newest_offer(SURVEY, offers, held)


def test_the_newest_is_taken_once() -> None:
    older = msgspec.structs.replace(OFFER, version=6, sha256="bb")
    assert newest_offer(SURVEY, [older, OFFER], None) == OFFER
    assert newest_offer(SURVEY, [older, OFFER, OFFER], Held(6, "bb")) == OFFER
    assert newest_offer(SURVEY, [older, OFFER], Held(7, "aa")) is None


def test_what_was_taken_is_noted_and_a_spoilt_note_is_none(tmp_path: Path) -> None:
    records = Records(tmp_path / "state" / RECORD)
    assert records.held() == {}
    lights, hall = tmp_path / "lights.toml", tmp_path / "maps" / "map-00000077-00000001.lumimap"
    records.note(OFFER, lights)
    records.note(msgspec.structs.replace(OFFER, kind=MAP, version=2, map_id=0x77), hall)
    again = Records(records.path)
    assert again.held() == {}  # noted, but there are no such files
    lights.touch()
    hall.parent.mkdir()
    hall.with_name("map-00000077-00000009.lumimap").touch()  # as the daemon has saved it since
    assert again.held() == {SURVEY: Held(7, "aa", "lights.toml"), MAP: Held(2, "aa", "lights.toml")}
    records.path.write_bytes(b'{"survey": 7}')
    os.utime(records.path, ns=(1, 1))
    assert again.taken() == {}


def test_a_version_is_when_the_file_was_changed(survey: Path) -> None:
    os.utime(survey, (1_700_000_000, 1_700_000_000))
    offer, content = offer_of(SURVEY, survey, None)
    assert offer.version == 1_700_000_000
    check(offer, content)
