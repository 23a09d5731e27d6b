"""Pictures of the page are taken of a robot that is well."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

pytest.importorskip("aiohttp", reason="pip install 'lumiloop[view]'")
from tools.docs import pageshots


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
    for name in pageshots.PICTURES:
        assert "TRACKING" in taken[name]


def test_a_picture_is_made_smaller_and_looks_the_same(tmp_path: Path) -> None:
    path = tmp_path / "page.png"
    page = Image.new("RGB", (300, 200), (14, 18, 27))
    for x in range(200):
        page.paste((x, 200 - x, 90), (x, 0, x + 1, 100))
    page.save(path)
    pageshots.smaller(path)
    with Image.open(path) as few:
        assert few.mode == "P"
        told, seen = page.tobytes(), few.convert("RGB").tobytes()
    assert max(abs(a - b) for a, b in zip(told, seen, strict=True)) <= 3
