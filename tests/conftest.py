"""Options shared by all tests: which device end to use, and where real logs are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--lidar", default="fake", help="fake, or a real device: /dev/ttyACM0, tcp://192.168.0.10:10940")


@pytest.fixture(scope="session")
def log_root() -> Path:
    """Folder of real recorded logs; unset: skip and say why. Set but missing: fail."""
    root = os.environ.get("LUMILOOP_DATA")
    if not root:
        pytest.skip("LUMILOOP_DATA is not set: it names the folder of real recorded logs (see docs/data.md)")
    path = Path(root)
    if not path.is_dir():
        pytest.fail(f"LUMILOOP_DATA={root} is not a folder")
    return path
