"""A configuration that is refused."""

from pathlib import Path

import pytest

from daemon.config.loader import ConfigError, load


def refused(tmp_path: Path, text: str, *overrides: str) -> str:
    """What is said of it."""
    file = tmp_path / "robot.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load(file, overrides)
    return str(caught.value).replace(f"{tmp_path}/", "")
