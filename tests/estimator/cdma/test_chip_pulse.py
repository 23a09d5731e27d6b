"""The tabulated pulse against the simulator's exact one, and the learning of a low-pass that is off."""

import numpy as np
import pytest

from estimator.cdma.air_interface import PROFILE_A, PROFILES, Profile
from estimator.cdma.chip_pulse import pulse_energy, pulse_table
from estimator.cdma.correlation_kernels import columns
from estimator.cdma.gold_codes import gold_codes
from tests.estimator.cdma_scene import Run, ceiling
from tools.sim.light.transmitter import Lamp
from tools.sim.light.waveform import Ambient, Bus, Ceiling, Receiver

pytestmark = pytest.mark.jit


def received(profile: Profile, lamp: Lamp, receiver: Receiver) -> tuple[np.ndarray, np.ndarray]:
    """One noiseless block and its sampling times."""
    bus = Bus(scl_hz=18 * profile.sample_rate)
    world = Ceiling([lamp], Ambient(current_a=0.0), receiver, bus, profile.chip_rate, profile.degree)
    block = world.block(3.0, int(profile.epoch_s * profile.sample_rate))
    return (block.words / 2**24 - 0.5) * receiver.full_scale_a, block.t_sample


@pytest.mark.parametrize("name", sorted(PROFILES))
@pytest.mark.parametrize("code", [0, 40])
def test_the_table_explains_the_simulated_light(name: str, code: int) -> None:
    profile = PROFILES[name]
    front = profile.front_end
    receiver = Receiver(full_scale_a=1e-4, bits=24, enob=24.0, thermal_a=0.0, lpf_hz=front.lpf_hz, hpf_hz=front.hpf_hz)
    lamp = Lamp(code=code, current_a=1e-6, depth=profile.depth, phase_chips=3.7, data=False)
    y, t = received(profile, lamp, receiver)
    out = np.empty((2, 1, len(t)))
    chips, x = gold_codes(profile.degree)[[code]], t * profile.chip_rate
    phase = lamp.phase_chips + np.floor(x[0] / profile.length) * 0.0
    start = np.floor((x[0] + phase) / profile.length) * profile.length
    touched = int((x[-1] - x[0]) / profile.length) + 3
    lamps = np.array([[phase - start], [1.0]])
    columns(chips, lamps, np.stack([x, np.ones_like(x)]), np.ones((1, touched)), pulse_table(profile)[None], out)
    value, ramp = out[0, 0], np.linspace(-1, 1, len(t))
    rows = np.array([value, np.ones_like(t), ramp, ramp**2]).T
    weights = np.linalg.lstsq(rows, y, rcond=None)[0]
    assert weights[0] == pytest.approx(profile.depth * 1e-6, rel=3e-4)
    left = y - rows @ weights
    assert np.std(left) < 4e-3 * np.std(y)


def test_energy_is_the_mean_square_of_a_code() -> None:
    receiver = Receiver(full_scale_a=1e-4, bits=24, enob=24.0, thermal_a=0.0)
    y, _ = received(PROFILE_A, Lamp(code=7, current_a=1e-6, data=False), receiver)
    assert np.mean((y - y.mean()) ** 2) / (0.3e-6) ** 2 == pytest.approx(pulse_energy(PROFILE_A), rel=0.05)


@pytest.mark.parametrize("lpf_hz", [7000.0, 8800.0])
def test_a_low_pass_that_is_off_is_learned(lpf_hz: float) -> None:
    world = ceiling(3)
    world.receiver = Receiver(lpf_hz=lpf_hz)
    run = Run(world)
    run.settle(40)
    assert run.decoder.shape.corner == pytest.approx(lpf_hz / 8000.0, rel=0.01)
    errors = np.array([run.errors(*run.block()) for _ in range(15)])
    assert np.sqrt(np.mean(errors[:, 0] ** 2)) < 1.5e-3
    assert run.decoder.noise * PROFILE_A.front_end.lsb_a < 7.5e-9
