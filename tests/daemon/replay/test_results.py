"""Results as other tools read them."""

import errno
import io
import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from daemon.maps.drawing.font import word
from daemon.maps.grid_files import greys, map_files, map_yaml, pgm
from daemon.maps.map_drawing import LAMP, UNKNOWN, WALL, draw, near, picture
from daemon.maps.map_server import FREE, OCCUPIED
from daemon.maps.png import encode_png
from daemon.replay.results import Folder, OutputRefused, Trajectory, doubt, guessed, kitti, tum
from daemon.replay.trajectories import Ledger
from daemon.runtime.cycle_parts import CycleRecord
from daemon.snapshot import Snapshot, State
from estimator.mapping.occupancy_grid import Grid

LOGITS = np.array([[4.0, 0.0, -4.0], [-1.4, -1.42, 0.61], [0.63, 10.0, -10.0]], dtype=np.float32)
"""Row 0 has the smallest y: wall, unknown, free; then just over FREE, just under, just under OCCUPIED; then walls."""
GRID = Grid(np.array([-3.0, 7.5]), 0.05, LOGITS)


@pytest.mark.parametrize(
    ("states", "said"),
    [
        ([State.TRACKING, State.MAPPING], ""),
        ([State.LOST, State.TRACKING], "1 of 2 poses are unconfirmed (LOST 1)"),
        (
            [State.LOST, State.AMBIGUOUS, State.TRACKING, State.AMBIGUOUS],
            "3 of 4 poses are unconfirmed (AMBIGUOUS 2, LOST 1); the last one too (AMBIGUOUS)",
        ),
        ([], ""),
    ],
)
def test_guesses_are_counted_in_a_sentence(states: list[State], said: str) -> None:
    count = len(states)
    assert guessed(Trajectory(np.arange(float(count)), np.zeros((count, 3)), np.array(states, np.int64))) == said


@pytest.mark.parametrize(
    ("guesses", "said"),
    [(0, ""), (10, ""), (11, "11 % of the poses are unconfirmed"), (100, "100 % of the poses are unconfirmed")],
)
def test_guesses_in_more_than_a_tenth_are_a_warning(guesses: int, said: str) -> None:
    states = np.repeat(np.array([State.RELOCATING, State.TRACKING], np.int64), [guesses, 100 - guesses])
    assert doubt(Trajectory(np.arange(100.0), np.zeros((100, 3)), states)).startswith(said)
    assert bool(doubt(Trajectory(np.arange(100.0), np.zeros((100, 3)), states))) == bool(said)


def test_grid_pixels_run_from_the_top() -> None:
    assert greys(GRID).tolist() == [[0, 0, 254], [205, 254, 205], [0, 205, 254]]


def load_like_map_server(folder: Path) -> tuple[np.ndarray, dict[str, object]]:
    """The trinary rule of ROS map_server, from its documentation, with the thresholds of the file."""
    facts = yaml.safe_load((folder / "map.yaml").read_text())
    assert not Path(str(facts["image"])).is_absolute()
    image = np.array(Image.open(folder / facts["image"])).astype(float)
    assert facts["mode"] == "trinary"
    assert facts["negate"] == 0
    p = (255.0 - image) / 255.0
    cells = np.full(p.shape, -1)
    cells[p > facts["occupied_thresh"]] = 100
    cells[p < facts["free_thresh"]] = 0
    return cells[::-1], facts  # row 0 at the smallest y again


def test_map_server_reads_back_what_the_grid_says(tmp_path: Path) -> None:
    Folder(tmp_path / "out").write_each(map_files(GRID, np.zeros((0, 2))))
    cells, facts = load_like_map_server(tmp_path / "out")
    p = GRID.probability
    assert np.array_equal(cells == 100, p > OCCUPIED)
    assert np.array_equal(cells == 0, p < FREE)
    assert np.array_equal(cells == -1, (p >= FREE) & (p <= OCCUPIED))
    assert facts["origin"] == [-3.0, 7.5, 0.0]
    assert facts["resolution"] == 0.05
    assert (facts["occupied_thresh"], facts["free_thresh"]) == (0.65, 0.196)


def test_unknown_stays_unknown_under_the_rule_of_the_readers() -> None:
    assert FREE < (255 - 205) / 255 < OCCUPIED


