"""The light receiver's amplifier in numbers: ``python -m tools.docs.frontend`` prints the tables of docs/receiver.md.

Every figure follows from the parts below by the formula beside it; nothing here has been measured. Change a part and
run it again; a test keeps the page equal to what this prints.
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

ELECTRON: Final = 1.602e-19
KT4: Final = 4.0 * 1.381e-23 * 298.0
PARALLEL: Final = {"BPW34": (16, 7.45e-6, 72e-12)}
"""Photodiode: how many, area of one (m^2), capacitance of one at 0 V (F); from its data sheet."""
BUTTERWORTH2: Final = 1.111
"""Noise bandwidth of a second-order Butterworth low-pass over its corner."""
LED_LM_PER_W: Final = 300.0
"""Lumens per watt of light from a white LED; of daylight with its infrared about 105."""


@dataclass(frozen=True)
class FrontEnd:
    """Parts of the amplifier: photodiode, transimpedance stage, coupling, gain, low-pass, converter. SI units.

    Attributes:
        rf, cf: feedback of the transimpedance stage. bias_v: its output in the dark. ra, rb: set the gain.
        r_couple, c_couple: high-pass. r_low, c_low: of the unity-gain Sallen-Key low-pass, whose other capacitor is
        twice c_low. en, gbw, c_in, headroom_v: of the operational amplifier (OPA2320), headroom for full linearity.
        enob: of the converter, over its whole range. r_adc, c_adc: between amplifier and converter.
    """

    rf: float = 1.8e3
    cf: float = 220e-12
    bias_v: float = 0.1
    ra: float = 1.0e3
    rb: float = 35.7e3
    r_couple: float = 3.16e3
    c_couple: float = 1.0e-6
    r_low: float = 6.34e3
    c_low: float = 2.2e-9
    en: float = 8.5e-9
    gbw: float = 20e6
    c_in: float = 9e-12 + 20e-12
    headroom_v: float = 0.1
    supply_v: float = 3.3
    enob: float = 11.3
    r_adc: float = 100.0
    c_adc: float = 1e-9

    @property
    def area(self) -> float:
        """m^2."""
        count, area, _ = PARALLEL["BPW34"]
        return count * area

    @property
    def c_diode(self) -> float:
        """F, with the amplifier's own input and 20 pF of wiring."""
        count, _, capacitance = PARALLEL["BPW34"]
        return count * capacitance + self.c_in

    @property
    def gain(self) -> float:
        """Of the second stage."""
        return 1.0 + self.rb / self.ra

    @property
    def ohms(self) -> float:
        """Output volts per ampere of modulated photocurrent."""
        return self.rf * self.gain

    @property
    def full_scale_a(self) -> float:
        """Photocurrent, peak to peak, that fills the converter."""
        return self.supply_v / self.ohms

    @property
    def largest_a(self) -> float:
        """Largest photocurrent, daylight and all, before the first stage saturates."""
        return (self.supply_v - self.headroom_v - self.bias_v) / self.rf

    @property
    def low_pass_hz(self) -> float:
        """Corner of the low-pass."""
        return 1.0 / (2.0 * math.pi * self.r_low * self.c_low * math.sqrt(2.0))

    @property
    def high_pass_hz(self) -> float:
        """Corner of the coupling."""
        return 1.0 / (2.0 * math.pi * self.r_couple * self.c_couple)

    @property
    def optimum_cf(self) -> float:
        """Feedback capacitor at which the first stage is just flat."""
        return math.sqrt(self.c_diode / (2.0 * math.pi * self.rf * self.gbw))

    @property
    def first_stage_hz(self) -> float:
        """Bandwidth of the first stage, by its feedback."""
        return 1.0 / (2.0 * math.pi * self.rf * self.cf)

    @property
    def phase_margin_deg(self) -> float:
        """Of the first stage: where its noise gain meets the open-loop gain."""
        zero, pole = 1.0 / (2.0 * math.pi * self.rf * (self.c_diode + self.cf)), self.first_stage_hz
        f = self.gbw * self.cf / (self.c_diode + self.cf)
        return 90.0 - math.degrees(math.atan(f / zero)) + math.degrees(math.atan(f / pole))

    def shot_a(self, current_a: float) -> float:
        """Shot noise of a photocurrent, A/sqrt(Hz)."""
        return math.sqrt(2.0 * ELECTRON * current_a)

    def densities(self, light_a: float) -> Iterator[tuple[str, float]]:
        """Noise sources as photocurrent, A/sqrt(Hz)."""
        rise = abs(complex(1.0, 2.0 * math.pi * self.low_pass_hz * self.rf * self.c_diode))
        yield f"shot noise of {1e6 * light_a:.0f} uA of mean light", self.shot_a(light_a)
        yield "feedback resistor", math.sqrt(KT4 / self.rf)
        yield "first amplifier", self.en * rise / self.rf
        yield "second amplifier", self.en / self.rf
        yield "its gain resistors", math.sqrt(KT4 * self.ra * self.rb / (self.ra + self.rb)) / self.rf
        yield "low-pass, with its amplifier", math.hypot(math.sqrt(2.0 * KT4 * self.r_low), self.en) / self.ohms

    @property
    def converter_a(self) -> float:
        """Noise of the converter as photocurrent, A rms in every sample."""
        return float(self.full_scale_a / (2.0**self.enob * math.sqrt(12.0)))

    def noise_a(self, light_a: float) -> float:
        """All noise as photocurrent, A rms in every sample."""
        band = BUTTERWORTH2 * self.low_pass_hz
        return math.sqrt(band * sum(d * d for _, d in self.densities(light_a)) + self.converter_a**2)


