"""The paper's method as printed, and pIC, beside the daemon's method: estimators that run by name.

    run = method("paper")(Settings(), lights)
    result = run.step(records, limits)

The modules of the package load in :func:`method` only, which a running daemon never calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from estimator.light_filter.light_channel import LightsSetup
    from estimator.paper.methods import Method
    from estimator.state import Settings

LUMILOOP: Final = "lumiloop"
"""Name of the daemon's method."""
METHODS: Final = {
    LUMILOOP: "the method of the daemon",
    "paper": "the paper's method as printed",
    "pic": "probabilistic iterative correspondence, the paper's baseline without light",
}
"""Description of every method by name."""


class UnknownMethod(ValueError):
    """There is no method of that name; the text lists the valid ones."""


def method(name: str) -> Callable[[Settings, LightsSetup | None], Method]:
    """Constructor of the method called ``name``; its arguments are settings and the photodiode (None: there is none).

    Raises:
        UnknownMethod: there is none of that name.
    """
    if name not in METHODS:
        raise UnknownMethod(f"no method {name!r}: choose from {', '.join(METHODS)}")
    from estimator.paper.methods import BY_NAME

    return BY_NAME[name]