def test_an_empty_map_is_still_a_map(tmp_path: Path) -> None:
    empty = Grid(np.zeros(2), 0.05, np.zeros((0, 0), np.float32))
    Folder(tmp_path).write_each(map_files(empty, np.zeros((0, 3))))
    cells, _ = load_like_map_server(tmp_path)
    assert cells.tolist() == [[-1]]
    Image.open(tmp_path / "map.png").verify()


def test_no_minus_zero_in_the_origin() -> None:
    assert (
        "origin: [0.000000, -1.000000, 0.0]" in map_yaml(Grid(np.array([-0.0, -1.0]), 0.05, LOGITS), "m.pgm").decode()
    )


def test_png_shows_the_pixels_it_was_given() -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (17, 23, 3), dtype=np.uint8)
    assert np.array_equal(np.array(Image.open(io.BytesIO(encode_png(pixels)))), pixels)
    assert encode_png(pixels) == encode_png(pixels.copy())


def test_the_picture_shows_walls_free_space_and_the_path() -> None:
    logits = np.full((40, 60), -8.0, np.float32)
    logits[:, :20] = 0.0
    logits[0] = 8.0
    grid = Grid(np.array([0.0, 0.0]), 0.1, logits)
    drawn = draw(grid, np.array([(2.5, 1.0), (5.5, 1.0), (5.5, 3.5)])).astype(int)
    scale = drawn.shape[1] // 60
    assert drawn.shape == (40 * scale, 60 * scale, 3)

    def at(x: float, y: float) -> list[int]:
        return drawn[drawn.shape[0] - 1 - int(y / 0.1 * scale), int(x / 0.1 * scale)].tolist()

    assert min(at(3.0, 3.0)) > 250  # free
    assert max(at(5.0, 0.05)) < 60  # wall, at the bottom
    assert at(1.0, 3.0) == [205, 211, 220]  # unknown
    assert at(2.5, 1.0) == [0, 90, 181]  # the start, blue
    assert at(5.5, 3.5) == [230, 120, 0]  # the end, orange
    assert max(at(4.0, 1.0)) - min(at(4.0, 1.0)) > 60  # a coloured path between


@pytest.mark.parametrize(
    ("side_m", "length"), [(8.0, "1 m"), (20.0, "5 m"), (48.0, "10 m"), (160.0, "50 m"), (320.0, "100 m")]
)
def test_the_bar_says_how_long_it_is(side_m: float, length: str) -> None:
    cells = round(side_m / 0.1)
    pixels = draw(Grid(np.zeros(2), 0.1, np.zeros((cells, cells), np.float32)), np.zeros((0, 2)))
    corner = np.all(pixels[-60:, :80] == WALL, axis=2)
    windows = np.lib.stride_tricks.sliding_window_view(corner, (ink := word(length)).shape)
    assert np.all(windows == ink, axis=(2, 3)).sum() == 1, "letter by letter"


def found(pixels: np.ndarray, text: str, turned: bool = False) -> np.ndarray:
    """(n, 2) places, row and column, where a text stands."""
    ink = np.rot90(word(text)) if turned else word(text)
    dark = np.all(pixels == WALL, axis=2)
    at = np.argwhere(dark[: dark.shape[0] - ink.shape[0] + 1, : dark.shape[1] - ink.shape[1] + 1] >= 0)
    for (row, column), inked in sorted(np.ndenumerate(ink), key=lambda dot: not dot[1]):
        at = at[dark[at[:, 0] + row, at[:, 1] + column] == inked]
    return at


