"""Pictures of the page are taken of a robot that is well."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason="pip install 'lumiloop[view]'")
from tools import pageshots


class Page:
    """A page of a robot that is DEGRADED until somebody waits for it to be well."""

    def __init__(self, taken: dict[str, str]) -> None:
        self.taken = taken
        self.waited: list[str] = []

    async def until(self, expression: str, seconds: float) -> None:
        self.waited.append(expression)

    async def picture(self, path: Path) -> None:
        self.taken[path.name] = self.waited[-1]


def test_the_robot_is_tracking_in_every_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: dict[str, str] = {}

    @contextlib.asynccontextmanager
    async def tab(*_: Any, **__: Any) -> AsyncIterator[Page]:
        yield Page(taken)

    monkeypatch.setattr(pageshots, "tab", tab)
    monkeypatch.setattr(pageshots, "SETTLE_S", 0.0)
    asyncio.run(pageshots.photograph("", "", tmp_path, 0.0))
    for name in ("view.png", "view-phone.png"):
        assert "TRACKING" in taken[name]
