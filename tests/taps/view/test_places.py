"""Who gets a place at the page, and what becomes of one that cannot be told anything."""

from __future__ import annotations

from pathlib import Path

import pytest

from taps.access_guard import Guard
from taps.view import server
from tests.taps.view.house import TOKEN, serving, snapshot


async def test_who_says_nothing_takes_no_viewer_s_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as there are places, and more, open a socket and say nothing; one with the token comes all the same."""
    monkeypatch.setattr(server, "UNAUTHENTICATED", 3)
    monkeypatch.setattr(server, "VIEWERS", 4)

    async with serving(tmp_path, guard=Guard("0.0.0.0", TOKEN)) as house:
        silent = [await house.session.ws_connect(f"{house.address}/ws") for _ in range(8)]
        async with house.page(TOKEN) as page:
            assert (await page.welcome())["kind"] == "welcome"
        assert (await silent[0].receive_json(timeout=5.0))["text"] == "Others came before it said who it is."
        assert not silent[-1].closed
        for one in silent:
            await one.close()


async def test_places_are_counted_when_they_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "VIEWERS", 1)

    async with serving(tmp_path) as house:
        late = await house.session.ws_connect(f"{house.address}/ws")
        async with house.page() as page:
            await page.welcome()
            await late.send_json({"page": house.view.page, "token": None})
            assert (await late.receive_json(timeout=5.0))["what"] == "full"


async def test_what_cannot_be_sent_ends_that_connection_aloud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It went on and told the page nothing more."""

    async with serving(tmp_path) as house, house.page() as page, house.page() as other:
        await page.welcome()
        await other.welcome()
        (first, _) = sorted(house.view.hub.viewers, key=lambda viewer: viewer.number)
        await page.until("daemon")
        monkeypatch.setattr(first, "next_message", lambda: 1 / 0)
        house.stream.publish(snapshot(1))
        while await page.read():
            pass
        assert page.socket.close_code == 1011
        await other.until("pose")
    assert any(record.exc_info and "could not be told" in record.message for record in caplog.records)
