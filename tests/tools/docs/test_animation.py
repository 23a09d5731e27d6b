"""The animation shows what was published, where the robot truly was, and when it was carried."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from daemon.health.reasons import Reason
from daemon.snapshot import State

pytest.importorskip("matplotlib", reason="pip install 'lumiloop[plot]'")
from tools.docs.animation import FOOT, HEAD, HUES, SIDE, Ground, Moment, frame, write

IMAGES = Path(__file__).parents[3] / "docs" / "images"
GROUND = Ground(np.full((200, 200), 254, np.uint8), (-5.0, -5.0), 0.05, {7: (2.0, 3.0)})


def moment(state: State, pose: tuple[float, float, float] | None, t: float = 1.0, lifted: bool = False) -> Moment:
    return Moment(t, state, int(Reason.NONE), pose, (-3.0, -2.0, 0.0), frozenset({7}), lifted)


def pixel(x: float, y: float) -> tuple[int, int]:
    return round((x + 5.0) * SIDE / 10.0), HEAD + SIDE - round((y + 5.0) * SIDE / 10.0)


def test_pose_truth_and_lamps_are_where_they_are_in_the_map() -> None:
    drawn = frame(GROUND, [moment(State.TRACKING, (1.0, -1.0, 0.5))])
    assert drawn.size == (SIDE, HEAD + SIDE + FOOT)
    assert drawn.getpixel(pixel(1.0, -1.0)) == HUES[State.TRACKING]
    red, green, blue = drawn.getpixel(pixel(2.0, 3.0))  # type: ignore[misc]
    assert min(red, green) > 180
    assert blue < 80, "a lamp in use is yellow"
    ring = np.asarray(drawn)[pixel(0, -2.0)[1], pixel(-3.4, 0)[0] : pixel(-3.1, 0)[0]]
    assert ring.min() < 90, "the true robot is a ring"
    lost = frame(GROUND, [moment(State.RELOCATING, None)])
    assert lost.getpixel(pixel(1.0, -1.0)) != HUES[State.TRACKING]
    assert moment(State.TRACKING, (0.0, 2.0, 0.0)).off_m == pytest.approx(5.0)


def test_the_colours_of_the_states_survive_in_the_file(tmp_path: Path) -> None:
    states = (State.TRACKING, State.DEGRADED, State.RELOCATING, State.TRACKING)
    write(tmp_path / "a.gif", GROUND, [moment(state, (1.0, -1.0, 0.5), float(k)) for k, state in enumerate(states)])
    with Image.open(tmp_path / "a.gif") as picture:
        for k, state in enumerate(states):
            picture.seek(k)
            shown = np.array(picture.convert("RGB").getpixel(pixel(1.0, -1.0)))
            assert np.abs(shown - HUES[state]).max() < 6, state


def test_the_animation_of_the_readme_is_small_and_shown() -> None:
    path = IMAGES / "kidnap.gif"
    assert path.stat().st_size <= 1_500_000
    with Image.open(path) as picture:
        assert picture.n_frames > 100  # type: ignore[attr-defined]
    assert "docs/images/kidnap.gif" in (IMAGES.parents[1] / "README.md").read_text()[:2500], "at the top"
