"""The input of a command is opened and judged before a kernel is loaded or compiled."""

from pathlib import Path

import pytest

from daemon.cli import parser
from daemon.runtime import warmup
from daemon.system import console
from tests.hal.replay.logs import flaser, write


def refuse_to_load(*args: object) -> None:
    pytest.fail("kernels are loaded before the input is judged")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["replay", "IN", "--out", "out"], "all 20 stamps are equal"),
        (["map", "export", "IN", "--out", "out"], "all 20 stamps are equal"),
        (["calibrate", "IN"], "all 20 stamps are equal"),
        (["survey", "IN"], "all 20 stamps are equal"),
        (["export", "IN", "--tum", "a.tum"], "all 20 stamps are equal"),
        (["why", "12:00:00", "IN"], "IN"),
        (["map", "render", "IN", "a.png"], "IN"),
        (["map", "import", "IN"], "IN"),
        (["replay", "none", "--out", "out"], "none: no such file"),
        (["export", "none", "--tum", "a.tum"], "none: no such file"),
        (["map", "render", "none", "a.png"], "none: cannot read the map"),
    ],
)
def test_an_input_that_cannot_be_used_loads_no_kernel(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(warmup, "load_aloud", refuse_to_load)
    write(tmp_path / "IN", [flaser(7.0, robot=(0.1 * i, 0.0, 0.0)) for i in range(20)])
    assert parser.main(words) == console.FAILED
    assert says in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["IN"]
