"""Commands of `lumiloop` as a person gives them: fixtures that run one and return what it has written."""

from collections.abc import Callable

import pytest

Command = Callable[..., str]
"""Takes the words after `lumiloop`."""


@pytest.fixture
def done(capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a command that succeeds; what is on standard output."""

    def run(*words: str) -> str:
        from daemon.cli import parser

        assert parser.main([*words]) == 0
        return capsys.readouterr().out

    return run


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a command that fails with exit status 1; what is on standard error."""

    def run(*words: str) -> str:
        from daemon.cli import parser

        assert parser.main([*words]) == 1
        return capsys.readouterr().err

    return run
