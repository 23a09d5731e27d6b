"""The figures of docs/receiver.md and docs/transmitter.md are those of the calculator, and the calculator is right."""

import math
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hal.photodiode.ads1x15 import RANGES_V
from hal.photodiode.block_check import RAIL_BITS
from hal.photodiode.dc_channel import LevelInput
from hal.photodiode.diagnosis import DARK, DAZZLED
from tests.tools.test_transmitter import SOURCE, build
from tools.docs.frontend import TABLES, FrontEnd, highpass, lowpass, markdown, photocurrent_a, settle_share
from tools.sim.light.waveform import Ambient, Receiver

DOCS = Path(__file__).parents[3] / "docs"
PAGES = {name: (DOCS / f"{name}.md").read_text(encoding="utf-8") for name in ("receiver", "transmitter")}
FRONT = FrontEnd()


@pytest.mark.parametrize("table", TABLES)
def test_every_figure_of_the_page_is_calculated(table: str) -> None:
    page = PAGES["transmitter" if table == "transmitter" else "receiver"]
    assert markdown(TABLES[table]()) in page


def test_the_amplifier_is_what_the_simulator_has() -> None:
    simulated = Receiver()
    assert FRONT.full_scale_a == pytest.approx(simulated.full_scale_a, rel=0.01)
    assert FRONT.low_pass_hz == pytest.approx(simulated.lpf_hz, rel=0.02)
    assert FRONT.high_pass_hz == pytest.approx(simulated.hpf_hz, rel=0.02)
    assert FRONT.enob == simulated.enob
    assert photocurrent_a(500) == pytest.approx(Ambient().current_a, rel=0.02)
    for hz in (20.0, 100.0, 3000.0, 11e3):
        assert lowpass(FRONT, hz) * highpass(FRONT, hz) == pytest.approx(abs(simulated.gain(hz)), rel=0.02)


def test_saturation_is_where_the_daemon_looks_for_it() -> None:
    assert photocurrent_a(10e3) < FRONT.largest_a
    level = LevelInput()
    assert (level.rest_v, level.full_scale_v) == (FRONT.bias_v, FRONT.supply_v)
    assert level.full_scale_v <= RANGES_V[1]
    saturated = (FRONT.supply_v - 0.02 - level.rest_v) / (level.full_scale_v - level.rest_v)
    assert saturated > DAZZLED > (FRONT.bias_v + FRONT.rf * 1.6e-3 - level.rest_v) / 3.2
    assert DARK * 3.2 / FRONT.rf == pytest.approx(9e-6, rel=0.02)
    assert FRONT.supply_v / (1 << RAIL_BITS) > 0.02  # how close an OPA2320 comes to its rails


def test_sallen_key_is_a_butterworth() -> None:
    """By its own equations: capacitor to the output twice the one to ground, equal resistors."""
    r, c2, c1 = FRONT.r_low, FRONT.c_low, 2.0 * FRONT.c_low
    s = 2j * math.pi * np.array([100.0, 5e3, FRONT.low_pass_hz, 11.1e3])
    gain = np.abs(1.0 / (1.0 + s * c2 * 2.0 * r + s**2 * r * r * c1 * c2))
    assert gain == pytest.approx([lowpass(FRONT, abs(x) / (2 * math.pi)) for x in s], rel=1e-9)
    assert gain[2] == pytest.approx(math.sqrt(0.5))


def test_the_first_stage_is_stable_by_its_loop_gain() -> None:
    f = np.geomspace(1e3, 1e8, 200_001)
    s = 2j * np.pi * f
    noise_gain = (1 + s * FRONT.rf * (FRONT.c_diode + FRONT.cf)) / (1 + s * FRONT.rf * FRONT.cf)
    loop = FRONT.gbw / (1j * f) / noise_gain
    crossing = int(np.argmax(np.abs(loop) < 1.0))
    margin = 180.0 + math.degrees(np.angle(loop[crossing]))
    assert margin == pytest.approx(FRONT.phase_margin_deg, abs=3.0)
    assert margin > 60.0


def test_noise_of_the_low_pass_by_integration() -> None:
    f = np.linspace(0.0, 5e6, 2_000_001)
    band = float(np.sum(1.0 / (1.0 + (f / FRONT.low_pass_hz) ** 4)) * (f[1] - f[0]))
    assert band == pytest.approx(1.111 * FRONT.low_pass_hz, rel=2e-3)
    assert FRONT.shot_a(79e-6) * math.sqrt(band) == pytest.approx(0.474e-9, rel=0.01)


def test_the_input_settles_by_simulation() -> None:
    """Charge of the sample switch against 1 nF behind 100 Ohm, integrated in small steps."""
    outside, inside, dt = 1.0, 0.0, 1e-11
    for _ in range(round(1.12e-6 / dt)):
        through = (outside - inside) / 1e3
        outside += dt * ((1.0 - outside) / FRONT.r_adc - through) / FRONT.c_adc
        inside += dt * through / 20e-12
    assert abs(1.0 - inside) < 10e-6
    assert settle_share(FRONT) < 122e-6


def test_a_lamp_takes_36_bytes(tmp_path: Path) -> None:
    assert "`struct lamp` is 36 bytes" in PAGES["transmitter"]
    build(tmp_path)  # skips where there is no compiler
    program = tmp_path / "size"
    code = f'#include <stdio.h>\n#include "{SOURCE}"\nint main(void) {{ return (int)sizeof(struct lamp); }}\n'
    (tmp_path / "size.c").write_text(code)
    subprocess.run(["cc", "-std=c99", "-DLAMP_EMBEDDED", "-o", program, tmp_path / "size.c"], check=True)
    assert subprocess.run([program], check=False).returncode == 36


def test_the_program_on_the_page_compiles(tmp_path: Path) -> None:
    build(tmp_path)
    (example,) = [text.split("```")[0] for text in PAGES["transmitter"].split("```c\n")[1:]]
    names = (
        "void fail(void);",
        "void start_timer(void);",
        "void set_led(uint8_t level);",
        "void timer_interrupt(void);",
    )
    harness = "#include <stdint.h>\n#define sleep idle\nvoid idle(void);\n" + "\n".join(names) + "\n"
    (tmp_path / "lamp.c").write_text(harness + example.replace('"transmitter.c"', f'"{SOURCE}"'))
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion", "-c"]
    subprocess.run(["cc", *flags, "-o", tmp_path / "lamp.o", tmp_path / "lamp.c"], check=True)


def test_the_command_on_the_page_runs(tmp_path: Path) -> None:
    assert "./transmitter 17 17 12500 3750 2600 1500 60 300" in PAGES["transmitter"]
    program = build(tmp_path)
    command = [program, *["17", "17", "12500", "3750", "2600", "1500", "60", "300"]]
    sent = subprocess.run(command, capture_output=True, check=True, text=True).stdout
    assert len(sent) == 300
    assert set(sent) == {"0", "1"}
