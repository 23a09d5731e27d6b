"""The light survey as a file: what is written reads back, and whatever is wrong is named with place and remedy."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.config.survey_loader import SurveyError, dump, read_survey, write_survey
from daemon.config.survey_schema import order_of
from estimator.cdma.air_interface import PROFILE_A, PROFILE_B, PROFILE_D, Profile
from estimator.cdma.gold_codes import gold_codes
from estimator.light_filter.survey import Lamp, Receiver, Survey

EXAMPLE = Path(__file__).parents[3] / "systemd" / "lights" / "room-of-16.toml"

GOOD = """\
depth = 0.3
[[lamp]]
lamp_id = 4
code = 17
x = 1.0
y = 2.0
z = 3.0
half_angle_deg = 60.0
[[lamp]]
lamp_id = 2
code = 17
x = 4.0
y = 2.0
z = 3.0
[receiver]
x = 0.1
"""


def finite(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda value: round(value, 6))


lamps = st.builds(
    Lamp,
    lamp_id=st.integers(0, 65535),
    code=st.integers(0, 512),
    x=finite(-500, 500),
    y=finite(-500, 500),
    z=finite(6.5, 20),
    power_w=finite(0.01, 500),
    order=finite(0.1, 40),
    slope_x=finite(-0.9, 0.9),
    slope_y=finite(-0.9, 0.9),
    sigma_ln=finite(0.01, 1.0),
)
receivers = st.builds(
    Receiver,
    x=finite(-2, 2),
    y=finite(-2, 2),
    z=finite(0, 6),
    area_m2=finite(0.01, 10).map(lambda cm2: round(1e-4 * cm2, 10)),
    responsivity=finite(0.01, 1),
    order=finite(0.1, 5),
    half_fov_rad=st.integers(10, 90).map(math.radians),
    slope_x=finite(-0.5, 0.5),
    slope_y=finite(-0.5, 0.5),
)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(lamps, min_size=1, max_size=8, unique_by=(lambda lamp: lamp.lamp_id, lambda lamp: round(lamp.x))),
    receivers,
)
def test_what_is_written_reads_back(
    tmp_path_factory: pytest.TempPathFactory, some: list[Lamp], receiver: Receiver
) -> None:
    path = tmp_path_factory.mktemp("survey") / "lights.toml"
    survey = Survey(tuple(sorted(some, key=lambda lamp: lamp.lamp_id)), receiver, 0.02, 0.25)
    write_survey(path, survey, ("a note",), {some[0].lamp_id: "a remark"})
    assert read_survey(path) == survey
    text = path.read_text()
    assert "# a note\n" in text
    assert "  # a remark\n" in text
    write_survey(path, read_survey(path), force=True)
    assert path.read_text() == dump(survey)


def test_the_example_is_good() -> None:
    survey = read_survey(EXAMPLE)
    assert len(survey.lamps) == 16
    assert len({lamp.code for lamp in survey.lamps}) == 16
    assert survey.receiver == Receiver()


def test_tables_and_half_angle(tmp_path: Path) -> None:
    path = tmp_path / "lights.toml"
    path.write_text(GOOD)
    survey = read_survey(path)
    assert [lamp.lamp_id for lamp in survey.lamps] == [2, 4]
    assert survey.lamps[1].order == pytest.approx(1.0)
    assert survey.lamps[0].order == pytest.approx(order_of(70.0), abs=1e-4)
    assert survey.receiver.x == 0.1


WRONG = [
    (
        "x = 1.0\n",
        "x = nan\n",
        ":5",
        "lamp 4: `x` = nan: expected a number, -10000.0 to 10000.0 (metres, luminous centre); as in x = 2.5",
    ),
    ("x = 1.0\n", "x = inf\n", ":5", "to 10000.0"),
    ("code = 17\nx = 1.0", "code = 513\nx = 1.0", ":4", "number of the CDMA code"),
    ("code = 17\nx = 1.0", "code = -1\nx = 1.0", ":4", "code"),
    ("lamp_id = 4", "lamp_id = 2", ":9", "lamp 2: another lamp has this `lamp_id` in line 2"),
    ("lamp_id = 4", 'lamp_id = "4"', ":3", 'lamp[0]: `lamp_id` = "4": expected a whole number, 0 to 65535'),
    (
        "y = 2.0\nz = 3.0\nhalf",
        "y = 2.0\nz = 3.0\npower = 2\nhalf",
        ":8",
        "unknown key `power`; did you mean `power_w`",
    ),
    ("z = 3.0\nhalf", "hight = 3.0\nhalf", ":7", "unknown key `hight`"),
    ("z = 3.0\nhalf", "half", ":2", "lamp 4: `z` is missing: metres above the ground; as in z = 2.6"),
    ("half_angle_deg = 60.0", "half_angle_deg = 60.0\norder = 1.0", ":2", "got both"),
    ("half_angle_deg = 60.0", "half_angle_deg = 90.0", ":8", "angle of half intensity"),
    ("z = 3.0\nhalf", "z = nan\nhalf", ":7", "lamp 4: `z` = nan"),
    ("z = 3.0\nhalf", "z = 300.0\nhalf", ":7", "metres above the ground"),
    ("x = 4.0", "x = 1.0", ":9", "has the position of lamp 4"),
    ("depth = 0.3", "depth = 3.0", ":1", "`depth` = 3.0: expected a number, 0.002 to 0.95 (modulation depth"),
    ("depth = 0.3", "dept = 0.3", ":1", "did you mean `depth`"),
    ("x = 0.1", "x = 40.0", ":16", "receiver: `x` = 40.0: expected a number, -5.0 to 5.0 (metres ahead of the robot"),
    ("x = 0.1", "lever = 0.1", ":16", "known here are x, y, z"),
    ("x = 0.1", "z = 2.9", ":2", "not above the receiver"),
]


@pytest.mark.parametrize(("old", "new", "line", "words"), WRONG)
def test_what_is_wrong_is_named(tmp_path: Path, old: str, new: str, line: str, words: str) -> None:
    assert old in GOOD
    path = tmp_path / "lights.toml"
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(SurveyError) as error:
        read_survey(path)
    told = str(error.value).splitlines()
    assert any(one.startswith(f"{path}{line}: ") and words in one for one in told), told


MANY = """\
depth = 3.0
flor = 0.1
lamp = [
  { lamp_id = 1, code = 130, x = 0.0, y = 0.0, z = 2.6 },
  { lamp_id = 1, code = -5, x = nan, y = 0.0, hight = 2.6 },
  { lamp_id = 70000, code = 5, x = 0.0, y = 0.0, z = 2.6 },
  { lamp_id = 4, code = 5, x = 5.0, y = 0.0, z = 2.6, order = 1, half_angle_deg = 60 },
  { lamp_id = 6, code = 5, x = 9.0, y = 0.0, z = 2.1 },
  7,
]
[receiver]
z = 2.0
slope_x = "a"
"""


def test_all_that_is_wrong_is_said_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "lights.toml"
    path.write_text(MANY)
    with pytest.raises(SurveyError) as error:
        read_survey(path, PROFILE_A)
    told = [line.removeprefix(f"{path}:") for line in str(error.value).splitlines()]
    expected = [
        (" lamp[5]: expected a table", "lamp_id, code"),
        ("1: `depth` = 3.0", "as in depth = 0.25"),
        ("2: unknown key `flor`", "did you mean `floor`?"),
        ("4: lamp 1: code 130 is not in profile A", "0 to 128"),
        ("5: lamp 1: unknown key `hight`", "known here are"),
        ("5: lamp 1: `code` = -5", "as in code = 73"),
        ("5: lamp 1: `x` = nan", "as in x = 2.5"),
        ("5: lamp 1: `z` is missing", "as in z = 2.6"),
        ("5: lamp 1: another lamp has this `lamp_id`", "in line 4"),
        ("6: lamp[2]: `lamp_id` = 70000", "0 to 65535"),
        ("6: lamp[2]: has the position of lamp 1 in line 4", "delete one"),
        ("7: lamp 4: expected `order` or `half_angle_deg`, got both", ""),
        ("8: lamp 6: is at z = 2.1 m, not above the receiver", ""),
        ('13: receiver: `slope_x` = "a"', "as in slope_x = 0.0"),
    ]
    for line, (head, tail) in zip(told, expected, strict=True):
        assert line.startswith(head)
        assert tail in line


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "receiver = { x = 40.0 }\nlamp = [\n{ lamp_id = 1, code = -5, x = 0.0, y = 0.0, z = 2.6 },\n7,\n]\n",
            [":1: receiver: `x` = 40.0", ":3: lamp 1: `code` = -5", ": lamp[1]: expected a table"],
        ),
        (
            "lamp = [{ lamp_id = 1, code = -5, x = 0.0, y = 0.0, z = 2.6 },\n7,\n]\nreceiver = { x = 40.0 }\n",
            [":1: lamp 1: `code` = -5", ":4: receiver: `x` = 40.0", ": lamp[1]: expected a table"],
        ),
        (
            "receiver = { x = 40.0 }\n[[lamp]]\nlamp_id = 1\ncode = 5\nx = 0.0\ny = 0.0\nz = 2.6\n",
            [":1: receiver: `x` = 40.0"],
        ),
        ("lamp = []\nreceiver = 3\n", [":2: receiver: expected a table, { ... }, of x, y, z, "]),
    ],
)
def test_a_table_in_one_line_has_its_own_line(tmp_path: Path, text: str, expected: list[str]) -> None:
    path = tmp_path / "lights.toml"
    path.write_text(text)
    with pytest.raises(SurveyError) as error:
        read_survey(path)
    told = [line.removeprefix(str(path)) for line in str(error.value).splitlines()]
    assert all(any(line.startswith(head) for line in told) for head in expected), told
    assert len(told) == len(expected)


def test_what_stands_in_for_a_wrong_value_is_no_error_of_its_own(tmp_path: Path) -> None:
    """A receiver whose height cannot be read is above no lamp, and a lamp without a place hangs where no other does."""
    path = tmp_path / "lights.toml"
    for old, new in (("x = 0.1", "z = 200.0"), ("x = 4.0", "x = 'a'"), ("lamp_id = 2", "lamp_id = -4")):
        path.write_text(GOOD.replace(old, new, 1))
        with pytest.raises(SurveyError) as error:
            read_survey(path)
        assert len(str(error.value).splitlines()) == 1


PROFILES = (PROFILE_A, PROFILE_B, PROFILE_D)


@pytest.mark.parametrize("profile", PROFILES)
def test_codes_are_those_of_the_profile(tmp_path: Path, profile: Profile) -> None:
    path = tmp_path / "lights.toml"
    last = len(gold_codes(profile.degree)) - 1
    path.write_text(GOOD.replace("code = 17", f"code = {last}", 1))
    assert read_survey(path, profile).lamps[1].code == last
    path.write_text(GOOD.replace("code = 17", f"code = {last + 1}", 1))
    with pytest.raises(SurveyError) as error:
        read_survey(path, profile)
    words = f":4: lamp 4: code {last + 1} is not in profile {profile.name}, which has codes 0 to {last}; "
    if profile is PROFILE_D:
        words = ":4: lamp 4: `code` = 513: expected a whole number, 0 to 512"
    assert words in str(error.value)


@pytest.mark.parametrize("profile", PROFILES)
def test_depth_is_the_profiles_unless_the_file_says_one(tmp_path: Path, profile: Profile) -> None:
    path = tmp_path / "lights.toml"
    path.write_text(GOOD.replace("depth = 0.3\n", ""))
    assert read_survey(path, profile).depth == profile.depth
    path.write_text(GOOD.replace("depth = 0.3\n", "depth = 0.21\n"))
    assert read_survey(path, profile).depth == 0.21


def test_lines_are_found_in_the_written_form(tmp_path: Path) -> None:
    path = tmp_path / "lights.toml"
    survey = read_survey(EXAMPLE)
    write_survey(path, survey)
    lines = path.read_text().splitlines()
    at = next(number for number, line in enumerate(lines) if "lamp_id = 7," in line)
    lines[at] = lines[at].replace("lamp_id = 7,", "lamp_id = 6,")
    path.write_text("\n".join(lines))
    with pytest.raises(SurveyError, match=f":{at + 1}: lamp 6: .* has this `lamp_id` in line {at}$"):
        read_survey(path)
    lines[at] = lines[at].replace("lamp_id = 6,", "lamp_id = 7, colour = 3,")
    path.write_text("\n".join(lines))
    with pytest.raises(SurveyError, match=f":{at + 1}: lamp 7: unknown key `colour`"):
        read_survey(path)


@pytest.mark.parametrize("content", [b"", b"lamp = []", b"lamp = 3", b"x", b"\xff\xfe", b"[[lamp]]"])
def test_files_that_are_no_survey(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "lights.toml"
    path.write_bytes(content)
    with pytest.raises(SurveyError, match=r"lights\.toml"):
        read_survey(path)


def test_a_receiver_alone_is_a_survey_of_lamps_that_describe_themselves(tmp_path: Path) -> None:
    path = tmp_path / "lights.toml"
    path.write_text("lamp = []\n[receiver]\nz = 0.4\n")
    survey = read_survey(path)
    assert (survey.lamps, survey.receiver.z) == ((), 0.4)
    write_survey(path, survey, force=True)
    assert read_survey(path) == survey


def test_missing_and_unreadable(tmp_path: Path) -> None:
    with pytest.raises(SurveyError, match="no such survey"):
        read_survey(tmp_path / "none.toml")
    with pytest.raises(SurveyError, match="cannot be read"):
        read_survey(tmp_path)


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    path = tmp_path / "lights.toml"
    survey = read_survey(EXAMPLE)
    write_survey(path, survey)
    other = replace(survey, floor=0.03)
    with pytest.raises(SurveyError, match="--force"):
        write_survey(path, other)
    assert read_survey(path) == survey
    write_survey(path, other, force=True)
    assert read_survey(path) == other
    assert [file.name for file in tmp_path.iterdir()] == ["lights.toml"]


def test_no_place_to_write(tmp_path: Path) -> None:
    with pytest.raises(SurveyError, match="cannot write"):
        write_survey(tmp_path / "nowhere" / "lights.toml", read_survey(EXAMPLE))