def test_axes_say_where_a_lamp_hangs_in_the_map() -> None:
    """By the ticks alone: a lamp's disc is where its coordinates are on both axes; its number stands beside it."""
    grid = Grid(np.array([-12.0, 31.0]), 0.05, np.full((160, 200), -4.0, np.float32))
    lamps = np.array([(-8.0, 36.0, 17.0), (-5.0, 33.0, 4.0), (99.0, 99.0, 5.0)])
    pixels = picture(grid, np.array([(-10.0, 34.0), (-4.0, 34.0)]), lamps)
    ((_, left),), ((_, right),) = found(pixels, "-11"), found(pixels, "-3")
    ((top, _),), ((bottom, _),) = found(pixels, "38"), found(pixels, "32")
    half = word("-11").shape[1] - word("-3").shape[1]
    per_metre = (right - left - 0.5 * half) / 8.0
    assert (bottom - top) / 6.0 == pytest.approx(per_metre, abs=0.3)
    disc = np.all(pixels == LAMP, axis=2)
    for x, y, number in lamps[:2]:
        column = left + 0.5 * word("-11").shape[1] + per_metre * (x + 11.0)
        row = top + 0.5 * word("38").shape[0] + per_metre * (38.0 - y)
        assert disc[round(row) - 3 : round(row) + 4, round(column) - 3 : round(column) + 4].all()
        beside = pixels[round(row) - 24 : round(row) + 8, round(column) : round(column) + 40]
        assert len(found(beside, f"{number:.0f}")) == 1
    assert len(found(pixels, "x, m (map frame)")) == 1
    assert len(found(pixels, "y, m (map frame)", turned=True)) == 1
    for text in ("start", "end", "lamp with its number", "wall", "free", "unknown"):
        assert len(found(pixels, text)) == 1
    assert len(found(pixels, "1 m")) == 1, "the bar"


def test_a_picture_is_cut_to_a_margin_about_the_path() -> None:
    cells = np.full((400, 600), -4.0, np.float32)
    cells[:, 500:] = 0.0
    grid, path = Grid(np.array([2.0, -3.0]), 0.05, cells), np.array([(5.0, 1.0, 0.2), (8.0, 2.0, 0.0)])
    part = near(grid, path, 1.5)
    assert part.origin == pytest.approx((3.5, -0.5))
    assert part.log_odds.shape == (80, 120)
    assert near(grid, path, None) is grid
    assert near(grid, path[:0], 1.5) is grid
    assert near(grid, path, 100.0).log_odds.shape == grid.log_odds.shape
    assert (
        (picture(part, path) == UNKNOWN).all(axis=2).mean() < 0.01 < (picture(grid, path) == UNKNOWN).all(axis=2).mean()
    )
    assert (picture(part, path).min(axis=2) > 250).mean() > 0.5


def test_a_picture_is_drawn_in_a_few_times_its_size() -> None:
    cells = np.random.default_rng(1).normal(0.0, 3.0, (1500, 1500)).astype(np.float32)
    t = np.linspace(0.0, 6.0, 500)
    tracemalloc.start()
    pixels = draw(Grid(np.zeros(2), 0.05, cells), np.column_stack([37.0 + 20.0 * np.cos(t), 37.0 + 20.0 * np.sin(t)]))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert pixels.shape == (1500, 1500, 3)
    assert peak < 10 * pixels.nbytes


def test_no_seam_where_a_picture_was_drawn_in_bands() -> None:
    grid = Grid(np.zeros(2), 0.05, np.full((300, 200), -4.0, np.float32))
    up = np.column_stack([np.full(400, 5.025), np.linspace(1.0, 14.0, 400)])
    along = draw(grid, up)[30 * 4 : 270 * 4]  # a cell has 4 pixels; between the dots at the ends
    painted = (along != along[:, :1]).any(axis=2)
    assert painted.any(axis=1).all()
    assert np.unique(painted, axis=0).shape[0] == 1


def test_tum_is_what_evo_and_the_benchmarks_read() -> None:
    path = Trajectory(
        np.array([2.0, 1.0, 1.5]), np.array([(1.0, 2.0, np.pi / 2), (0, 0, 0.0), (0.1234567, -1.0, -3.0)])
    )
    lines = tum(path).decode().splitlines()
    assert lines[0].startswith("#")
    assert lines[1] == "1.000000 0.000000 0.000000 0 0 0 0.000000000 1.000000000"
    assert lines[2].startswith("1.500000 0.123457 -1.000000 0 0 0 -0.997494987 0.0707372")
    assert lines[3] == "2.000000 1.000000 2.000000 0 0 0 0.707106781 0.707106781"
    assert all(len(line.split(" ")) == 8 for line in lines[1:])


