"""Maps of the light: numbers of the right place, and a picture of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tools.sim.ceiling.ceiling import paper_ceiling
from tools.sim.light.draw import draw, maps, places, room_of


def test_maps_have_a_row_a_place_and_a_column_a_lamp() -> None:
    ceiling = paper_ceiling()
    x, y, poses = places(ceiling, 20)
    received, book = maps(ceiling, poses)
    assert received.shape == book.shape == (len(x) * len(y), 16)
    nearest = np.hypot(*(poses[:, None, :2] - ceiling.placed[:, :2]).transpose(2, 0, 1)).argmin(axis=1)
    clear = np.abs(poses[:, :2]).max(axis=1) < 4.5
    assert np.mean(received.argmax(axis=1)[clear] == nearest[clear]) > 0.8
    assert room_of(ceiling, (0.0, 0.0)) == (-5.0, -5.0, 5.0, 5.0)
    assert room_of(ceiling, (9.0, 0.0)) is None
    assert 0.7 < np.median(received[book > 50e-9] / book[book > 50e-9]) < 1.5


def test_a_picture_is_drawn(tmp_path: Path) -> None:
    pyplot = pytest.importorskip("matplotlib.figure")
    figure = pyplot.Figure(figsize=(6, 6))
    draw(figure, "corridor_loop", 24)
    assert len(figure.axes) == 6
    figure.savefig(tmp_path / "light.png", dpi=40)
    assert (tmp_path / "light.png").stat().st_size > 5000
