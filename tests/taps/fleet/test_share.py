"""A survey and a map for all robots, over a real router: newer ones are followed, damaged and older ones refused."""

import asyncio
import hashlib
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zenoh", reason="pip install 'lumiloop[zenoh]'")
import zenoh

from daemon.config.schema import Config, LightsConfig
from daemon.config.survey_loader import dump, read_survey
from estimator.light_filter.survey import Lamp, Survey
from taps.fleet import messages
from taps.fleet.fetch import Fetcher
from taps.fleet.placing import MAP, SURVEY, Offer, Records, offer_of
from taps.fleet.share import key_of, share
from taps.zenoh_session import list_tokens, open_session, session_config
from tests.daemon.support import map_maker
from tests.daemon.support.map_maker import Shape
from tests.taps.routers import Heard, Router, beside, router, told_to, until

LAMPS = tuple(Lamp(k + 1, k % 5, 2.0 * k, 1.0, 2.8) for k in range(4))


def sharing(made: Router, **what: Path | int) -> Any:
    version = what.pop("version")
    assert isinstance(version, int)
    offers = [offer_of(kind, path, version) for kind, path in what.items() if isinstance(path, Path)]
    return share(told_to(made), offers)


def fetcher(made: Router, folder: Path, **more: Any) -> Fetcher:
    given = {"what": [SURVEY], "survey": None, "switch": False, "follow": False, **more}
    settings = Config(lights=LightsConfig(survey=str(folder / "lights.toml")))
    return Fetcher(told_to(made, settings=settings, **given), Records(folder / "fleet.json"))


@pytest.fixture
def survey(tmp_path: Path) -> Path:
    path = tmp_path / "shared.toml"
    path.write_text(dump(Survey(LAMPS)))
    return path


