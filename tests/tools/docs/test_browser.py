"""What tests ask of a browser."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest
from aiohttp import ClientWebSocketResponse

from tools.docs.browser import BrowserError, Tab


class Socket:
    """A browser's end: answers in this order, to whatever is asked."""

    def __init__(self, *answers: dict[str, Any]) -> None:
        self.answers = list(answers)
        self.asked: list[dict[str, Any]] = []

    async def send_json(self, asked: dict[str, Any]) -> None:
        self.asked.append(asked)

    async def receive_json(self) -> dict[str, Any]:
        return {"id": self.asked[-1]["id"], **self.answers.pop(0)}


def until(*answers: dict[str, Any]) -> Socket:
    socket = Socket(*answers)
    asyncio.run(Tab(cast(ClientWebSocketResponse, socket)).until("so", 1.0))
    return socket


TRUE = {"result": {"result": {"value": True}}}


def test_a_page_that_loads_itself_anew_is_asked_again() -> None:
    left = {"error": {"code": -32000, "message": "Inspected target navigated or closed"}}
    assert [one["method"] for one in until(left, TRUE).asked] == ["Runtime.evaluate"] * 2
    with pytest.raises(BrowserError, match="no such method"):
        until({"error": {"code": -32601, "message": "no such method"}}, TRUE)
