"""The residual map beside a survey: found at the start, used by the filter, kept in a recording, refused by name."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from daemon.config import Config, LightsConfig, PhotodiodeConfig
from daemon.lights import Lights, from_header, load_lights, new_state
from daemon.residualfile import write_residuals
from daemon.surveyfile import SurveyError, residuals_beside, write_survey
from estimator.cdma_profile import PROFILE_A
from estimator.lamps import Survey
from estimator.residual import ResidualMap
from tests.daemon.lightroom import BUS, SURVEY

SHIFT = 0.1


def even_map(survey: Survey) -> ResidualMap:
    """Every lamp a tenth stronger than surveyed, everywhere."""
    n = len(survey.lamps)
    grid = np.tile((-5.0, -5.0, 1.0, 1.0), (n, 1))
    lamp_ids = tuple(lamp.lamp_id for lamp in survey.lamps)
    return ResidualMap(lamp_ids, grid, np.full((n, 11, 11), SHIFT), np.full((n, 11, 11), 0.02), 0.01)


def configured(folder: Path) -> Config:
    path = folder / "lights.toml"
    write_survey(path, SURVEY)
    return Config(photodiode=PhotodiodeConfig(bus=BUS), lights=LightsConfig(survey=str(path)))


def with_map(folder: Path, survey: Survey = SURVEY) -> Config:
    settings = configured(folder)
    write_residuals(residuals_beside(Path(settings.lights.survey)), even_map(survey), survey)
    return settings


def test_the_map_beside_the_survey_is_used(tmp_path: Path) -> None:
    lights = load_lights(with_map(tmp_path))
    assert lights is not None
    light = new_state(lights).light
    assert light is not None
    assert light.filter.corrections is not None
    expected = light.filter.corrections.at([SURVEY.lamps[1].lamp_id], np.zeros(3))
    assert expected[0, 0] == pytest.approx(SHIFT, abs=0.01)


def test_without_a_map_there_are_no_corrections(tmp_path: Path) -> None:
    lights = load_lights(configured(tmp_path))
    assert lights is not None
    assert lights.residuals == b""
    light = new_state(lights).light
    assert light is not None
    assert light.filter.corrections is None


def test_a_recording_keeps_the_map(tmp_path: Path) -> None:
    lights = load_lights(with_map(tmp_path))
    assert lights is not None
    assert from_header(msgspec.json.decode(msgspec.json.encode(lights.header()))) == lights
    older = {"lights": {key: value for key, value in lights.header()["lights"].items() if key != "residuals"}}
    assert from_header(older) == replace(lights, residuals=b"")


@pytest.mark.parametrize(
    ("content", "message"), [(b"no map", "not a residual map"), (None, "was learned with another survey")]
)
def test_a_map_of_no_use_is_named_and_done_without(
    tmp_path: Path, content: bytes | None, message: str, caplog: pytest.LogCaptureFixture
) -> None:
    settings = with_map(tmp_path, replace(SURVEY, floor=0.03))
    if content is not None:
        residuals_beside(Path(settings.lights.survey)).write_bytes(content)
    lights = load_lights(settings)
    with caplog.at_level(logging.WARNING):
        light = new_state(lights).light
    assert light is not None
    assert light.filter.corrections is None
    assert message in caplog.text
    assert "driving without it" in caplog.text


def test_a_map_that_cannot_be_read_stops_the_start(tmp_path: Path) -> None:
    settings = configured(tmp_path)
    residuals_beside(Path(settings.lights.survey)).mkdir()
    with pytest.raises(SurveyError, match=r"residuals\.npz: cannot be read"):
        load_lights(settings)


def test_a_damaged_head_is_not_of_this_version() -> None:
    header = Lights(SURVEY, PROFILE_A).header()
    header["lights"]["residuals"] = "%%%"
    with pytest.raises(ValueError, match="not of this version"):
        from_header(header)
