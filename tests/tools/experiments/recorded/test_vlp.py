from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from tools.experiments.recorded import vlp
from tools.experiments.support.report import Skipped


def spread_of_power_law(places: vlp.Array, lamps: vlp.Array, rss: vlp.Array) -> vlp.Array:
    """Standard deviation of what a straight line of ln strength over ln distance leaves over, per lamp."""
    left = []
    for lamp, column in zip(lamps, rss.T, strict=True):
        columns = np.column_stack((np.ones(len(places)), np.log(np.sum((places - lamp) ** 2, axis=1))))
        y = np.log(column)
        left.append(np.std(y - columns @ np.linalg.lstsq(columns, y)[0]))
    return np.array(left)


@pytest.fixture
def data(log_root: Path) -> Path:
    return log_root


@pytest.mark.parametrize(("name", "count"), [("RSS", 73), ("RSS_0923", 81)])
def test_static_campaigns_fall_off_with_distance(data: Path, name: str, count: int) -> None:
    found = vlp.campaign(name)
    assert found.places.shape == (count, 3)
    assert found.rss.shape == (count, 5)
    assert spread_of_power_law(found.places, found.lamps, found.rss).max() < 0.2
    exchanged = found.rss[:, [0, 2, 1, 3, 4]]  # what the second file holds would not fit at all
    assert spread_of_power_law(found.places, found.lamps, exchanged)[1:3].min() > 0.8


def test_spreads_are_exchanged_along_with_the_strengths(data: Path) -> None:
    found = vlp.campaign("RSS_0923")
    assert found.spread is not None
    ratio = np.log(found.spread)
    for lamp in (1, 2):
        link = [np.corrcoef(ratio[:, lamp], np.log(found.rss[:, k]))[0, 1] for k in (1, 2)]
        assert link[lamp - 1] > link[2 - lamp] + 0.3


@pytest.mark.parametrize("name", ["circle_level", "circle_inclined10"])
def test_walk_lamps_and_truth_share_a_frame(data: Path, name: str) -> None:
    walk = vlp.walk(name)
    assert spread_of_power_law(walk.truth, walk.lamps, walk.rss).max() < 0.15
    mirrored = walk.truth[:, [1, 0, 2]]
    assert np.median(spread_of_power_law(mirrored, walk.lamps, walk.rss)) > 0.18
    assert np.median(np.linalg.norm(walk.recorders_fix - walk.truth, axis=1)) < 0.35


@pytest.mark.parametrize("name", vlp.WALKS)
def test_imu_axes_and_units(data: Path, name: str) -> None:
    walk = vlp.walk(name)
    step = np.diff(walk.truth[:, :2], axis=0)
    speed = np.hypot(*step.T)
    moving = speed > 0.1
    course = np.unwrap(np.arctan2(step[moving, 1], step[moving, 0]))
    yaw = walk.imu.yaw(0.5 * (walk.t[1:] + walk.t[:-1]))[moving]
    assert np.std(course - yaw) < np.radians(3)  # radians, counter-clockwise
    assert walk.imu.velocity[:, 2].mean() / 0.005 == pytest.approx(vlp.GRAVITY, abs=0.15)
    turned = walk.imu.yaw(walk.t[1:]) - walk.imu.yaw(walk.t[:-1])
    force = -walk.imu.lean(0.5 * (walk.t[1:] + walk.t[:-1])) * vlp.GRAVITY
    toward_left = np.polyfit((speed * turned)[moving], force[moving, 1], 1)[0]
    assert 0.5 < toward_left < 1.5  # centripetal acceleration points to the inside of the turn


def test_only_the_inclined_receiver_leans_and_only_while_it_moves(data: Path) -> None:
    lean = {}
    for name in vlp.WALKS:
        walk = vlp.walk(name)
        moving = np.hypot(*np.gradient(walk.truth[:, :2], axis=0).T) > 0.1
        slopes = walk.imu.lean(walk.t)
        lean[name] = [np.degrees(np.linalg.norm(slopes[part].mean(axis=0))) for part in (moving, ~moving)]
    assert lean["circle_inclined10"][0] > 10.0
    assert max(lean["circle_level"] + lean["square_blocked"] + lean["circle_inclined10"][1:]) < 4.0


def test_raw_stream_has_the_six_tones(data: Path) -> None:
    stream = vlp.raw()
    assert len(stream.words) == 159164
    tones = np.array(stream.tones)
    spectrum = np.abs(np.fft.rfft((stream.words - stream.words.mean()) * np.hanning(len(stream.words))))
    hertz = np.fft.rfftfreq(len(stream.words), 1 / stream.rate)
    floor = np.median(spectrum)
    for tone in tones:
        assert spectrum[np.abs(hertz - tone) < 0.2].max() > 100 * floor


def test_without_data_the_reason_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("LUMILOOP_DATA", raising=False)
    with pytest.raises(Skipped, match="LUMILOOP_DATA is not set"):
        vlp.raw()
    monkeypatch.setenv("LUMILOOP_DATA", str(tmp_path))
    with pytest.raises(Skipped, match="vlp"):
        vlp.campaign("RSS")
    (tmp_path / "vlp" / "raw").mkdir(parents=True)
    for read in (lambda: vlp.campaign("RSS"), lambda: vlp.walk("circle_level"), vlp.raw):
        with pytest.raises(Skipped, match="is missing"):
            read()


def test_names_that_do_not_exist() -> None:
    with pytest.raises(ValueError, match="RSS_0923"):
        vlp.campaign("rss")
    with pytest.raises(ValueError, match="circle_level"):
        vlp.walk("circle")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3 4 5 6 7 8\n1 2 3\n", "line 2: 3 columns"),
        ("1 2 3 x 5 6 7 8\n", "line 1: could not convert"),
        ("\n", "no data"),
        ("1 2 3 nan 5 6 7 8\n", "not finite"),
    ],
)
def test_damaged_tables_name_file_and_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str, message: str
) -> None:
    monkeypatch.setenv("LUMILOOP_DATA", str(tmp_path))
    (tmp_path / "vlp" / "static").mkdir(parents=True)
    (tmp_path / "vlp" / "static" / "RSS.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        vlp.campaign("RSS")


def test_walk_of_two_drives_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LUMILOOP_DATA", str(tmp_path))
    walks = tmp_path / "vlp" / "walks"
    walks.mkdir(parents=True)
    (walks / "circle_level_rss.txt").write_text("1 " * 9)
    (walks / "circle_level_truth.txt").write_text("2 1 1 1")
    with gzip.open(walks / "circle_level_imu.txt.gz", "wt") as file:
        file.write("1 " * 7)
    with pytest.raises(ValueError, match="not of the same instants"):
        vlp.walk("circle_level")


def test_damaged_raw_stream(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LUMILOOP_DATA", str(tmp_path))
    (tmp_path / "vlp" / "raw").mkdir(parents=True)
    with gzip.open(tmp_path / "vlp" / "raw" / "photodiode_2khz.txt.gz", "wt") as file:
        file.write("1,2,x,4")
    with pytest.raises(ValueError, match="photodiode"):
        vlp.raw()