def test_robots_follow_what_is_shared_and_refuse_what_is_older(
    tmp_path: Path, survey: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Who shares may come later than who fetches, and go; the newest stays."""
    folder = tmp_path / "robot"
    folder.mkdir()
    heard = Heard(capsys)

    def lamps() -> tuple[Lamp, ...]:
        return read_survey(folder / "lights.toml").lamps

    def change() -> None:
        survey.write_text(dump(Survey(LAMPS[:2])))

    async def body(made: Router) -> None:
        async def until_said(words: str) -> None:
            await until(lambda: heard(words))

        await until_said("no robot shares a survey")
        await beside(until_said("survey shared.toml version 7 is in"), sharing(made, survey=survey, version=7))
        assert lamps() == LAMPS
        change()
        await beside(until_said("version 6 is older than version 7"), sharing(made, survey=survey, version=6))
        await beside(until_said("version 7 exists with 2 different"), sharing(made, survey=survey, version=7))
        assert lamps() == LAMPS
        await beside(until_said("survey shared.toml version 8 is in"), sharing(made, survey=survey, version=8))
        assert lamps() == LAMPS[:2]

    with router() as made:
        asyncio.run(beside(body(made), fetcher(made, folder, follow=True).run()))


def test_who_shares_is_there_for_as_long_as_it_does(survey: Path) -> None:
    async def body(made: Router) -> None:
        alive = f"{messages.SHARED}/alive/*"
        async with open_session(made.address) as session:
            await until(lambda: list(session.get(key_of(SURVEY), timeout=1.0)))  # declared before the token is
            await asyncio.sleep(0.5)
            assert len(await list_tokens(session, alive)) == 1

    with router() as made:
        asyncio.run(beside(body(made), sharing(made, survey=survey, version=7)))


def test_what_comes_damaged_is_refused(tmp_path: Path, survey: Path, capsys: pytest.CaptureFixture[str]) -> None:
    offer, content = offer_of(SURVEY, survey, 7)

    def answer(query: zenoh.Query) -> None:
        with query:
            for key, told in ((key_of(SURVEY), messages.encode(offer)), (key_of(SURVEY, offer.sha256), content[:-9])):
                if query.key_expr.intersects(key):
                    query.reply(key, told)

    with router() as made, zenoh.open(session_config("client", made.address)) as session:
        session.declare_queryable("lumiloop/@shared/**", answer)
        one = fetcher(made, tmp_path)
        asyncio.run(one.run())
    assert one.failed
    assert "differs from the announced one" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"shared.toml"}


def test_what_the_sender_writes_does_not_reach_the_terminal_as_orders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = b'"\\u001b[2J" = 1\n'
    digest = hashlib.sha256(content).hexdigest()
    offer = Offer(kind=SURVEY, name="\x1b[2Jx", version=7, sha256=digest, size=len(content))

    def answer(query: zenoh.Query) -> None:
        with query:
            for key, told in ((key_of(SURVEY), messages.encode(offer)), (key_of(SURVEY, digest), content)):
                if query.key_expr.intersects(key):
                    query.reply(key, told)

    with router() as made, zenoh.open(session_config("client", made.address)) as session:
        session.declare_queryable("lumiloop/@shared/**", answer)
        asyncio.run(fetcher(made, tmp_path).run())
    said = capsys.readouterr().err
    assert "unknown key" in said
    assert "\x1b" not in said


def test_a_large_map_comes_whole_and_the_daemon_is_asked_only_if_that_is_wished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "hall.lumimap"
    path.write_bytes(map_maker.content(Shape(submaps=60, frames=12, beams=1081, map_id=0x77)))
    assert path.stat().st_size > 1_000_000
    asked: list[tuple[str, str, int, int]] = []

    async def switch(name: str, host: str, port: int, map_id: int) -> str:
        asked.append((name, host, port, map_id))
        return "done"

    monkeypatch.setattr("taps.fleet.fetch.switch_map", switch)
    with router() as made:
        for place, wished in (("a", False), ("b", True)):
            monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / place))
            one = fetcher(made, tmp_path / place, what=[MAP], switch=wished)
            asyncio.run(beside(one.run(), sharing(made, map=path, version=1)))
            assert not one.failed, capsys.readouterr().err
            (found,) = (tmp_path / place / "lumiloop" / "maps").glob("*.lumimap")
            assert found.read_bytes() == path.read_bytes()
            assert asked == ([("lumiloop", "127.0.0.1", 1502, 0x77)] if wished else [])
    assert "the daemon uses the map now" in capsys.readouterr().err


def test_a_switch_that_was_not_done_fails_and_is_asked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "hall.lumimap"
    path.write_bytes(map_maker.content(Shape(map_id=0x77)))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    outcomes = ["refused", "refused", "done"]

    async def switch(name: str, host: str, port: int, map_id: int) -> str:
        assert map_id == 0x77
        return outcomes.pop(0)

    monkeypatch.setattr("taps.fleet.fetch.switch_map", switch)
    with router() as made:
        for failed, said in (
            (True, "is in"),
            (True, "refused"),
            (False, "installed already; the daemon uses the map now"),
        ):
            one = fetcher(made, tmp_path, what=[MAP], switch=True)
            asyncio.run(beside(one.run(), sharing(made, map=path, version=1)))
            assert one.failed is failed
            assert said in capsys.readouterr().err
        one = fetcher(made, tmp_path, what=[MAP], switch=True)  # nothing is left to be asked for
        asyncio.run(beside(one.run(), sharing(made, map=path, version=1)))
    assert not one.failed


def test_what_was_deleted_or_is_wanted_elsewhere_is_fetched_again(
    tmp_path: Path, survey: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "hall.lumimap"
    path.write_bytes(map_maker.content(Shape(map_id=0x77)))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def fetch(made: Router, **more: Any) -> str:
        one = fetcher(made, tmp_path, what=[], **more)
        asyncio.run(beside(one.run(), sharing(made, survey=survey, map=path, version=1)))
        assert not one.failed
        return capsys.readouterr().err

    def maps() -> list[Path]:
        return list((tmp_path / "state").rglob("*.lumimap"))

    lights, other = tmp_path / "lights.toml", tmp_path / "other.toml"
    with router() as made:
        fetch(made)
        assert fetch(made).count("is installed already") == 2
        lights.unlink()
        maps()[0].unlink()
        assert "installed already" not in fetch(made)
        assert lights.exists()
        assert len(maps()) == 1
        fetch(made, survey=other)
        assert other.exists()


@pytest.mark.parametrize(
    "offer",
    [
        b"\xff",
        b'{"kind": "survey", "name": "x", "version": 9, "sha256": "**", "size": 3}',
        b'{"kind": "survey", "name": "x", "version": 9, "sha256": "%s", "size": 1000000000}' % (64 * b"0"),
    ],
)
def test_who_offers_what_is_no_offer_does_not_keep_others_from_being_heard(
    tmp_path: Path, survey: Path, offer: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(key_of(SURVEY), offer)

    with router() as made, zenoh.open(session_config("client", made.address)) as session:
        session.declare_queryable(key_of(SURVEY), answer)
        one = fetcher(made, tmp_path)

        async def patiently() -> None:
            await asyncio.sleep(1.0)
            await one.run()

        asyncio.run(beside(patiently(), sharing(made, survey=survey, version=7)))
    said = capsys.readouterr().err
    assert "the shared survey is not valid" in said
    assert "version 7 is in" in said
    assert not one.failed
