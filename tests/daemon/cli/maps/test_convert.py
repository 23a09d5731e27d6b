"""Map files for other programs and back, each read by a reader of somebody else or by our own replay; align, name."""

import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from daemon.cli import parser
from daemon.config.schema import Config
from daemon.maps.edit import LONGEST_NAME, fitted, opened
from daemon.maps.image import image_from, meta_of, packed
from daemon.maps.image_geometry import grid_of, placed
from daemon.maps.store import Store
from daemon.replay.log_replay import replay
from daemon.replay.sources import open_log
from daemon.system import console
from estimator.mapping.keyframe import Keyframe
from estimator.mapping.map_snapshot import Identity, MapImage
from estimator.mapping.occupancy_grid import Grid
from estimator.measurements import Array, Beam
from estimator.numerics import se2
from estimator.stored_map import image_of
from tests.daemon.support.map_maker import Shape, content, image
from tests.estimator.circuit import driven

pytestmark = pytest.mark.jit
MAP = 0xABCD


@pytest.fixture(scope="module")
def made() -> MapImage:
    return image_of(driven(laps=1.3)[0], Identity(MAP, "hall"))


@pytest.fixture
def file(made: MapImage, tmp_path: Path) -> Path:
    """A map in a folder of its own."""
    store = Store(tmp_path / "maps")
    path = store.save(packed(made, meta_of(made, 1.0, "robot", "1")), MAP)
    store.close()
    return path


def run(*words: object) -> int:
    return parser.main(["map", *map(str, words)])


def by_map_server(folder: Path) -> tuple[np.ndarray, dict[str, object]]:
    """Trinary cells, bottom row first, as map_server's documentation says."""
    facts = yaml.safe_load((folder / "map.yaml").read_text())
    with Image.open(folder / facts["image"]) as picture:
        shade = np.array(picture, dtype=np.float64)[::-1]
    p = shade / 255.0 if facts["negate"] else (255.0 - shade) / 255.0
    cells = np.full(p.shape, -1)
    cells[p > facts["occupied_thresh"]] = 100
    cells[p < facts["free_thresh"]] = 0
    return cells, facts


def test_map_server_reads_what_the_map_says(file: Path, made: MapImage, tmp_path: Path) -> None:
    assert run("export", file, "--out", tmp_path / "out") == console.OK
    cells, facts = by_map_server(tmp_path / "out")
    grid = grid_of(image_from(opened(file)))
    assert facts["mode"] == "trinary"
    assert facts["resolution"] == grid.resolution == 0.05
    assert facts["origin"] == pytest.approx([*grid.origin, 0.0], abs=1e-6)
    np.testing.assert_array_equal(cells == 100, grid.probability > 0.65)
    np.testing.assert_array_equal(cells == 0, grid.probability < 0.196)
    rows, columns = np.nonzero(cells == 100)
    xy = np.array(facts["origin"])[:2] + (np.column_stack((columns, rows)) + 0.5) * grid.resolution
    to_wall = np.minimum(np.abs(5.0 - np.abs(xy).max(axis=1)), np.abs(np.hypot(*(np.abs(xy) - 2.5).T) - 0.25))
    assert np.percentile(to_wall, 90) < 0.12  # the paper's room: walls at 5 m, four columns
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["map.pgm", "map.png", "map.yaml"]


def keyframes_of(file: Path) -> list[tuple[Keyframe, Array]]:
    return placed(image_from(opened(file)))


