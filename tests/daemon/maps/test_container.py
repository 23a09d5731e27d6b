"""The bytes of a map file: round trip, every kind of damage, versions, torn maps, other surveys."""

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from daemon.maps import container
from daemon.maps.container import BadMap, Damaged, Foreign, Newer, pack, unpack
from daemon.maps.image import image_from, in_m, in_mm, meta_of, packed
from daemon.maps.schema import KINDS, OtherBuilding, against_survey, digest_of, lamps_of, parts, read, summary
from estimator.light_filter.survey import Survey
from estimator.mapping.map_snapshot import MapImage
from tests.daemon.support.map_maker import LAMPS, SURVEY, Shape, content, image

FROZEN = Path(__file__).parent / "data" / "version-1.lumimap"
"""Written by the code of version 1; never written again."""

shapes = st.builds(
    Shape,
    submaps=st.integers(0, 5),
    frames=st.integers(0, 4),
    beams=st.integers(1, 40),
    whole=st.booleans(),
    lit=st.booleans(),
    map_id=st.integers(1, 2**32 - 1),
)


def same(a: MapImage, b: MapImage) -> None:
    assert a.identity == b.identity
    assert [piece.key for piece in a.submaps] == [piece.key for piece in b.submaps]
    for one, other in zip(a.submaps, b.submaps, strict=True):
        assert (one.first, one.way_m) == (other.first, other.way_m)
        np.testing.assert_array_equal(one.T_map_submap, other.T_map_submap)
        np.testing.assert_array_equal(one.T_odom_submap, other.T_odom_submap)
        assert one.settled is not None
        assert other.settled is not None
        np.testing.assert_array_equal(one.settled.elements, other.settled.elements)
        np.testing.assert_array_equal(one.settled.witness.range_m, other.settled.witness.range_m)
        np.testing.assert_array_equal(one.settled.witness.T_odom_keyframe, other.settled.witness.T_odom_keyframe)
        assert one.settled.sigma == other.settled.sigma
        assert (one.light is None) == (other.light is None)
        if one.light is not None and other.light is not None:
            np.testing.assert_array_equal(one.light[1], other.light[1])
    for name in ("between", "T", "information", "loop"):
        np.testing.assert_array_equal(getattr(a.constraints, name), getattr(b.constraints, name))
    hung, again = list(a.keyframes()), list(b.keyframes())
    assert [(one.frame.key, one.submap) for one in hung] == [(one.frame.key, one.submap) for one in again]
    for one, other in zip(hung, again, strict=True):
        np.testing.assert_allclose(one.T_submap_keyframe, other.T_submap_keyframe, atol=1e-9)
        for name in ("bearing_rad", "range_m", "beam", "T_base_lidar"):
            np.testing.assert_array_equal(getattr(one.frame, name), getattr(other.frame, name))
        assert one.frame.turned_rad == other.frame.turned_rad
        assert (one.frame.virtual is None) == (other.frame.virtual is None)
        if one.frame.virtual is not None and other.frame.virtual is not None:
            assert one.frame.virtual.accepted == other.frame.virtual.accepted
            np.testing.assert_array_equal(one.frame.virtual.covariance, other.frame.virtual.covariance)
    assert a.gains.keys() == b.gains.keys()
    for lamp_id in a.gains:
        np.testing.assert_array_equal(a.gains[lamp_id], b.gains[lamp_id])
    assert a.lamps == b.lamps
    np.testing.assert_array_equal(a.T_map_base, b.T_map_base)
    np.testing.assert_array_equal(a.P, b.P)


@settings(max_examples=60, deadline=None)
@given(shapes, st.integers(0, 99))
def test_what_is_packed_comes_back(shape: Shape, seed: int) -> None:
    made = image(shape, seed)
    stored = read(packed(made, meta_of(made, 1.5e9, "robot", "0.1")))
    assert stored.isolated == 0
    same(image_from(stored), made)


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(container.DTYPES),
    st.integers(0, 3),
    st.lists(st.integers(0, 40), min_size=1, max_size=4),
    st.integers(0, 2**32 - 1),
)
def test_arrays_of_every_kind_come_back_to_the_last_bit(dtype: str, columns: int, rows: list[int], seed: int) -> None:
    rng, kind = np.random.default_rng(seed), np.dtype(dtype)
    pieces = []
    for n in rows:
        flat = rng.integers(0, 256, n * max(1, columns) * kind.itemsize, dtype=np.uint8).view(kind)
        pieces.append(flat.reshape(n, columns) if columns else flat)
    found = unpack(pack({"a": pieces, "empty": np.empty((0, 2))}))
    assert found["a"].tobytes() == np.concatenate(pieces).tobytes()
    assert found["a"].shape == np.concatenate(pieces).shape
    assert found["empty"].shape == (0, 2)


