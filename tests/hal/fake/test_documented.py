"""The vocabulary in the documentation is the vocabulary."""

import re
from pathlib import Path

import pytest

from hal.fake.adc.faults import ADC
from hal.fake.adc.i2c_adapters import ADAPTERS
from hal.fake.faults.orders import Vocabulary
from hal.fake.lidar.faults import LIDAR
from hal.fake.lidar.models import MODELS

PAGE = (Path(__file__).parents[3] / "docs" / "fake-devices.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("heading", "vocabulary"), [("Lidar", LIDAR), ("Light receiver", ADC)])
def test_every_word_has_its_row(heading: str, vocabulary: Vocabulary) -> None:
    section = PAGE.split(f"\n### {heading}\n")[1].split("\n#")[0]
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \| (.*) \| (.*) \|$", section, re.MULTILINE)
    assert [row[0] for row in rows] == list(vocabulary)
    for name, kind, parameters, text in rows:
        word = vocabulary[name]
        assert (kind, text) == (word.kind, word.help)
        assert parameters == ", ".join(f"`{key}` {rule.default!r}" for key, rule in word.parameters.items())


def test_every_model_is_named() -> None:
    assert all(name in PAGE for name in MODELS)


def test_every_adapter_is_named() -> None:
    assert all(f"`{name}`" in PAGE for name in ADAPTERS)