@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_a_file_has_one_pose_for_an_instant_the_last_one(begin: float) -> None:
    """Equal to the microsecond that is written; the file's order is that of time."""
    stamps = begin + np.array([1.0, 2.0, 1.0, 1.0000003, 0.5, 2.0])
    path = Trajectory(stamps, np.column_stack([np.arange(6.0), np.zeros(6), np.zeros(6)]))
    lines = [line.split(" ") for line in tum(path).decode().splitlines()[1:]]
    assert [(float(line[0]) - begin, float(line[1])) for line in lines] == [(0.5, 4.0), (1.0, 3.0), (2.0, 5.0)]
    assert [float(line.split(" ")[3]) for line in kitti(path).decode().splitlines()] == [4.0, 3.0, 5.0]


def cycle(x: float) -> CycleRecord:
    """A cycle that consumed a scan and published the pose (x, 0, 0) of the instant 5 s."""
    result: Any = SimpleNamespace(
        t_mono=5.0, anchor=9, jumps=0, lights=None, T_odom_base=np.array((x, 0.0, 0.0)), T_anchor_base=np.zeros(3)
    )
    snapshot = Snapshot(1, 5.0, 5.0, 5.0, State.TRACKING, 0, pose=(x, 0.0, 0.0))
    return CycleRecord(1, 5.0, 1, (), 0, 0, (), (), None, result, snapshot, {})


def test_a_correction_of_the_same_instant_replaces_its_row() -> None:
    """Two cycles of a late scan: the pose's instant stays, its place does not."""
    ledger = Ledger()
    rows = [ledger.add(cycle(x), 10.0, 5.0) for x in (0.0, 0.3)]
    ledger.settle({})
    rows.append(ledger.add(cycle(0.4), 10.0, 5.0))  # what is settled stays
    rows.append(ledger.add(cycle(0.5), 10.5, 5.0))
    assert rows == [0, 0, 1, 2]
    ledger.settle({})
    assert ledger.online().poses[:, 0].tolist() == ledger.final().poses[:, 0].tolist() == [0.3, 0.4, 0.5]
    assert [line.split(" ")[1] for line in tum(ledger.final()).decode().splitlines()[1:]] == ["0.400000", "0.500000"]


def test_no_poses_no_lines() -> None:
    assert tum(Trajectory(np.empty(0), np.empty((0, 3)))).decode().count("\n") == 1


def test_no_line_is_drawn_where_the_robot_was_carried() -> None:
    grid = Grid(np.zeros(2), 0.05, np.full((100, 200), -3.0, np.float32))
    ways = [np.column_stack((np.arange(begin, begin + 2.0, 0.02), np.full(100, 2.5))) for begin in (1.0, 7.0)]
    pixels = draw(grid, np.vstack(ways)).astype(int)
    coloured = (np.ptp(pixels, axis=2) > 60).any(axis=0)
    scale = pixels.shape[1] / 10.0
    for x, drawn in ((1.5, True), (2.5, True), (4.0, False), (5.5, False), (7.5, True), (8.5, True)):
        assert coloured[round(x * scale)] == drawn


def test_folder_problems_are_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputRefused, match=r"file is a file; name a folder"):
        Folder(tmp_path / "file")
    with pytest.raises(OutputRefused, match="cannot create"):
        Folder(tmp_path / "file" / "below")


def test_a_full_disk_keeps_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Folder(tmp_path)
    folder.write("a.txt", b"first")

    def full(self: Path, data: bytes) -> int:
        self.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OutputRefused, match=r"a\.txt: No space left on device; free space"):
        folder.write("a.txt", b"second")
    assert (tmp_path / "a.txt").read_text() == "first"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.txt"]


def test_what_has_room_is_written_though_something_else_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Path.write_bytes

    def nearly_full(self: Path, data: bytes) -> int:
        if len(data) > 100:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(self, data)

    folder = Folder(tmp_path)
    monkeypatch.setattr(Path, "write_bytes", nearly_full)
    files = [("big", bytes(101)), ("small", b"kept"), ("huge", bytes(999)), ("last", b"kept too")]
    with pytest.raises(OutputRefused, match=r"big: No space left on device.*; huge could not be written either"):
        folder.write_each(files)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["last", "small"]


def test_pgm_head() -> None:
    assert pgm(GRID).startswith(b"P5\n3 3\n255\n")
    assert len(pgm(GRID)) == len(b"P5\n3 3\n255\n") + 9
