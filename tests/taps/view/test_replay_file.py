"""A recording as a film: made of the daemon's own pipeline, shown from any instant."""

import asyncio
import itertools
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import pytest

from daemon.config.schema import Config
from daemon.replay.sources import open_log
from taps.view import command
from taps.view.replay_file import HEAD, KINDS, ReplayFile
from taps.view.replay_player import ReplayPlayer
from taps.view.replay_recorder import STEP_S, make
from taps.view.viewers import Viewer, encode, frame
from tests.taps.view.house import serving


def write(file: Path, *pieces: tuple[float, str, bytes]) -> None:
    with file.open("ab") as out:
        for t, kind, body in pieces:
            out.write(HEAD.pack(t, KINDS.index(kind), len(body)) + body)


def tile(t: float, column: int, cells: bytes) -> tuple[float, str, bytes]:
    about = {"map_id": 1, "resolution": 0.05, "side": 128, "unit": 0.1}
    return t, "map", encode([column, 0, cells, about])


def told(viewer: Viewer) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    while (message := viewer.next_message()) is not None:
        for one in msgspec.msgpack.decode(message):
            several = one["data"] if one["topic"] == "many" else [one]
            found += [(each["topic"], each["data"]) for each in several]
    return found


@pytest.fixture
def film(tmp_path: Path) -> ReplayFile:
    """Poses each second from 10 to 20, a loop at 15, a tile that is drawn at 12 and again at 18, another at 16."""
    file = tmp_path / "film"
    file.touch()
    for t in range(10, 21):
        write(file, (t, "pose", frame("pose", {"t_mono": t})), (t, "row", frame("row", [t])))
        write(file, *([tile(t, 0, b"a")] if t == 12 else [tile(t, 0, b"b")] if t == 18 else []))
        write(file, *([tile(t, 1, b"c")] if t == 16 else []))
        write(file, *([(t, "loop", frame("loop", {"counter": 1}))] if t == 15 else []))
    return ReplayFile(tmp_path, file)


async def test_any_instant_is_shown_as_if_one_had_watched_until_then(film: ReplayFile) -> None:
    film.refresh()
    assert (film.t_first, film.t_last, film.done) == (10.0, 20.0, False)
    viewer = Viewer(1)
    player = ReplayPlayer(film, viewer)
    player.seek(16.5)
    seen = told(viewer)
    assert [data for topic, data in seen if topic == "pose"] == [{"t_mono": 16}]
    assert [data for topic, data in seen if topic == "row"] == [[t] for t in range(10, 17)]
    assert ("loops", [{"counter": 1}]) in seen  # of the past: it does not happen now
    assert not [data for topic, data in seen if topic == "loop"]
    assert sorted(seen[-1][1]["tiles"]) == [[0, 0, b"a"], [1, 0, b"c"]]
    player.seek(12.5)  # back: what has been drawn since is not there
    seen = told(viewer)
    assert [topic for topic, _ in seen[:2]] == ["daemon", "rewound"]
    assert not [data for topic, data in seen if topic in ("loop", "loops")]
    assert seen[-1][1]["tiles"] == [[1, 0, b""]]
    player.speed = 4.0
    player.advance(1.5)
    seen = told(viewer)
    assert player.at == 18.5
    assert [data for topic, data in seen if topic == "pose"] == [{"t_mono": 18}]
    assert [data for topic, data in seen if topic == "row"] == [[t] for t in range(13, 19)]
    assert ("loop", {"counter": 1}) in seen  # it is played
    assert sorted(seen[-1][1]["tiles"]) == [[0, 0, b"b"], [1, 0, b"c"]]
    player.advance(60.0)
    assert player.at == 20.0
    film.close()


async def test_a_bar_that_is_dragged_before_there_is_a_pose_blanks_nothing(tmp_path: Path) -> None:
    file = tmp_path / "film"
    file.touch()
    film = ReplayFile(tmp_path, file)
    viewer = Viewer(1)
    player = ReplayPlayer(film, viewer)
    player.control({"at": 0.0, "speed": 2.0})
    playing = asyncio.create_task(player.run())
    write(file, *((t, "pose", frame("pose", {"t_mono": t})) for t in (10, 11)))
    for _ in range(100):
        await asyncio.sleep(0.02)
        if player.at >= 10.0:
            break
    playing.cancel()
    assert (player.speed, player.at >= 10.0) == (2.0, True)
    assert ("pose", {"t_mono": 10}) in told(viewer)
    film.close()


