"""The residual map beside a survey: found at the start, used by the filter, kept in a recording, refused by name."""

from __future__ import annotations

import base64
import errno
import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import daemon.recording.disk_writer
from daemon.config.residual_file import write_residuals
from daemon.config.schema import Config, LightsConfig, PhotodiodeConfig
from daemon.config.survey_loader import SurveyError, residuals_beside, write_survey
from daemon.devices.light_setup import RESIDUALS, Lights, from_header, load_lights, lost_residuals, read_residuals
from daemon.maps.initial_state import new_state
from daemon.recording import disk_writer
from daemon.recording.recorder import Recorder
from estimator.cdma.air_interface import PROFILE_A
from estimator.light_filter.residual_map import ResidualMap
from estimator.light_filter.survey import Survey
from hal.clock import SystemClock
from hal.replay.recording import Kind, open_recording
from tests.daemon.recording.test_recorder import wait_for
from tests.daemon.support.light_room import BUS, SURVEY

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


def test_a_recording_keeps_the_map_once_and_exactly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk_writer, "WRITE_S", 0.005)
    lights = load_lights(with_map(tmp_path))
    assert lights is not None
    large = replace(lights, residuals=lights.residuals + bytes(200_000))
    recorder = Recorder(tmp_path / "rec", Config(), SystemClock(), large)
    recorder.disk._segment_bytes = 1000
    for number in range(4):
        recorder.disk.put(Kind.RX, 0, float(number), bytes(2000))
        wait_for(lambda n=number: recorder.disk.records == n + 1)
    recorder.close()
    recording = open_recording(tmp_path / "rec")
    assert len(recording.segments) > 3
    assert max(file.stat().st_size for file in recording.segments) < 10_000
    folder = recording.segments[0].parent
    header = json.loads(json.dumps(recording.header))
    assert from_header(header, folder) == large
    recording.segments[0].unlink()
    later = open_recording(tmp_path / "rec")
    assert from_header(later.header, folder) == large, "whole segments may be taken away"
    for spoil in (lambda file: file.write_bytes(large.residuals[:-1]), Path.unlink):
        spoil(folder / RESIDUALS)
        without = from_header(later.header, folder)
        assert without == replace(large, residuals=b"")
        assert lost_residuals(later.header, without)


def test_a_recording_with_the_map_in_its_head_reads_as_before(tmp_path: Path) -> None:
    lights = load_lights(with_map(tmp_path))
    assert lights is not None
    kept = {key: value for key, value in lights.header()["lights"].items() if key != "residuals_sha256"}
    older = {"lights": {**kept, "residuals": base64.b64encode(lights.residuals).decode()}}
    assert from_header(json.loads(json.dumps(older)), tmp_path) == lights
    assert from_header({"lights": kept}, tmp_path) == replace(lights, residuals=b"")


def test_no_room_for_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(daemon.recording.disk_writer, "write_whole", full)
    recorder = Recorder(tmp_path, Config(), SystemClock(), Lights(SURVEY, PROFILE_A, None, b"a map"))
    assert "No space left on device" in recorder.error, "what cannot be replayed without it is not recorded"
    recorder.close()
    assert not list(recorder.disk.folder.iterdir())


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"no map", "not a residual map"), (None, "the residual map belongs to another survey than")],
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
    assert "the daemon runs without it" in caplog.text


def test_a_map_that_cannot_be_read_is_named_and_done_without(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    settings = configured(tmp_path)
    residuals_beside(Path(settings.lights.survey)).mkdir()
    lights = load_lights(settings)
    assert lights is not None
    assert lights.residuals == b""
    assert "residuals.npz: cannot be read" in caplog.text
    assert "the daemon runs without it" in caplog.text
    with pytest.raises(SurveyError, match=r"residuals\.npz: cannot be read"):
        read_residuals(Path(settings.lights.survey))


def test_a_damaged_head_is_not_of_this_version() -> None:
    header = Lights(SURVEY, PROFILE_A).header()
    header["lights"]["residuals"] = "%%%"
    with pytest.raises(ValueError, match="of another version"):
        from_header(header)