def photocurrent_a(
    lux: float, area: float = 1.2e-4, responsivity: float = 0.4, lm_per_w: float = LED_LM_PER_W
) -> float:
    """Photocurrent of even light on a photodiode that looks straight into it, A."""
    return lux / lm_per_w * area * responsivity


def settle_share(front: FrontEnd) -> float:
    """What is left of a step between two samples when the converter opens its switch, share of the step."""
    sample_c, switch_r, acquire_s = 20e-12, 1e3, 1.12e-6
    kick = sample_c / (sample_c + front.c_adc)
    outside = kick * math.exp(-acquire_s / (front.r_adc * (front.c_adc + sample_c)))
    return outside + math.exp(-acquire_s / (switch_r * sample_c))


def design() -> list[tuple[str, str]]:
    """Figures of the amplifier."""
    f = FrontEnd()
    stuck_s = math.log(500e-6 / (0.5 * f.full_scale_a)) / (2.0 * math.pi * f.high_pass_hz)
    return [
        ("photodiode: area, capacitance at its node", f"{1e4 * f.area:.2f} cm2, {1e12 * f.c_diode:.0f} pF"),
        ("volts per ampere, modulated light", f"{1e-3 * f.ohms:.1f} kOhm (1.8 kOhm x {f.gain:.1f})"),
        ("full scale, peak to peak", f"{1e6 * f.full_scale_a:.1f} uA"),
        ("one word", f"{1e9 * f.full_scale_a / 4096:.1f} nA"),
        ("largest photocurrent, all light together", f"{1e3 * f.largest_a:.2f} mA"),
        (
            "output of the first stage at 79 uA, at 1.6 mA",
            f"{f.bias_v + f.rf * 79e-6:.2f} V, {f.bias_v + f.rf * 1.6e-3:.2f} V",
        ),
        ("low-pass, high-pass", f"{1e-3 * f.low_pass_hz:.2f} kHz, {f.high_pass_hz:.1f} Hz"),
        ("low-pass at 11.1 kHz, at 100 Hz the high-pass", f"{lowpass(f, 11.1e3):.2f}, {highpass(f, 100.0):.2f}"),
        ("feedback capacitor: just flat, chosen", f"{1e12 * f.optimum_cf:.0f} pF, {1e12 * f.cf:.0f} pF"),
        ("first stage: bandwidth, phase margin", f"{1e-3 * f.first_stage_hz:.0f} kHz, {f.phase_margin_deg:.0f} deg"),
        ("delay of both amplifiers beside the low-pass", f"{1e6 * delay_s(f):.1f} us, the same for every lamp"),
        ("largest flicker at 100 Hz, amplitude", f"{1e6 * 0.5 * f.full_scale_a / highpass(f, 100.0):.0f} uA"),
        ("back in range after a step of 500 uA", f"{1e3 * stuck_s:.0f} ms"),
        ("converter's input settles to", f"{1e6 * settle_share(f):.2g} ppm of a step (half a word: 122 ppm)"),
    ]


def delay_s(front: FrontEnd) -> float:
    """Delay in the band by the bandwidths of first and second stage."""
    return (1.0 / front.first_stage_hz + front.gain / front.gbw) / (2.0 * math.pi)


def light() -> list[tuple[str, str]]:
    """What the photodiode sees: 1.2 cm2, 0.4 A/W."""
    nadir = 1.5 * 1.6461 / (2.0 * math.pi * 2.6**2) * 1.2e-4 * 0.4
    edge = nadir * math.cos(math.radians(60.0)) ** 3.6461
    word = FrontEnd().full_scale_a / 4096
    daylight = photocurrent_a(10e3, responsivity=0.42, lm_per_w=105.0) * 0.8
    return [
        ("500 lx, 10 klx of white LED light (300 lm/W)",
         f"{1e6 * photocurrent_a(500):.0f} uA, {1e3 * photocurrent_a(10e3):.2f} mA"),
        ("10 klx of daylight on bare silicon (105 lm/W, 80 % of it in band, 0.42 A/W)", f"{1e3 * daylight:.1f} mA"),
        ("lamp of 1.5 W, 2.6 m straight above: mean, modulated at depth 0.30",
         f"{1e6 * nadir:.2f} uA, {1e6 * 0.3 * nadir:.2f} uA = {0.3 * nadir / word:.0f} words"),
        ("the same lamp 60 deg off the axis, modulated", f"{1e9 * 0.3 * edge:.0f} nA = {0.3 * edge / word:.1f} words"),
        ("receiver that leans by 1 deg: a place 2.6 m below a lamp",
         f"{260 * math.tan(math.radians(1.0)):.1f} cm off"),
    ]  # fmt: skip


