"""What the figures of real maps count, on walls of known thickness."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tools.bench import maps
from tools.bench.maps import aligned, read_pgm, thickness


def wall(offsets: np.ndarray, normal_y: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Walls along x, 4 m long, at the given heights, seen a minute apart."""
    x = np.arange(0.0, 4.0, 0.01)
    points = np.concatenate([np.column_stack([x, np.full(len(x), y)]) for y in offsets])
    normals = np.tile((0.0, normal_y), (len(points), 1))
    return points, normals, np.repeat(60.0 * np.arange(len(offsets)), len(x))


def test_a_wall_laid_twice_is_as_thick_as_its_copies_are_apart() -> None:
    widths = thickness(*wall(np.array((0.0, 0.08))), samples=100)
    assert len(widths) == 100
    np.testing.assert_allclose(widths, 0.08, atol=1e-9)


def test_the_two_faces_of_a_wall_are_two_walls() -> None:
    here, there = wall(np.array((0.0, 0.002))), wall(np.array((0.12, 0.122)), -1.0)
    both = tuple(np.concatenate(parts) for parts in zip(here, there, strict=True))
    assert thickness(*both, samples=200).max() < 0.003


def test_relief_that_single_scans_show_is_no_thick_wall() -> None:
    points, normals, times = wall(np.array((0.0, 0.3, 0.0, 0.3)))
    times = np.where(times < 100.0, 0.0, 60.0)
    assert len(thickness(points, normals, times, samples=50)) == 0


def test_what_was_seen_once_has_no_thickness_yet() -> None:
    assert len(thickness(*wall(np.array((0.0,))), samples=50)) == 0


def test_a_trajectory_is_compared_after_the_best_rigid_motion() -> None:
    t = np.arange(50.0)
    poses = np.column_stack([t, np.sin(t), np.zeros(50)])
    c, s = np.cos(0.7), np.sin(0.7)
    turned = np.column_stack([c * poses[:, 0] - s * poses[:, 1] + 5.0, s * poses[:, 0] + c * poses[:, 1], poses[:, 2]])
    assert aligned(t, poses, t[::3], turned[::3]).max() < 1e-9
    off = turned.copy()
    off[0, 0] += 1.0
    assert 0.5 < aligned(t, poses, t, off).max() < 1.0


def test_a_written_map_is_drawn_with_its_path_and_loops(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 0.5\norigin: [-1.000000, -2.000000, 0.0]\n")
    (tmp_path / "map.pgm").write_bytes(b"P5\n8 6\n255\n" + bytes(range(100, 148)))
    (tmp_path / "trajectory.tum").write_text("1.0 -0.9 -1.9 0 0 0 0 1\n2.0 1.1 0.6 0 0 0 0 1\n")
    (tmp_path / "loops.csv").write_text("stamp,counter,keyframe_new,keyframe_old,residual_m\n2.0,1,9,1,0.01\n")
    grid, resolution, origin = read_pgm(tmp_path)
    assert grid.shape == (6, 8)
    assert grid[0, 0] == 100
    assert (resolution, *origin) == (0.5, -1.0, -2.0)
    maps.picture(tmp_path, tmp_path / "out" / "map.png")
    assert (tmp_path / "out" / "map.png").read_bytes().startswith(b"\x89PNG")


def test_poses_that_were_no_more_than_guesses_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are in no figure of what was published: who is LOST more would seem the better."""
    lines = [f"{at}.0 {at}.0 0.0 0 0 0 0 1\n" for at in range(5)]
    for name in ("trajectory.tum", "aces.gmapping_gfs.tum"):
        (tmp_path / name).write_text("".join(lines))
    (tmp_path / "online.tum").write_text(
        "# stamp x y\n" + "".join(["# LOST " + line for line in lines[:2]] + lines[2:])
    )
    (tmp_path / "loops.csv").write_text("stamp,counter\n")
    monkeypatch.setattr(maps, "placed", lambda log, poses: ())
    monkeypatch.setattr(maps, "thickness", lambda: np.array([0.01]))
    figures = maps._figures("aces", tmp_path / "aces.clf.gz", tmp_path, maps.Used(1.0, 1.0))
    (told,) = [figure for figure in figures if "guesses" in figure.name]
    assert (told.name, told.value) == ("aces, as published: guesses, left out", 2.0)


@pytest.mark.slow
def test_walls_of_real_logs_are_thin(monkeypatch: pytest.MonkeyPatch, log_root: Path, tmp_path: Path) -> None:
    monkeypatch.setenv("LUMILOOP_DATA", str(log_root))
    monkeypatch.chdir(tmp_path)
    named = {figure.name: figure for figure in maps.run()}
    for log in ("intel", "aces"):
        assert named[f"{log}: thickness of walls, median"].value <= 100.0
        assert named[f"{log}: memory at most"].value <= 300.0
        assert (tmp_path / "out" / "bench" / f"map-{log}.png").stat().st_size < 300_000


def test_a_process_is_charged_with_its_own_memory_only() -> None:
    held = np.ones(25_000_000)  # 200 MB of this process
    assert maps.waited([sys.executable, "-S", "-c", "pass"]).peak_mb < 60.0
    assert maps.waited([sys.executable, "-S", "-c", "len(bytearray(b'x') * 100_000_000)"]).peak_mb > 95.0
    assert held.all()
    with pytest.raises(RuntimeError, match="status 3"):
        maps.waited([sys.executable, "-S", "-c", "raise SystemExit(3)"])