def test_large_arrays_are_packed_in_slices_between_which_others_are_let_in() -> None:
    big = np.arange(500_000, dtype=np.float64)
    breaths: list[int] = []
    data = pack({"big": big, "wide": big.reshape(-1, 5)}, lambda: breaths.append(1))
    assert len(breaths) >= 2 * big.nbytes // container.BLOCK_BYTES
    np.testing.assert_array_equal(unpack(data)["big"], big)
    np.testing.assert_array_equal(unpack(data)["wide"], big.reshape(-1, 5))


def test_ranges_in_millimetres_are_kept_as_such_and_others_as_they_are() -> None:
    mm = np.array((0, 1, 23, 4095, 65533, 129_999), np.int32)
    np.testing.assert_array_equal(in_mm(in_m(mm)), mm)
    for odd in (0.10005, np.nan, np.inf, -0.0, 1e6):
        assert in_mm(np.array((1.0, odd), np.float32)) is None
    whole, broken = (content(Shape(submaps=9, beams=1081, whole=mm)) for mm in (True, False))
    assert len(whole) < 0.85 * len(broken)  # of noise without any shape; walls pack better


GOOD = content(Shape(lit=True))


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 8 * len(GOOD) - 1), st.integers(1, 255))
def test_no_flipped_bit_is_overlooked(at: int, mask: int) -> None:
    spoilt = bytearray(GOOD)
    spoilt[at // 8] ^= mask
    with pytest.raises(BadMap) as caught:
        read(bytes(spoilt))
    assert len(str(caught.value)) > 20
    assert caught.value.remedy


@settings(max_examples=150, deadline=None)
@given(st.integers(0, len(GOOD) - 1), st.binary(max_size=40))
def test_no_other_length_is_overlooked(at: int, tail: bytes) -> None:
    for spoilt in (GOOD[:at], GOOD + tail + b"x", GOOD[:at] + tail + GOOD[at:] + b"\0"):
        with pytest.raises(BadMap):
            read(spoilt)


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=600))
def test_any_other_file_is_refused(data: bytes) -> None:
    for content_ in (data, container.MAGIC + data, GOOD[:24] + data):
        with pytest.raises(BadMap):
            read(content_)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(sorted(KINDS)), st.data())
def test_arrays_that_contradict_each_other_are_refused_or_harmless(name: str, data: st.DataObject) -> None:
    """A table whose checksums are right but whose content is not: written by software with a defect."""
    tables = unpack(GOOD)
    flat = tables[name].reshape(-1)
    how = data.draw(st.sampled_from(("drop", "double", "value", "missing")))
    if how == "missing":
        del tables[name]
    elif how == "drop":
        tables[name] = tables[name][:-1]
    elif how == "double":
        tables[name] = np.concatenate((tables[name], tables[name]))
    elif len(flat):
        at = data.draw(st.integers(0, len(flat) - 1))
        worst = {"u": 255, "i": -7, "f": np.inf}[flat.dtype.kind]
        flat[at] = data.draw(st.sampled_from((worst, flat.dtype.type(99))))
    with contextlib.suppress(BadMap):
        image_from(read(pack(tables)))


@pytest.mark.parametrize(
    ("spoilt", "kind", "words"),
    [
        (b"", Damaged, "the file ends in its head, after"),
        (GOOD[:10], Damaged, "ends in its head, after 10 bytes"),
        (GOOD[:5000], Damaged, "is 5000 bytes long instead of"),
        (b"P5 100 100 255 " + bytes(500), Foreign, "not a map file"),
        (GOOD[:8] + b"\x09\x00" + GOOD[10:], Newer, "version 9; this software reads versions up to 1"),
        (GOOD[:8] + b"\x00\x00" + GOOD[10:], Damaged, "version 0 does not exist"),
        (GOOD[:-3] + b"abc", Damaged, "part `pose.P`, bytes"),
    ],
)
def test_what_is_wrong_is_said_in_words(spoilt: bytes, kind: type[BadMap], words: str) -> None:
    with pytest.raises(kind, match=words.replace(".", r"\.")):
        read(spoilt)