def test_tum_has_every_keyframe_where_it_lies(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("export", file, "--tum", "--out", tmp_path / "out") == console.OK
    assert capsys.readouterr().out == f"{tmp_path / 'out'}: keyframes.tum\n"
    rows = np.loadtxt(tmp_path / "out" / "keyframes.tum")
    frames = keyframes_of(file)
    np.testing.assert_array_equal(rows[:, 0], [frame.key for frame, _ in frames])
    poses = np.array([T for _, T in frames])
    np.testing.assert_allclose(rows[:, 1:3], poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(2.0 * np.arctan2(rows[:, 6], rows[:, 7]) - poses[:, 2], 0.0, atol=1e-6)
    assert not (tmp_path / "out" / "map.pgm").exists()


def test_our_replay_finds_the_same_room_in_the_carmen_log(file: Path, tmp_path: Path) -> None:
    assert run("export", file, "--carmen", "--out", tmp_path / "out") == console.OK
    outcome = replay(open_log(tmp_path / "out" / "keyframes.clf"), Config())
    assert outcome.stopped == ""
    frames = keyframes_of(file)
    assert outcome.source.status.scans == len(frames)
    trajectory = outcome.rerun.ledger.final()
    T = se2.compose(frames[0][1], se2.inverse(trajectory.poses[0]))
    both = zip(frames, trajectory.poses, strict=True)
    off = np.array([se2.between(true, se2.compose(T, pose)) for (_, true), pose in both])
    assert np.hypot(*off[:, :2].T).max() < 0.1
    assert outcome.rerun.ledger.matched >= 0.95 * (len(frames) - 1)


def test_carmen_keeps_beams_mount_and_bearings(made: MapImage) -> None:
    from daemon.maps.carmen import carmen
    from hal.replay.carmen_lines import LaserLine, parse

    bearing = np.linspace(1.2, -1.0, 6)  # upside down
    distance = np.array((1.0, 2.5, 7.25, 0.0, 3.0, math.inf))
    kind = np.array((Beam.HIT, Beam.HIT, Beam.HIT, Beam.NONE, Beam.FREE, Beam.HIT), np.uint8)
    mount, T = np.array((0.2, 0.1, 0.3)), np.array((4.0, -2.0, 1.0))
    text = carmen([(17, T, mount, (bearing, distance, kind))])
    line = parse(text.splitlines()[-1])
    assert isinstance(line, LaserLine)
    assert line.setup.start == pytest.approx(-1.0)
    assert line.setup.resolution == pytest.approx(0.44)
    assert line.stamp == 17.0
    assert line.ranges.tolist() == [9.0, 9.0, 9.0, 7.25, 2.5, 1.0]
    assert line.setup.maximum == 9.0
    assert line.robot == pytest.approx(tuple(T), abs=1e-6)
    assert line.laser == pytest.approx(tuple(se2.compose(T, mount)), abs=1e-6)


def test_a_picture(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("render", file, tmp_path / "hall.png") == console.OK
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'hall.png'}: ")
    with Image.open(tmp_path / "hall.png") as picture:
        dark = (np.array(picture).sum(axis=2) < 300).mean()
    assert 0.005 < dark < 0.2
    assert run("render", file, tmp_path / "part.png", "--margin", "1") == console.OK
    assert "lumiloop: " not in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run("render", file, tmp_path / "part.png", "--margin", "0")


def test_what_we_export_we_import(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("export", file, "--out", tmp_path / "out")
    told = run("import", tmp_path / "out" / "map.yaml", "--name", "from nav2", "--out", tmp_path / "new.lumimap")
    assert told == console.OK
    assert "submaps" in capsys.readouterr().out
    stored = opened(tmp_path / "new.lumimap")
    assert stored.meta.name == "from nav2"
    assert stored.meta.map_id != MAP
    assert stored.isolated == 0
    a, b = grid_of(image_from(opened(file))), grid_of(image_from(stored))
    assert agreement(a, b) > 0.95


def agreement(a: Grid, b: Grid) -> float:
    """Share of the free cells of ``a`` that are free in ``b``."""
    rows, columns = np.nonzero(a.probability < 0.196)
    at = np.rint((a.origin - b.origin) / a.resolution).astype(int)
    rows, columns = rows + at[1], columns + at[0]
    inside = (rows >= 0) & (columns >= 0) & (rows < b.log_odds.shape[0]) & (columns < b.log_odds.shape[1])
    return float((b.probability[rows[inside], columns[inside]] < 0.196).sum() / len(rows))


def test_import_into_the_configured_folder(file: Path, tmp_path: Path) -> None:
    run("export", file, "--out", tmp_path / "out")
    folder = tmp_path / "kept"
    assert run("import", tmp_path / "out" / "map.yaml", "--set", f"map.folder={folder}") == console.OK
    start = Store(folder).load()
    assert start is not None
    assert start.stored.meta.name == "map"


def test_while_a_daemon_runs_an_imported_map_goes_there_by_a_copy(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("export", file, "--out", tmp_path / "out")
    yaml_file, folder, new = tmp_path / "out" / "map.yaml", tmp_path / "kept", tmp_path / "new.lumimap"
    daemon = Store(folder)
    daemon.claim()
    assert run("import", yaml_file, "--set", f"map.folder={folder}") == console.FAILED
    assert "use --out FILE, copy the file there and run `lumiloop switch-map FILE`" in capsys.readouterr().err
    assert run("import", yaml_file, "--out", new) == console.OK
    (folder / new.name).write_bytes(new.read_bytes())
    start = daemon.load()
    assert start is not None
    assert start.stored.meta.map_id == opened(new).meta.map_id
    daemon.close()


def test_align_moves_everything_and_begins_a_frame_of_its_own(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    T = np.array((10.0, -3.0, 0.5))
    points = [(-4.0, -4.0), (4.0, -4.0), (4.0, 4.0)]
    moved = se2.apply(T, np.array(points))
    words = [f"--point={x},{y}={u + 0.01},{v}" for (x, y), (u, v) in zip(points, moved.tolist(), strict=True)]
    before = keyframes_of(file)
    assert run("align", file, *words) == console.OK
    said = capsys.readouterr().out
    assert "yaw 28.65 deg" in said
    assert "Residuals of the points" in said
    store = Store(file.parent)
    start = store.load()
    assert start is not None
    assert start.stored.meta.map_id != MAP
    assert f"{start.stored.meta.map_id:08x}" in said
    assert file.exists()
    after = placed(image_from(start.stored))
    for (a, old), (b, new) in zip(before, after, strict=True):
        assert a.key == b.key
        np.testing.assert_allclose(se2.between(se2.compose(T, old), new), 0.0, atol=0.02)


@pytest.mark.parametrize(
    ("points", "says"),
    [
        (["0,0=1,1"], "at least two points are needed, far apart"),
        (["0,0=1,1", "0.1,0=1.1,1"], "lie within 0.10 m"),
        (["0,0=0,0", "10,0=11,0"], r"distances of the points differ by \+10.0 %"),
        (["0,0=0,0", "10,0=10,0", "0,10=0.5,10"], "distances of the points differ"),
        (["0,0=0,0", "nonsense"], "--point nonsense: expected"),
        (["0,0=0,0", "1,2,3=4"], "--point 1,2,3=4: expected"),
    ],
)
def test_points_that_do_not_fit_are_refused(
    file: Path, points: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [f"--point={text}" for text in points]
    assert run("align", file, *words) == console.FAILED
    assert re.search(says, capsys.readouterr().err)
    assert [path.name for path in file.parent.glob("*.lumimap")] == [file.name]


def test_the_fit_reports_scale_and_residuals() -> None:
    fit = fitted([(0.0, 0.0, 1.0, 1.0), (10.0, 0.0, 1.0, 11.05)])
    assert pytest.approx((0.975, 1.025, math.pi / 2), abs=0.06) == fit.T
    assert fit.scale == pytest.approx(1.005)
    assert fit.residual_m == pytest.approx((0.025, 0.025))


def test_covariances_turn_with_the_map(file: Path) -> None:
    before = opened(file).tables["pose.P"]
    assert run("align", file, "--point=0,0=0,0", "--point=10,0=0,10") == console.OK
    start = Store(file.parent).load()
    assert start is not None
    after = start.stored.tables["pose.P"]
    np.testing.assert_allclose((after[0, 0], after[1, 1], after[2, 2]), (before[1, 1], before[0, 0], before[2, 2]))


def test_a_map_in_the_surveys_frame_is_not_moved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.lumimap"
    lit = replace(image(Shape()), identity=Identity(MAP, surveyed=True))
    path.write_bytes(packed(lit, meta_of(lit, 1.0, "robot", "1")))
    assert run("align", path, "--point=0,0=1,1", "--point=5,0=6,1", "--out", tmp_path / "b.lumimap") == console.FAILED
    assert "move the lamps in the survey" in capsys.readouterr().err


def test_a_name_stays_with_the_map(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("name", file, "2nd floor, east") == console.OK
    start = Store(file.parent).load()
    assert start is not None
    assert (start.stored.meta.name, start.stored.meta.map_id) == ("2nd floor, east", MAP)
    newest = max(file.parent.glob("*.lumimap"))
    capsys.readouterr()
    assert run("info", newest) == console.OK
    assert "2nd floor, east" in capsys.readouterr().out
    assert run("name", file, "x" * (LONGEST_NAME + 1)) == console.FAILED


@pytest.mark.parametrize("verb", ["export", "render", "align", "name"])
def test_files_that_are_no_maps(verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.lumimap"
    bad.write_bytes(content()[:-9])
    more: dict[str, list[object]] = {"export": ["--out", tmp_path / "o"], "render": [tmp_path / "o.png"]}
    for path in (bad, tmp_path / "none.lumimap"):
        words = more.get(verb, ["--point=0,0=0,0"] if verb == "align" else ["hall"])
        assert run(verb, path, *words) == console.FAILED
        assert str(path) in capsys.readouterr().err


def test_while_a_daemon_keeps_its_maps_there_nothing_is_written(
    file: Path, made: MapImage, capsys: pytest.CaptureFixture[str]
) -> None:
    daemon = Store(file.parent)
    daemon.save(packed(made, meta_of(made, 2.0, "robot", "1")), MAP)
    assert run("name", file, "hall") == console.FAILED
    assert "stop the daemon, or name --out" in capsys.readouterr().err
    daemon.close()


def test_align_and_name_load_no_compiler() -> None:
    code = "import sys, daemon.maps.edit; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_place_that_cannot_be_written_is_named(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "none" / "b.lumimap"
    assert parser.main(["map", "name", str(file), "hall", "--out", str(out)]) == console.FAILED
    said = capsys.readouterr().err
    assert f"{out}: cannot write the map: No such file or directory; name another file with --out FILE" in said


def test_a_drawing_of_more_floor_than_can_be_imported_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.fromarray(np.full((250, 250), 254, np.uint8)).save(tmp_path / "map.pgm")
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 1.0\norigin: [0, 0, 0]\n")
    assert run("import", tmp_path / "map.yaml", "--out", tmp_path / "new.lumimap") == console.FAILED
    assert "the map has 62500 m2 of free ground; at most 50000 can be imported" in capsys.readouterr().err
    assert not (tmp_path / "new.lumimap").exists()
