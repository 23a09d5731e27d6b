"""Drivers by name: lazily imported, extended by entry points, wrong names answered with the right ones."""

import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from hal import registry
from hal.errors import DeviceRefused
from hal.hokuyo.driver import HokuyoDriver


@pytest.mark.parametrize(
    ("device", "parts"),
    [
        ("auto", ("hokuyo", "auto")),
        ("/dev/ttyACM0", ("hokuyo", "/dev/ttyACM0")),
        ("/dev/serial/by-path/pci-0000:00:14.0", ("hokuyo", "/dev/serial/by-path/pci-0000:00:14.0")),
        ("tcp://192.168.0.10:10940", ("hokuyo", "tcp://192.168.0.10:10940")),
        ("hokuyo:/dev/ttyACM0", ("hokuyo", "/dev/ttyACM0")),
    ],
)
def test_device_strings(device: str, parts: tuple[str, str]) -> None:
    assert registry.split(device) == parts


def test_built_in_driver() -> None:
    assert registry.lidar_factory("hokuyo") is HokuyoDriver


def test_unknown_driver() -> None:
    with pytest.raises(DeviceRefused, match=r"sick: no such lidar driver \(available: hokuyo"):
        registry.lidar_factory("sick")


def test_installed_drivers(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [
        EntryPoint("mine", "hal.hokuyo.driver:HokuyoDriver", registry.GROUP),
        EntryPoint("broken", "hal.no_such_module:Driver", registry.GROUP),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: [p for p in points if p.group == group])
    assert registry.names() == ["broken", "hokuyo", "mine"]
    assert registry.split("mine:left front") == ("mine", "left front")
    assert registry.lidar_factory("mine") is HokuyoDriver
    with pytest.raises(DeviceRefused, match="cannot be loaded"):
        registry.lidar_factory("broken")


def test_names_cost_no_import_of_drivers() -> None:
    code = "import sys, hal.registry as r; r.names(); assert 'hal.hokuyo.driver' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
