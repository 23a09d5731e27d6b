"""The simulated receiver as a process, and its light."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hal.errors import DataInvalid
from hal.fake.adc.light import OrdinaryLamps, RecordedLight


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-W", "error", "-m", "hal.fake.adc.receiver", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere"], "expected unix:/path or tcp://host:port"),
        (["unix:/no/such/folder/x"], "cannot listen"),
        (["unix:{}/x", "--faults", "/no/such/file"], "No such file"),
        (["unix:{}/x", "--light", "/no/such/file"], "not a recorded light"),
    ],
)
def test_what_is_wrong_with_the_arguments_is_named(arguments: list[str], says: str, tmp_path: Path) -> None:
    process = start(*(argument.format(tmp_path) for argument in arguments))
    _, err = process.communicate(timeout=20)
    assert process.returncode == 2
    assert says in err
    assert "Traceback" not in err


def test_ordinary_lamps_flicker_at_twice_the_mains() -> None:
    t = np.arange(22222) / 22222.0
    wave = OrdinaryLamps(noise=0.0)(t) - 0.5
    spectrum = np.abs(np.fft.rfft(wave))
    assert np.argmax(spectrum) == 100
    assert 0.09 < wave.max() < 0.13


def test_a_recorded_light_is_repeated(tmp_path: Path) -> None:
    path = tmp_path / "light.npz"
    np.savez(path, fraction=np.array([0.1, 0.3, 0.5, 0.7]), rate_hz=100.0)
    light = RecordedLight(path)
    assert light(np.array([0.0, 0.01, 0.015, 0.035, 0.04, 4.01])) == pytest.approx([0.1, 0.3, 0.4, 0.4, 0.1, 0.3])


@pytest.mark.parametrize(
    "arrays",
    [
        {"fraction": np.zeros((2, 2)), "rate_hz": 1.0},
        {"fraction": np.zeros(1), "rate_hz": 1.0},
        {"fraction": np.array([0.0, np.nan]), "rate_hz": 1.0},
        {"fraction": np.zeros(5), "rate_hz": 0.0},
        {"fraction": np.zeros(5)},
        {"rate_hz": 1.0},
    ],
)
def test_files_that_are_no_light(arrays: dict[str, object], tmp_path: Path) -> None:
    path = tmp_path / "light.npz"
    np.savez(path, **arrays)
    with pytest.raises(DataInvalid, match=r"fraction|rate_hz"):
        RecordedLight(path)