def test_a_map_of_version_1_loads_for_ever() -> None:
    stored = read(FROZEN.read_bytes())
    found = summary(stored)
    assert (found["map_id"], found["name"]) == (0xC0FFEE, "second floor, Süd")
    assert (found["submaps"], found["keyframes"], found["lamps"], found["learned_gains"]) == (5, 12, 6, 6)
    same(image_from(stored), image(FROZEN_SHAPE, 7))


FROZEN_SHAPE = Shape(submaps=5, lit=True, map_id=0xC0FFEE, survey=digest_of(SURVEY))


def test_a_torn_map_is_loaded_in_the_part_where_the_robot_was_or_in_the_largest() -> None:
    stored = read(content(Shape(submaps=8, loose=2)))
    assert stored.isolated == 2
    assert stored.tables["submap.key"].tolist() == [1, 3, 5, 7, 9, 11]
    assert set(stored.tables["joined.keys"].reshape(-1).tolist()) <= {1, 3, 5, 7, 9, 11}
    made = image(Shape(submaps=8))
    cut = made.constraints
    cut.keep(np.arange(len(cut.loop)) != 4)  # the last three hang together, and the robot was there
    stored = read(packed(made, meta_of(made, 0.0, "", "")))
    assert stored.isolated == 5
    assert stored.tables["submap.key"].tolist() == [11, 13, 15]
    kept = image_from(stored)
    assert {hung.submap for hung in kept.keyframes()} == {11, 13, 15}
    for one, other in zip(kept.submaps, made.submaps[5:], strict=True):
        assert one.settled is not None
        assert other.settled is not None
        np.testing.assert_array_equal(one.settled.elements, other.settled.elements)


def test_parts_are_told_apart_whatever_the_order_of_what_joins_them() -> None:
    tables = unpack(content(Shape(submaps=7)))
    tables["joined.keys"] = np.array(((13, 1), (9, 11), (1, 5), (5, 9), (3, 7)))
    part = parts(tables)
    assert part[0] == part[2] == part[4] == part[5] == part[6]
    assert part[1] == part[3] != part[0]


def test_a_changed_survey_is_told_and_another_buildings_refused() -> None:
    stored = read(content(FROZEN_SHAPE))
    assert lamps_of(stored.tables) == LAMPS
    assert against_survey(stored, SURVEY) == ("", frozenset())
    assert against_survey(stored, Survey(())) == ("", frozenset())
    moved = replace(LAMPS[1], x=LAMPS[1].x + 1.0)
    weak = replace(LAMPS[2], power_w=0.7)
    words, changed = against_survey(stored, Survey((LAMPS[0], moved, weak, *LAMPS[3:5], replace(LAMPS[0], lamp_id=40))))
    assert changed == {2, 3, 6}
    for said in ("moved: 2", "gone: 6", "new: 40", "with another power: 3"):
        assert said in words
    assert 2 not in image_from(stored, changed).gains
    assert 1 in image_from(stored, changed).gains
    other = Survey(tuple(replace(lamp, x=lamp.x + 30.0) for lamp in LAMPS))
    with pytest.raises(OtherBuilding, match="0 of its 6 lamps agree with the present one") as caught:
        against_survey(stored, other)
    assert "lights.survey" in caught.value.remedy
    with pytest.raises(OtherBuilding):
        against_survey(stored, Survey(tuple(replace(lamp, lamp_id=lamp.lamp_id + 100) for lamp in LAMPS)))


def test_a_receiver_that_was_calibrated_anew_changes_no_lamp() -> None:
    stored = read(content(FROZEN_SHAPE))
    words, changed = against_survey(stored, replace(SURVEY, floor=0.02))
    assert "none, but the receiver or the diffuse floor" in words
    assert changed == frozenset()


def test_parts_that_only_light_joins_are_one_map() -> None:
    made = image(Shape(submaps=8, lit=True))
    made.constraints.keep(np.arange(7) != 4)
    stored = read(packed(made, meta_of(made, 0.0, "", "")))
    assert stored.isolated == 0
    assert len(stored.tables["submap.key"]) == 8


def test_a_small_file_that_says_it_is_huge_is_refused_before_it_is_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    huge = np.zeros(40 << 20, np.uint8)
    data = container.pack({"beam": huge, "frame.lit": huge})
    monkeypatch.setattr(container, "_array", lambda *_: pytest.fail("it was unpacked"))
    with pytest.raises(BadMap, match="claim to unpack to 83886080 bytes, which is impossible"):
        container.unpack(data)


def test_a_part_that_no_map_has_is_refused() -> None:
    data = container.pack({**container.unpack(content()), "more": np.zeros(3)})
    with pytest.raises(BadMap, match="the part 'more' is not a part of version 1"):
        read(data)
