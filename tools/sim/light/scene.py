"""The lights of a scene: the ceiling over the robot where it truly is, as a converter's input or as decoded epochs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from estimator.cdma.epoch import LightEpoch
from estimator.light_filter.survey import Survey
from tools.sim.building.building import Building
from tools.sim.building.people import Crowd
from tools.sim.ceiling.ceiling import Array, Ceiling, Effects, Photodiode
from tools.sim.ceiling.lamps import fixtures
from tools.sim.ceiling.links import Links
from tools.sim.ceiling.movers import rows_of
from tools.sim.ceiling.records import frames, light_epoch
from tools.sim.ceiling.records import survey as survey_of
from tools.sim.light.stream import LightStream
from tools.sim.light.waveform import Ambient, Receiver
from tools.sim.robot.drive import Drive, leans

WAVEFORM: Final = "waveform"
"""Samples of a converter, to be decoded."""
LINK: Final = "link"
"""Epochs with the decoder's error statistics: for long runs."""


@dataclass(frozen=True, slots=True)
class Lights:
    """Coded lamps in a scenario.

    Attributes:
        fidelity: :data:`WAVEFORM` or :data:`LINK`. effects: how far the lamps depart from the plan.
        survey: whether the daemon is given the plan; else the lamps have to describe themselves, and the photodiode
            sits on the robot's axis, where a daemon without a survey takes it to be.
        ambient: light that carries no code. receiver: front end and converter. scl_error: relative error of the bus
            clock. level: whether there is a DC channel.
    """

    fidelity: str = WAVEFORM
    effects: Effects = field(default_factory=Effects)
    survey: bool = True
    ambient: Ambient = field(default_factory=Ambient)
    receiver: Receiver = field(default_factory=Receiver)
    scl_error: float = 0.0
    level: bool = False

    def __post_init__(self) -> None:
        if self.fidelity not in (WAVEFORM, LINK):
            raise ValueError(f"fidelity {self.fidelity!r}: expected {WAVEFORM} or {LINK}")


class Outing(Protocol):
    """A robot on its way: what the lights have to know of a scene. Times are ``t_mono``."""

    @property
    def drive(self) -> Drive:
        """The way."""
        ...

    def begin(self, t_mono: float) -> float:
        """A sensor is read: people walk, and the robot drives off unless it is held. Returns when that first was."""
        ...

    def truth(self, t_mono: Array) -> Array:
        """(n, 3) true poses of base_link."""
        ...

    def driven(self, t_mono: Array) -> Array:
        """(n,) s on the drive's own clock."""
        ...

    def walked(self, t_mono: Array) -> Array:
        """(n,) s that people have walked."""
        ...


class SceneLight:
    """The ceiling of a building over one robot.

    Attributes:
        ceiling: its lamps. stream: what the converter's input sees, a :data:`hal.fake.adc.chips.SampleSource`.
        survey: what the daemon is told.
    """

    def __init__(self, scene: Outing, place: Building, crowd: Crowd, lights: Lights, seed: int) -> None:
        self.lights, self._scene, self._crowd = lights, scene, crowd
        photodiode = Photodiode() if lights.survey else Photodiode(0.0, 0.0)
        self.ceiling = Ceiling(
            fixtures(place), place.world, place.height_m, lights.effects, photodiode, seed=seed,
            lean=self._lean, movers=self._movers,
        )  # fmt: skip
        self.stream = LightStream(
            self.ceiling, scene.truth, receiver=lights.receiver, ambient=lights.ambient, seed=seed
        )
        self.survey = survey_of(self.ceiling) if lights.survey else Survey()
        self._links, self._frames = Links(self.ceiling, seed=seed), frames(self.ceiling)

    def prepare(self) -> None:
        """Work out beforehand what else would take seconds when the robot first gets to a room."""
        drive = self._scene.drive
        self.ceiling.by_the_walls(drive.pose(np.linspace(0.0, drive.lap_s, 600))[:, :2])

    def sample(self, t_mono: Array) -> Array:
        """The converter's input as a fraction of its range at each instant."""
        self._begin(float(t_mono[-1]))
        return self.stream(t_mono)

    def level(self, t_mono: Array) -> Array:
        """The amplifier's output before the coupling capacitor, as a fraction of its range."""
        return self.stream.level(t_mono)

    def epoch(self, t_begin: float, t_end: float) -> LightEpoch:
        """What a decoder would report of a block."""
        self._begin(t_end)
        amplitudes = self.stream.track.at(0.5 * (t_begin + t_end))
        return light_epoch(self.ceiling, self._links.report(t_begin, t_end, amplitudes), self._frames)

    def _begin(self, t_mono: float) -> None:
        if self.ceiling.lit_since == -np.inf:
            self.ceiling.lit_since = t_mono
        self._scene.begin(t_mono)

    def _lean(self, t: Array) -> Array:
        return leans(self._scene.drive, self._scene.driven(t))

    def _movers(self, t: Array, poses: Array) -> Array:
        return rows_of(self._crowd.bodies(self._scene.walked(t), poses))