def bus() -> list[tuple[str, str]]:
    """I2C: samples, blocks, cable."""
    rows = [
        (f"SCL {1e-3 * scl:.0f} kHz", f"{scl / 18:.0f} /s | {1e3 * (10 + 9 * 8192) / scl:.0f} ms")
        for scl in (100e3, 400e3, 1e6)
    ]
    farads = 300e-9 / (math.log(7.0 / 3.0) * 1.8e3)  # edges of 300 ns from 0.3 to 0.7 of the supply
    return [*rows, ("capacitance of the bus at 400 kHz, pull-ups 1.8 kOhm", f"- | {1e12 * farads:.0f} pF")]


def transmitter() -> list[tuple[str, str]]:
    """Timer of a lamp, 16 MHz crystal."""
    rows = []
    for name, chips in (("A", 5000.0), ("B", 825.0), ("D", 20e3)):
        counts = 16e6 / (2.0 * chips)
        error = 1e6 * (round(counts) / counts - 1.0)
        rows.append((name, f"{5e5 / chips:.2f} us | {round(counts)} | {abs(error):.1f} ppm"))
    return rows


def lowpass(front: FrontEnd, hz: float) -> float:
    """Gain of the low-pass."""
    return 1.0 / math.sqrt(1.0 + (hz / front.low_pass_hz) ** 4)


def highpass(front: FrontEnd, hz: float) -> float:
    """Gain of the coupling."""
    return 1.0 / math.hypot(1.0, front.high_pass_hz / hz)


def budget(light_a: float = 79e-6) -> list[tuple[str, str]]:
    """Noise of every sample, as photocurrent."""
    front, strong = FrontEnd(), photocurrent_a(10e3)
    band = math.sqrt(BUTTERWORTH2 * front.low_pass_hz)
    densities = [*front.densities(light_a), ("shot noise of 1.6 mA instead (10 klx)", front.shot_a(strong))]
    rows = [(name, f"{1e12 * d:.2f} pA/rtHz | {1e9 * d * band:.2f} nA") for name, d in densities]
    for name, amperes in (
        (f"converter, {front.enob:g} effective bits", front.converter_a),
        ("all, 500 lx", front.noise_a(light_a)),
        ("all, 10 klx", front.noise_a(strong)),
    ):
        rows.append((name, f"- | {1e9 * amperes:.2f} nA"))
    return rows


VARIANTS: Final = ((62e3, 60.0), (1.8e3, 35.7e3), (680.0, 95.3e3))
"""Feedback resistor and the gain resistor that belongs to it, Ohm."""


def variants() -> list[tuple[str, str]]:
    """What the feedback resistor decides."""
    rows = []
    for rf, rb in VARIANTS:
        front = FrontEnd(rf=rf, rb=rb)
        lux = front.largest_a / photocurrent_a(1.0)
        noise = 1e9 * front.noise_a(79e-6)
        rows.append((f"{1e-3 * rf:.2f} kOhm x {front.gain:.2f}",
                     f"{1e3 * front.largest_a:.3f} mA | {lux:.0f} lx | {noise:.2f} nA"))  # fmt: skip
    return rows


def filters() -> list[tuple[str, str]]:
    """Parts of low-pass and coupling for each air interface."""
    rows = []
    for name, r_low, c_low, r_couple, c_couple in (
        ("A", 6.34e3, 2.2e-9, 3.16e3, 1.0e-6),
        ("B", 8.45e3, 10e-9, 9.09e3, 2.2e-6),
        ("D", 7.15e3, 470e-12, 3.65e3, 220e-9),
    ):
        front = FrontEnd(r_low=r_low, c_low=c_low, r_couple=r_couple, c_couple=c_couple)
        parts = f"{1e-3 * r_low:.2f} kOhm, {1e9 * c_low:g} nF, {2e9 * c_low:g} nF"
        parts += f" | {1e-3 * r_couple:.2f} kOhm, {1e6 * c_couple:g} uF"
        rows.append((name, f"{parts} | {1e-3 * front.low_pass_hz:.2f} kHz, {front.high_pass_hz:.1f} Hz"))
    return rows


TABLES: Final = {
    "design": design,
    "budget": budget,
    "variants": variants,
    "filters": filters,
    "light": light,
    "bus": bus,
    "transmitter": transmitter,
}


def markdown(rows: list[tuple[str, str]]) -> str:
    """Rows as the page has them."""
    return "".join(f"| {name} | {text} |\n" for name, text in rows)


def main() -> int:
    """Print every table."""
    for name, rows in TABLES.items():
        sys.stdout.write(f"{name}\n{markdown(rows())}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