async def test_tiles_on_their_way_when_the_time_leaps_are_told_again(film: ReplayFile) -> None:
    film.refresh()
    viewer = Viewer(1)
    player = ReplayPlayer(film, viewer)
    player.seek(16.5)
    player.seek(17.0)  # the bar is dragged: nothing of the first instant has reached the browser
    assert sorted(told(viewer)[-1][1]["tiles"]) == [[0, 0, b"a"], [1, 0, b"c"]]
    player.seek(16.0)  # all of it has: it is not told twice
    assert not [data for topic, data in told(viewer) if topic == "map"]
    film.close()


def test_a_film_that_is_still_being_made(film: ReplayFile, tmp_path: Path) -> None:
    film.refresh()
    file = tmp_path / "film"
    body = frame("pose", {"t_mono": 21})
    with file.open("ab") as out:
        out.write(HEAD.pack(21.0, KINDS.index("pose"), len(body)) + body[:3])
    film.refresh()
    assert film.t_last == 20.0  # half a piece
    with file.open("ab") as out:
        out.write(body[3:])
    write(file, (0.0, "end", b"the recording is torn"))
    film.refresh()
    assert (film.t_last, film.done, film.error) == (21.0, True, "the recording is torn")
    film.close()


def test_a_film_whose_maker_has_died_says_so(film: ReplayFile, tmp_path: Path) -> None:
    """Killed, or without room on the disk: it cannot write that it has ended, and looked as if it would go on."""
    alive = True
    watched = ReplayFile(Path("log"), tmp_path / "film", lambda: alive)
    watched.refresh()
    assert (watched.done, watched.t_last) == (False, 20.0)
    with (tmp_path / "film").open("ab") as out:
        out.write(HEAD.pack(21.0, KINDS.index("pose"), 500) + b"half of it")
    alive = False
    watched.refresh()
    assert (watched.done, watched.t_last) == (True, 20.0)
    assert "has ended early" in watched.error
    watched.close()
    film.close()


def test_a_disk_that_is_full_is_named(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command._record(recording, Config(), (False, ()), Path("/dev/full"))
    said = capsys.readouterr().err
    assert "/dev/full: No space left on device; the recording is shown up to there" in said


def test_a_recording_that_ends_early_does_not_look_whole() -> None:
    """The page has no other place that says so."""
    page = resources.files("taps.view").joinpath("page", "timebar.js").read_text()
    assert 'film.error ? ": ends early"' in page
    assert '$("length").title = film.error' in page


@pytest.mark.parametrize("words", [None, 7, [], {"at": "x"}, {"speed": float("inf")}, {"paused": 1}, {"at": True}])
async def test_a_page_that_talks_nonsense(film: ReplayFile, words: object) -> None:
    film.refresh()
    player = ReplayPlayer(film, Viewer(1))
    player.seek(15.0)
    player.control(words)
    assert (player.at, player.speed, player.paused) == (15.0, 1.0, False)
    player.control({"at": -1e300, "speed": 1e300})
    assert (player.at, player.speed) == (10.0, 60.0)
    film.close()


def test_a_recording_is_shown_from_its_beginning_and_takes_no_orders(recording: Path, tmp_path: Path) -> None:
    file = tmp_path / "film"
    make(open_log(recording), Config(), (False, ()), file)
    film = ReplayFile(recording, file)
    film.refresh()
    assert (film.done, film.error) == (True, "")
    assert film.t_last - film.t_first > 7.0
    times = list(film.tracks["pose"].times)
    assert min(after - before for before, after in itertools.pairwise(times)) > STEP_S / 2
    assert film.scene is not None
    assert film.tiles

    async def body() -> None:
        async with serving(tmp_path, film=film) as house, house.page() as page:
            welcome = await page.welcome()
            assert (welcome["recording"], welcome["orders"]) == (recording.name, {})
            scene = await page.until("scene")  # where the lidar sat when it was recorded
            assert scene["mount"] == [0.1, -0.02, 30.0, False]
            assert (await page.until("pose"))["pose"] is not None
            bar = await page.until("film")
            await page.socket.send_json({"play": {"at": bar["t_last"] - 1.0, "paused": True}})
            await page.until("rewound")
            last = await page.until("pose")
            assert last["t_mono"] == pytest.approx(bar["t_last"] - 1.0, abs=2 * STEP_S)
            assert (await page.until("film", lambda told: told["paused"]))["at"] == bar["t_last"] - 1.0

    asyncio.run(body())
    film.close()


def test_a_recording_that_is_none_is_named(tmp_path: Path) -> None:
    log, file = tmp_path / "log.clf", tmp_path / "film"
    log.write_text("a daemon is present, but its data cannot be used\n")
    command._record(log, Config(), (False, ()), file)
    film = ReplayFile(log, file)
    film.refresh()
    assert film.done
    assert "log.clf" in film.error
    film.close()
