"""The paper's method as printed, and pIC, beside lumiloop's own: estimators that are run by name.

    run = method("paper")(Settings(), lights)
    result = run.step(records, limits)

Nothing is loaded before a method is asked for, and no daemon asks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from estimator.light_filter.light_channel import LightsSetup
    from estimator.paper.methods import Method
    from estimator.state import Settings

LUMILOOP: Final = "lumiloop"
"""The method of the daemon."""
METHODS: Final = {
    LUMILOOP: "the method of the daemon",
    "paper": "the paper's method as printed",
    "pic": "probabilistic iterative correspondence, the paper's baseline, which knows no light",
}
"""Every method by name, with its description."""


class UnknownMethod(ValueError):
    """There is no method of that name; the text lists those that there are."""


def method(name: str) -> Callable[[Settings, LightsSetup | None], Method]:
    """The method called ``name``: call it with settings and the photodiode (None: there is none) to begin a run.

    Raises:
        UnknownMethod: there is none of that name.
    """
    if name not in METHODS:
        raise UnknownMethod(f"no method {name!r}: choose from {', '.join(METHODS)}")
    from estimator.paper.methods import BY_NAME

    return BY_NAME[name]
