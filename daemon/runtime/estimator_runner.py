"""Estimator runner: loads the estimator, owns its state, and makes one step per cycle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from daemon.devices.light_setup import Lights
from daemon.maps.initial_state import new_state
from daemon.maps.store import Start
from daemon.maps.switching import Switch, take_over
from daemon.runtime.cycle_parts import Step
from estimator import Limits, Record, StepResult, no_lap

if TYPE_CHECKING:  # the estimator is loaded in a thread, by the warm-up
    from estimator import State


class EstimatorRunner:
    """The estimator with its state. It loads at the first step at the latest; the warm-up has made that quick.

    Args:
        start: initial map. localise: maps are only used, never changed.
        lap: called with the name of each finished part of a step.

    Attributes:
        state: None until it is loaded.
    """

    def __init__(
        self,
        lights: Lights | None,
        start: Start | None,
        localise: bool = False,
        lap: Callable[[str], object] = no_lap,
    ) -> None:
        self.state: State | None = None
        self.localise = localise
        self.start = start
        self._lights = lights
        self._lap = lap
        self._step: Step | None = None

    def made(self, start: Start) -> State:
        """Returns a new state that starts in a stored map; may run in another thread."""
        import estimator

        return new_state(self._lights, estimator.Settings(), replace(start, localise=self.localise))

    def take_over(self, switch: Switch) -> None:
        """Switches to another map."""
        assert self.state is not None
        take_over(self.state, switch.donor)

    def load(self) -> Step:
        """Loads the estimator and its initial map; returns the step function."""
        import estimator

        self.state = new_state(self._lights, estimator.Settings(localise=self.localise), self.start)
        self._step = partial(estimator.step, self.state, lap=self._lap)
        return self._step

    def __call__(self, records: tuple[Record, ...], limits: Limits) -> StepResult:
        """Makes one step."""
        step = self._step or self.load()
        return step(records, limits)
